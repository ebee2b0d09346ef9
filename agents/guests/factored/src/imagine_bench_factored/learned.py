"""The agent ``factored``: it begins with nothing, and learns to see from its own frames while it acts.

All that it sees is remembered, up to a bound. As soon as something has no known value, or much more was seen, factors
and values are found anew (:mod:`.appearance`), remembered transitions get their codes anew, and dynamics and outcomes
are learned from them once more: nothing that happened is lost. Then it also chooses the factors of an episode that it
remembers (:func:`.model.choose`). Once as many frames are remembered as may be, perception stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np
from imagine_bench.agents import snapshot
from imagine_bench.agents.encoders.perception import prepare_torch

from imagine_bench.arrays import Pixels
from imagine_bench.interfaces import AgentContext, AgentState, Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import Perceived

from .agent import CodeAgent, completed
from .factors import CodeTransition, contradictions, remembering
from .model import choose
from .perception import FrameFactors, LearnedPerception, find_factors
from .rewards import reward_classes
from .seeing import appearance
from .settings import LEARNED, LearnedSettings

_CONTRADICTIONS = 0.01
"""Share of transitions that may contradict one another by a misread frame."""
_SCALE = 5
"""Times that the image of the perception is drawn larger."""
_COLORS = np.array(
    [[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167], [213, 94, 0], [86, 180, 233], [240, 228, 66]]
)
"""Told apart by the color-blind (Okabe and Ito 2008)."""


class LearnedPerceptionAgent(CodeAgent):
    """Learns perception, dynamics and outcomes together; its codes have a meaning for nobody else."""

    perception: LearnedPerception
    settings: LearnedSettings
    _acted = 0
    """Macro-actions that the agent itself chose in this episode."""
    _longest: int | None = None
    """After how many macro-actions an episode was cut, if any was."""

    def begin_episode(self) -> None:
        """The next frame is the first of an episode; see :class:`.capabilities.EpisodeRememberer`."""
        super().begin_episode()
        self._acted = 0
        self.perception.begin_episode()

    def reset_for_new_task(self) -> None:
        """As on any codes; and the next task may cut episodes elsewhere."""
        super().reset_for_new_task()
        self._longest = None

    @property
    def _left(self) -> int | None:
        return None if self._longest is None else self._longest - max(self._acted, self._observed)

    def act(self, observation: Observation, *, explore: bool) -> int:
        """Act as on any codes, and count."""
        action = super().act(observation, explore=explore)
        self._acted += 1
        return action

    def observe(self, transition: Transition, *, episode: int) -> None:
        """Remember the frame, find factors anew if that is due, and learn as from any codes."""
        perception = self.perception
        if transition.truncated:
            self._longest = max(self._observed + 1, 0 if self._longest is None else self._longest)
        if not perception.full:
            with self.meters.cpu_time("time/perception_s"):
                before = transition.observation.frame
                after = transition.next_observation.frame
                perception.remember(before, transition.action, after, begins=self._observed == 0)
                frame_factors = perception.frame_factors
                found_in = perception.found_in
                if perception.renew():
                    self._recode(frame_factors, found_in)
                    if perception.found_in not in perception.history:
                        perception.history.append(perception.found_in)
            self.meters.count("time/perception_s")
        super().observe(transition, episode=episode)

    def _recode(self, frame_factors: FrameFactors, found_in: int) -> None:
        """Give every replayed transition the codes that its frames have now, and learn from all of them once more.

        The factors seen before are kept where outcomes contradict the present factors, and where these merge values
        that were told apart and so predict worse; unless outcomes contradict those seen before, too.
        """
        perception = self.perception
        count = len(self.replay)
        of_task = slice(self.tasks[-1] if self.tasks else 0, count)  # other tasks have other outcomes
        rows = self._rows()
        few = _CONTRADICTIONS * (count - of_task.start)
        if frame_factors.factors:
            factors_now = perception.frame_factors
            found_now_in = perception.found_in
            perception.take(frame_factors, found_in)
            earlier = self._rows()
            worse = _contradictions(rows[of_task]) > few or merges(earlier, rows)
            if worse and _contradictions(earlier[of_task]) <= few:
                rows = earlier
            else:
                perception.take(factors_now, found_now_in)
        begins = perception.begins
        classed = reward_classes(rows[of_task]).of(rows[of_task])
        perception.memory = choose(classed, begins[of_task], perception.seen_sizes, self.n_actions, self.settings)
        self.replay = remembering(rows, begins[:count], perception.memory)
        self._class_rewards()
        self._relearn(self.tasks, count)
        perception.begin_episode()
        if self.replay and perception.memory and not begins[count]:
            perception.recall(self.replay[-1].following[-1])

    def _rows(self) -> list[CodeTransition]:
        """The replayed transitions, with the codes that its frames have now, as far as they are seen."""
        codes = self.perception.codes(np.stack(self.perception.frames))
        clear = codes.clear.tolist()
        rows = []
        for row, (before, after) in zip(self.replay, self.perception.transitions, strict=False):
            seen = row._replace(code=codes.values[before], following=codes.values[after])
            rows.append(seen._replace(code_is_clear=clear[before], following_is_clear=clear[after]))
        return rows

    def perceived(self) -> Iterator[Perceived]:
        """Its perception whenever that changed; see :class:`.capabilities.SeeingLearner`."""
        perception = self.perception
        for count in perception.history:
            seen = perception.first(count)
            frame_factors = find_factors(*seen)
            begun = sum(compress(perception.begins, [after < count for _, after in perception.transitions]))
            sizes = tuple(len(factor.joint) for factor in frame_factors.factors)
            yield Perceived(begun, sizes, image(frame_factors.factors, _shown(frame_factors.standard.of(seen[0]))))

    def diagnostics(self) -> dict[str, float]:
        """Also its perception."""
        return {**super().diagnostics(), **self.perception.diagnostics()}

    def state(self) -> AgentState:
        """A snapshot: also the frames that it remembers."""
        perception = self.perception
        common = super().state()
        values = {**common.values, **perception.values(), "longest": self._longest}
        del values["code_sizes"]  # they change as it learns
        return AgentState(arrays={**common.arrays, **perception.arrays()}, values=values)

    def restore(self, state: AgentState) -> None:
        """Take up a snapshot: find the same factors in the same frames, and learn from all that is replayed.

        ArtefactError if it does not fit this agent, and then nothing was changed.
        """
        complete = completed(state)
        snapshot.require_fit(_flat(complete), _flat(self.state()), equal=("settings", "n_actions"))
        self.perception.load(complete)
        self._longest = complete.values["longest"]
        self._take_up(complete)


def _contradictions(rows: Sequence[CodeTransition]) -> int:
    """As :func:`.factors.contradictions`, but for those of rewards that chance changes."""
    return contradictions(reward_classes(rows).of(rows))


def merges(earlier: Sequence[CodeTransition], present: Sequence[CodeTransition]) -> bool:
    """Whether the present codes of the same transitions merge values of earlier ones and so predict worse.

    Only transitions that are clear in both tell.
    """
    clear = [(was, now) for was, now in zip(earlier, present, strict=True) if was.is_clear and now.is_clear]
    if not clear:
        return False
    codes = np.array([was.code for was, _ in clear])
    actions = np.array([now.action for _, now in clear])
    merged, following = (np.array([row[of] for _, row in clear]) for of in (0, 2))
    return appearance.lost_by_merging(codes, merged, actions, following) > 0.0


def _flat(state: AgentState) -> AgentState:
    """A snapshot whose codes are in one row: how many factors they are of changes as it learns."""
    codes = {name: array.ravel() for name, array in state.arrays.items() if name in ("replay/code", "replay/following")}
    return AgentState(arrays={**state.arrays, **codes}, values=state.values)


def _shown(frames: Frame | appearance.Images) -> appearance.Images:
    """Normal frames for people: hidden pixels are black."""
    return np.nan_to_num(frames.astype(np.float32))


def image(found: Sequence[appearance.SeenFactor], frames: Frame | appearance.Images) -> Pixels:
    """The mean of ``frames`` (N, 64, 64, 3) in gray, with a color a factor that was found. Shape (320, 320, 3)."""
    drawn = np.repeat(frames.mean(axis=(0, 3))[..., None], 3, axis=2)
    for factor, color in zip(found, _COLORS, strict=False):
        mask = np.any([part.mask for part in factor.parts], axis=0)
        drawn[mask] = 0.55 * drawn[mask] + 0.45 * color
    return drawn.round().astype(np.uint8).repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)


def make(context: AgentContext) -> LearnedPerceptionAgent:
    """The agent ``factored``, of whatever frames are 64 x 64."""
    settings = LEARNED.of(context)
    prepare_torch(context.device)
    perception = LearnedPerception(settings.perception, factored=settings.dynamics.factored)
    return LearnedPerceptionAgent(perception, context.n_actions, settings, context.seeds)
