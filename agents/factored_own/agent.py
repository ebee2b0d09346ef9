"""The agent ``factored_own``: it begins with nothing, and learns to see from its own frames while it acts.

All that it sees is remembered, up to a bound. As soon as something has no known value, or much more was seen, factors
and values are found anew (:mod:`.looks`), remembered transitions get their codes anew, and dynamics and outcomes are
learned from them once more: nothing that happened is lost. Then it also decides what it had better remember of an
episode (:mod:`.memory`). Once as many frames are remembered as may be, perception stays as it is.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import Perceived

from .. import snapshot
from ..encoders.perception import prepare_torch
from ..factored.agent import CodeAgent
from ..factored.factors import Code, CodeTransition, Memory
from ..factored.settings import OWN, OwnPerceptionSettings, OwnSettings
from . import looks
from .memory import choose, contradictions, remembering
from .picture import picture

_FIRST, _RECENT = 4, 4
"""Frames after which it looks for factors first; frames whose codes are kept."""
_CONTRADICTIONS = 0.01
"""Share of transitions that may contradict one another by a misread frame."""


class OwnPerception:
    """Frames seen so far, and the codes that they have by what was found in the first ``looked_at`` of them."""

    def __init__(self, settings: OwnPerceptionSettings, *, factored: bool) -> None:
        self._settings, self._factored = settings, factored
        self.frames: list[Frame] = []
        self.transitions: list[tuple[int, int]] = []
        """Frames before and after of each transition, as long as all are remembered."""
        self.begins: list[bool] = []
        """Whether each of these is the first of an episode."""
        self.actions: list[int] = []
        """The macro-action of each."""
        self.found: list[looks.Factor] = []
        self.memory: Memory | None = None
        self.found_in = self.looked_at = 0
        """In how many of the first frames factors were found, and looked for."""
        self.history: list[int] = []
        """The first of these whenever it changed."""
        self.unknown = False
        """Whether anything seen since has no known value."""
        self._remembered = 0
        self._recent: OrderedDict[bytes, tuple[Code, bool]] = OrderedDict()

    @property
    def seen_sizes(self) -> tuple[int, ...]:
        """Numbers of values of the factors; before any is found, of one factor of one value."""
        sizes = tuple(len(factor.joint) for factor in self.found) or (1,)
        return sizes if self._factored else (int(np.prod(sizes)),)

    @property
    def sizes(self) -> tuple[int, ...]:
        """The same, and last of what is remembered, if anything is."""
        sizes = self.seen_sizes
        return sizes if self.memory is None else (*sizes, sizes[self.memory.factor])

    @property
    def full(self) -> bool:
        """Whether as many frames are remembered as may be, so that nothing is found anew."""
        return len(self.frames) >= self._settings.frames

    def begin_episode(self) -> None:
        """Forget the episode so far."""
        self._remembered = self.memory.hidden if self.memory else 0

    def recall(self, remembered: int) -> None:
        """Remember this of the episode so far."""
        self._remembered = remembered

    def code(self, frame: Frame) -> Code:
        """The code of the newest frame (64, 64, 3) of an episode, with what is remembered of those before."""
        code = self._read(frame)[0]
        if self.memory is None:
            return code
        self._remembered = self.memory.after(self._remembered, code)
        return (*code, self._remembered)

    def _read(self, frame: Frame) -> tuple[Code, bool]:
        """The code of a frame, and whether all of its values are known; the last ones are kept."""
        key = frame.tobytes()
        if key not in self._recent:
            codes, known = self.codes(frame[None])
            self._recent[key] = (codes[0], bool(known.all()))
            if len(self._recent) > _RECENT:
                self._recent.popitem(last=False)
        return self._recent[key]

    def codes(self, frames: Frame) -> tuple[list[Code], NDArray[np.bool_]]:
        """The codes of frames (N, 64, 64, 3), and which values are known, (N, P)."""
        if not self.found:
            return [(0,)] * len(frames), np.zeros((len(frames), 1), dtype=np.bool_)
        codes, known = looks.read(self.found, frames)
        if not self._factored:
            codes = np.ravel_multi_index(tuple(codes.T), [len(factor.joint) for factor in self.found])[:, None]
        return [tuple(code) for code in codes.tolist()], known

    def remember(self, before: Frame, action: int, after: Frame, *, begins: bool = False) -> None:
        """Remember a transition; one that begins where the last one ended costs one frame."""
        new = [after] if self.frames and np.array_equal(self.frames[-1], before) else [before, after]
        self.frames += [frame.copy() for frame in new]
        self.unknown |= not all(self._read(frame)[1] for frame in new)
        self.transitions.append((len(self.frames) - 2, len(self.frames) - 1))
        self.begins.append(begins)
        self.actions.append(action)

    def renew(self) -> bool:
        """Look for factors anew if it is time; whether codes may now be others."""
        seen, settings = len(self.frames), self._settings
        growth = settings.growth if self.unknown else settings.growth_if_known
        if seen < max(_FIRST, growth * self.looked_at):
            return False
        self.look(seen)
        return True

    def look(self, count: int) -> None:
        """Find factors in the first ``count`` frames remembered."""
        self.take(looks.find(*self.first(count)) if count else [], count)
        self.looked_at, self.unknown = count, False

    def first(self, count: int) -> tuple[Frame, NDArray[np.bool_], NDArray[np.int64]]:
        """The first ``count`` frames remembered, which begin an episode, and what was done then: as ``find`` asks."""
        begins = np.isin(np.arange(count), [before for before, _ in compress(self.transitions, self.begins)])
        actions = np.full(count, -1)
        for (before, after), action in zip(self.transitions, self.actions, strict=True):
            if after < count:
                actions[before] = action
        return np.stack(self.frames[:count]), begins, actions

    def take(self, found: list[looks.Factor], found_in: int) -> None:
        """See these factors from now on."""
        self.found, self.found_in, self.memory = found, found_in, None
        self._recent.clear()

    def arrays(self) -> snapshot.Arrays:
        """The frames that it remembers, and which are those of each transition."""
        seen = np.stack(self.frames) if self.frames else np.zeros((0, 64, 64, 3), dtype=np.uint8)
        pairs: NDArray[np.int64] = np.array(self.transitions, dtype=np.int64).reshape(-1, 2)
        return {
            "replay/frames": seen,
            "replay/frame_pairs": pairs,
            "replay/begins": np.array(self.begins, dtype=np.bool_),
        }

    def values(self) -> dict[str, Any]:
        """What belongs to :meth:`arrays` in a snapshot."""
        memory = None if self.memory is None else [self.memory.factor, self.memory.hidden]
        counts = {"looked_at": self.looked_at, "found_in": self.found_in, "history": list(self.history)}
        return {**counts, "unknown": self.unknown, "memory": memory}

    def load(self, state: AgentState) -> None:
        """Take up what :meth:`arrays` and :meth:`values` gave, and the agent's ``replay/action``: find the same."""
        self.frames = list(state.arrays["replay/frames"])
        self.transitions = [(before, after) for before, after in state.arrays["replay/frame_pairs"].tolist()]
        self.begins = state.arrays["replay/begins"].tolist()
        self.actions = state.arrays["replay/action"][: len(self.transitions)].tolist()
        self.look(state.values["found_in"])
        self.looked_at, self.unknown = state.values["looked_at"], state.values["unknown"]
        memory, self.history = state.values["memory"], list(state.values["history"])
        self.memory = Memory(*memory) if memory else None

    def diagnostics(self) -> dict[str, float]:
        """How many factors and values it sees, in how many frames it found them, and how many it remembers."""
        sizes = self.sizes
        found = {"factors": len(sizes), "values": sum(sizes), "looked_at": self.looked_at, "frames": len(self.frames)}
        return {f"perception/{name}": float(value) for name, value in found.items()}


