"""Frames to codes of factors: by an encoder that is given, or by factors that are found in an agent's own frames."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench.agents.encoders.perception import load_perception
from torch.nn import functional

from imagine_bench.arrays import Arrays, Frame, Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, AgentState
from imagine_bench.values import Json

from .factors import Code, Codes, Mask, Memory
from .seeing import appearance
from .seeing.standard import Standard, standard_of
from .settings import LearnedPerceptionSettings

_FIRST = 4
_RECENT = 4
"""Frames after which it looks for factors first; frames whose codes are kept."""


class CodePerception:
    """Frames to codes as the model takes them, and back; ``sizes`` are the numbers of values of the P factors.

    Where it is not ``factored``, the encoder's whole code is one factor.
    """

    memory: Memory | None = None
    """A code is the content of one frame; nothing is remembered."""

    def __init__(self, encoder: Encoder, *, factored: bool) -> None:
        self._encoder = encoder
        self._factored = factored
        self._encoded = encoder.card.code_sizes
        self.sizes = self._encoded if factored else (int(np.prod(self._encoded)),)
        self._last: tuple[bytes, Code] | None = None

    def code(self, frame: Frame) -> Code:
        """The code of a frame (64, 64, 3); the last one is kept, because often it is asked for twice."""
        key = frame.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self.codes(frame[None])[0])
        return self._last[1]

    def codes(self, frames: Frame) -> list[Code]:
        """The codes of frames (N, 64, 64, 3)."""
        hot = self._encoder.encode(frames)[0]  # [N, sum of the sizes]
        codes = torch.stack([values.argmax(dim=1) for values in hot.split(self._encoded, dim=1)], dim=1).numpy()
        return _rows(codes, self._encoded, factored=self._factored)

    def is_clear(self, frame: Frame) -> bool:
        """Whether the code of a frame is certain: an encoder does not say when it is not."""
        return True

    def latents(self, codes: Sequence[Code] | Codes) -> torch.Tensor:
        """N codes as the encoder decodes them: one-hot. Shape (N, sum of the encoder's sizes)."""
        rows = np.array(codes, dtype=np.int64).reshape(-1, len(self.sizes))
        values = rows.T if self._factored else np.unravel_index(rows[:, 0], self._encoded)
        pairs = zip(values, self._encoded, strict=True)
        return torch.cat([functional.one_hot(torch.tensor(value), size) for value, size in pairs], dim=1).float()

    def macrostates(self, codes: Sequence[Code] | Codes) -> Codes:
        """The evaluation probe's reading of N codes; the agent must not use it. Shape (N, M)."""
        return self._encoder.read_macrostate(self.latents(codes))

    def images(self, codes: Sequence[Code] | Codes) -> appearance.Images:
        """N codes as the encoder decodes them to images, for people."""
        return self._encoder.decode(self.latents(codes))


def load_code_perception(context: AgentContext, *, factored: bool) -> CodePerception:
    """The perception of an agent or a model that reads codes; InvalidValueError if the encoder gives none."""
    encoder = load_perception(context).encoder
    if not encoder.card.code_sizes:
        raise InvalidValueError(
            f"Codes of factors are needed, and encoder {encoder.card.recipe.name!r} gives continuous latents; "
            "give one made with `imagine-bench encoder --recipe codes`."
        )
    return CodePerception(encoder, factored=factored)


def _rows(codes: Codes, sizes: Sequence[int], *, factored: bool) -> list[Code]:
    """Codes (N, P) as tuples; where they are not ``factored``, as the numbers of whole codes."""
    rows = codes if factored else np.ravel_multi_index(tuple(codes.T), sizes)[:, None]
    return [tuple(row) for row in rows.tolist()]


class FrameCodes(NamedTuple):
    """The codes that N frames show, of P factors."""

    values: list[Code]
    known: Mask  #: whether the value of each factor was seen before. Shape (N, P).
    #: False where a part of any factor's region is hidden and two of its values fit nearly equally well. Shape (N,).
    clear: Mask


class _ReadFrame(NamedTuple):
    """The code of a frame, whether all of its values are known, and whether they are clear."""

    code: Code
    is_known: bool
    is_clear: bool


class FrameFactors(NamedTuple):
    """Factors, and the normal frame that they are seen in."""

    factors: list[appearance.SeenFactor]
    standard: Standard


def find_factors(frames: Frame, begins: Mask, actions: Ints) -> FrameFactors:
    """The factors of frames (N, 64, 64, 3) without nuisances; see :func:`.appearance.find`."""
    standard = standard_of(frames)
    return FrameFactors(appearance.find(standard.of(frames), begins, actions), standard)


class LearnedPerception:
    """Frames seen so far, and the codes that they have by the factors that were found in the first ``looked_at`` of
    them.
    """

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
        self.looked_at = 0
        """In how many of the first frames factors were looked for; ``found_in``: and found."""
        self.history: list[int] = []
        """The first ``found_in`` whenever it changed."""
        self.unknown = False
        """Whether anything seen since has no known value."""
        self._remembered = 0
        self.take(FrameFactors([], Standard()), 0)

    @property
    def seen_sizes(self) -> tuple[int, ...]:
        """Numbers of values of the factors; before any is found, of one factor of one value."""
        sizes = tuple(len(factor.joint) for factor in self.found) or (1,)
        return sizes if self._factored else (int(np.prod(sizes)),)

    @property
    def sizes(self) -> tuple[int, ...]:
        """The same, and last the remembered values, if there are any."""
        sizes = self.seen_sizes
        return sizes if self.memory is None else (*sizes, sizes[self.memory.factor])

    @property
    def full(self) -> bool:
        """Whether as many frames are remembered as may be, so that nothing is found anew."""
        return len(self.frames) >= self._settings.frames

    def begin_episode(self) -> None:
        """Forget the episode so far."""
        self.recall(self.memory.hidden if self.memory else 0)

    def recall(self, remembered: int) -> None:
        """Remember this of the episode so far."""
        self._remembered = remembered

    def code(self, frame: Frame) -> Code:
        """The code of the newest frame (64, 64, 3) of an episode, with the memory of those before."""
        read = self._read(frame)
        if self.memory is None:
            return read.code
        if read.is_clear:
            self._remembered = self.memory.after(self._remembered, read.code)
        return (*read.code, self._remembered)

    def is_clear(self, frame: Frame) -> bool:
        """False if a part of any factor's region is hidden and two of its values fit nearly equally well."""
        return self._read(frame).is_clear

    def _read(self, frame: Frame) -> _ReadFrame:
        """The code of a frame; the last ones are kept."""
        key = frame.tobytes()
        if key not in self._recent:
            codes = self.codes(frame[None])
            self._recent[key] = _ReadFrame(codes.values[0], bool(codes.known.all()), bool(codes.clear[0]))
            if len(self._recent) > _RECENT:
                self._recent.pop(next(iter(self._recent)))
        return self._recent[key]

    def codes(self, frames: Frame) -> FrameCodes:
        """The codes of frames (N, 64, 64, 3), without memory; before factors are found all are alike and clear."""
        if not self.found:
            known = np.zeros((len(frames), 1), dtype=bool)
            return FrameCodes([(0,)] * len(frames), known, np.ones(len(frames), dtype=bool))
        read = appearance.read(self.found, self.frame_factors.standard.of(frames))
        codes = _rows(read.values, [len(factor.joint) for factor in self.found], factored=self._factored)
        return FrameCodes(codes, read.known, np.asarray(read.clear.all(axis=1)))

    def remember(self, before: Frame, action: int, after: Frame, *, begins: bool = False) -> None:
        """Remember a transition; one that begins where the last one ended costs one frame."""
        new = [after] if self.frames and np.array_equal(self.frames[-1], before) else [before, after]
        self.frames += [frame.copy() for frame in new]
        self.unknown |= not all(self._read(frame).is_known for frame in new)
        self.transitions.append((len(self.frames) - 2, len(self.frames) - 1))
        self.begins.append(begins)
        self.actions.append(action)

    def renew(self) -> bool:
        """Look for factors anew if it is time; whether codes may now be others."""
        growth = self._settings.growth if self.unknown else self._settings.growth_if_known
        due = len(self.frames) >= max(_FIRST, growth * self.looked_at)
        if due:
            self.look(len(self.frames))
        return due

    def look(self, count: int) -> None:
        """Find factors in the first ``count`` frames remembered."""
        self.take(find_factors(*self.first(count)) if count else FrameFactors([], Standard()), count)
        self.looked_at = count
        self.unknown = False

    def first(self, count: int) -> tuple[Frame, Mask, Ints]:
        """The first ``count`` frames remembered, which begin an episode, and the actions then: as ``find`` asks."""
        begins = np.isin(np.arange(count), [before for before, _ in compress(self.transitions, self.begins)])
        actions = np.full(count, -1)
        for (before, after), action in zip(self.transitions, self.actions, strict=True):
            if after < count:
                actions[before] = action
        return np.stack(self.frames[:count]), begins, actions

    def take(self, frame_factors: FrameFactors, found_in: int) -> None:
        """See these factors from now on."""
        self.frame_factors = frame_factors
        self.found = frame_factors.factors
        self.found_in = found_in
        self.memory: Memory | None = None
        self._recent: dict[bytes, _ReadFrame] = {}

    def arrays(self) -> Arrays:
        """The frames that it remembers, and which are those of each transition."""
        return {
            "replay/frames": np.array(self.frames, dtype=np.uint8).reshape(-1, 64, 64, 3),
            "replay/frame_pairs": np.array(self.transitions, dtype=np.int64).reshape(-1, 2),
            "replay/begins": np.array(self.begins, dtype=bool),
        }

    def values(self) -> dict[str, Json]:
        """The part of a snapshot that belongs to :meth:`arrays`."""
        return {
            "looked_at": self.looked_at,
            "found_in": self.found_in,
            "history": list(self.history),
            "unknown": self.unknown,
            "memory": list(self.memory) if self.memory else None,
        }

    def load(self, state: AgentState) -> None:
        """Take up the parts that :meth:`arrays` and :meth:`values` gave, and the agent's ``replay/action``: find the
        same.
        """
        values = state.values
        self.frames = list(state.arrays["replay/frames"])
        self.transitions = [(before, after) for before, after in state.arrays["replay/frame_pairs"].tolist()]
        self.begins = state.arrays["replay/begins"].tolist()
        self.actions = state.arrays["replay/action"][: len(self.transitions)].tolist()
        self.look(values["found_in"])
        self.looked_at = values["looked_at"]
        self.unknown = values["unknown"]
        self.history = list(values["history"])
        self.memory = Memory(*values["memory"]) if values["memory"] else None

    def diagnostics(self) -> dict[str, float]:
        """How many factors and values it sees, in how many frames it found them, and how many it remembers."""
        sizes = self.sizes
        found = {"factors": len(sizes), "values": sum(sizes), "looked_at": self.looked_at, "frames": len(self.frames)}
        return {f"perception/{name}": float(value) for name, value in found.items()}
