"""Perception learned from an agent's own frames: factors and values are found anew as more is seen."""

from __future__ import annotations

from collections import OrderedDict
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import AgentState, Frame
from imagine_bench.values import Json

from . import appearance
from .factors import Code, Memory
from .settings import LearnedPerceptionSettings

_FIRST = 4
_RECENT = 4
"""Frames after which it looks for factors first; frames whose codes are kept."""


class LearnedPerception:
    """Frames seen so far, and the codes that they have by what was found in the first ``looked_at`` of them."""

    def __init__(self, settings: LearnedPerceptionSettings, *, factored: bool) -> None:
        self._settings = settings
        self._factored = factored
        self.frames: list[Frame] = []
        self.transitions: list[tuple[int, int]] = []
        """Frames before and after of each transition, as long as all are remembered."""
        self.begins: list[bool] = []
        """Whether each of these is the first of an episode."""
        self.actions: list[int] = []
        """The macro-action of each."""
        self.found: list[appearance.SeenFactor] = []
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
        codes, known = appearance.read(self.found, frames)
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
        seen = len(self.frames)
        settings = self._settings
        growth = settings.growth if self.unknown else settings.growth_if_known
        if seen < max(_FIRST, growth * self.looked_at):
            return False
        self.look(seen)
        return True

    def look(self, count: int) -> None:
        """Find factors in the first ``count`` frames remembered."""
        self.take(appearance.find(*self.first(count)) if count else [], count)
        self.looked_at = count
        self.unknown = False

    def first(self, count: int) -> tuple[Frame, NDArray[np.bool_], NDArray[np.int64]]:
        """The first ``count`` frames remembered, which begin an episode, and what was done then: as ``find`` asks."""
        begins = np.isin(np.arange(count), [before for before, _ in compress(self.transitions, self.begins)])
        actions = np.full(count, -1)
        for (before, after), action in zip(self.transitions, self.actions, strict=True):
            if after < count:
                actions[before] = action
        return np.stack(self.frames[:count]), begins, actions

    def take(self, found: list[appearance.SeenFactor], found_in: int) -> None:
        """See these factors from now on."""
        self.found = found
        self.found_in = found_in
        self.memory = None
        self._recent.clear()

    def arrays(self) -> Arrays:
        """The frames that it remembers, and which are those of each transition."""
        seen = np.stack(self.frames) if self.frames else np.zeros((0, 64, 64, 3), dtype=np.uint8)
        pairs: NDArray[np.int64] = np.array(self.transitions, dtype=np.int64).reshape(-1, 2)
        return {
            "replay/frames": seen,
            "replay/frame_pairs": pairs,
            "replay/begins": np.array(self.begins, dtype=np.bool_),
        }

    def values(self) -> dict[str, Json]:
        """What belongs to :meth:`arrays` in a snapshot."""
        memory = None if self.memory is None else [self.memory.factor, self.memory.hidden]
        return {
            "looked_at": self.looked_at,
            "found_in": self.found_in,
            "history": list(self.history),
            "unknown": self.unknown,
            "memory": memory,
        }

    def load(self, state: AgentState) -> None:
        """Take up what :meth:`arrays` and :meth:`values` gave, and the agent's ``replay/action``: find the same."""
        self.frames = list(state.arrays["replay/frames"])
        self.transitions = [(before, after) for before, after in state.arrays["replay/frame_pairs"].tolist()]
        self.begins = state.arrays["replay/begins"].tolist()
        self.actions = state.arrays["replay/action"][: len(self.transitions)].tolist()
        self.look(state.values["found_in"])
        self.looked_at = state.values["looked_at"]
        self.unknown = state.values["unknown"]
        memory = state.values["memory"]
        self.history = list(state.values["history"])
        self.memory = Memory(*memory) if memory else None

    def diagnostics(self) -> dict[str, float]:
        """How many factors and values it sees, in how many frames it found them, and how many it remembers."""
        sizes = self.sizes
        found = {"factors": len(sizes), "values": sum(sizes), "looked_at": self.looked_at, "frames": len(self.frames)}
        return {f"perception/{name}": float(value) for name, value in found.items()}