class OwnPerceptionAgent(CodeAgent[OwnPerception]):
    """Learns perception, dynamics and outcomes together; its codes have a meaning for nobody else."""

    settings: OwnSettings
    _acted = 0
    """Macro-actions that the agent itself chose in this episode."""
    _observed = 0
    """Transitions of this episode that it was shown, its own or another's."""
    _longest: int | None = None
    """After how many macro-actions an episode was cut, if any was."""

    def begin_episode(self) -> None:
        """The next frame is the first of an episode; see :class:`.capabilities.EpisodeRememberer`."""
        self._acted = 0
        self._observed = 0
        self.perception.begin_episode()

    @property
    def _memory(self) -> Memory | None:
        return self.perception.memory

    @property
    def _left(self) -> int | None:
        if self._longest is None:
            return None
        return self._longest - max(self._acted, self._observed)

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Act as on any codes, and count."""
        action = super().act(observation, explore=explore)
        self._acted += 1
        return action

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember what was seen, see anew if that is due, and learn as from any codes."""
        eyes = self.perception
        self._observed += 1
        if transition.truncated:
            self._longest = max(self._observed, self._longest or 0)
        if not eyes.full:
            with self.meters.cpu_time("time/perception_s"):
                before, after = transition.observation.frame, transition.next_observation.frame
                eyes.remember(before, transition.action, after, begins=self._observed == 1)
                found = (eyes.found, eyes.found_in)
                if eyes.renew():
                    self._recode(*found)
                    eyes.history += [eyes.found_in] if eyes.found_in not in eyes.history else []
            self.meters.count("time/perception_s")
        super().observe(transition, episode=episode)
        if transition.terminated or transition.truncated:
            self.begin_episode()

    def _recode(self, found: list[looks.Factor], found_in: int) -> None:
        """Give every replayed transition the codes that its frames have now, and learn from all of them once more.

        What was ``found`` before is kept where outcomes contradict what is found now and did not contradict that.
        """
        eyes, count = self.perception, len(self.replay)
        of_task = slice(self.tasks[-1] if self.tasks else 0, count)  # other tasks have other outcomes
        rows, few = self._rows(), _CONTRADICTIONS * (count - of_task.start)
        if found and contradictions(rows[of_task]) > few:
            now = (eyes.found, eyes.found_in)
            eyes.take(found, found_in)
            earlier = self._rows()
            if contradictions(earlier[of_task]) > few:
                eyes.take(*now)
            else:
                rows = earlier
        eyes.memory = choose(rows[of_task], eyes.begins[of_task], eyes.seen_sizes, self.n_actions, self.settings)
        rows = remembering(rows, eyes.begins[:count], eyes.memory)
        self.replay.recode([(row.code, row.following) for row in rows], len(eyes.sizes))
        self._relearn(self.tasks, count)
        eyes.begin_episode()
        if rows and eyes.memory and not eyes.begins[count]:
            eyes.recall(rows[-1].following[-1])

    def _rows(self) -> list[CodeTransition]:
        """What is replayed, with the codes that its frames have now, as far as they are seen."""
        codes, _ = self.perception.codes(np.stack(self.perception.frames))
        return [
            row._replace(code=codes[before], following=codes[after])
            for row, (before, after) in zip(self.replay.rows(), self.perception.transitions, strict=False)
        ]

    def perceived(self) -> Iterator[Perceived]:
        """What it saw whenever that changed; see :class:`.capabilities.SeeingLearner`."""
        eyes = self.perception
        for count in eyes.history:
            seen = eyes.first(count)
            found = looks.find(*seen)
            begun = sum(compress(eyes.begins, [after < count for _, after in eyes.transitions]))
            yield Perceived(begun, tuple(len(factor.joint) for factor in found), picture(found, seen[0]))

    def diagnostics(self) -> dict[str, float]:
        """Also what it sees."""
        return {**super().diagnostics(), **self.perception.diagnostics()}

    def state(self) -> AgentState:
        """A snapshot: also the frames that it remembers."""
        eyes, common = self.perception, super().state()
        values = {key: value for key, value in common.values.items() if key != "code_sizes"}
        return AgentState(
            arrays={**common.arrays, **eyes.arrays()}, values={**values, **eyes.values(), "longest": self._longest}
        )

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot: find the same factors in the same frames, and learn from all that is replayed.

        ArtefactError if it does not fit this agent, and then nothing was changed.
        """
        snapshot.require_fit(_flat(state), _flat(self.state()), equal=("settings", "n_actions"))
        self.perception.load(state)
        self._longest = state.values["longest"]
        self._take_up(state)


def _flat(state: AgentState) -> AgentState:
    """A snapshot whose codes are in one row: how many factors they are of changes as it learns."""
    codes: snapshot.Arrays = {
        name: state.arrays[name].ravel() for name in ("replay/code", "replay/following") if name in state.arrays
    }
    return AgentState(arrays={**state.arrays, **codes}, values=state.values)


def make(context: AgentContext) -> OwnPerceptionAgent:
    """The ``factored_own`` agent, of whatever frames are 64 x 64."""
    settings = OWN.resolve(context.hyperparameters, context.overrides, context.config_group)
    prepare_torch(context.device)
    perception = OwnPerception(settings.perception, factored=settings.dynamics.factored)
    return OwnPerceptionAgent(perception, context.n_actions, settings, context.seeds)
