"""Frames to symbols and back, by an encoder that is given."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import torch
from imagine_bench.agents.encoders.perception import load_perception, prepare_torch
from numpy.typing import NDArray
from torch.nn import functional

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, Frame, State

_MOST = 200_000
"""Codes up to which every one is read, so that each macrostate can be drawn."""


class Symbols:
    """The codes of frames, or the macrostates that the encoder's probe reads in codes.

    Args:
        context: Names the encoder.
        kind: ``"codes"`` or ``"macrostates"``.

    Raises:
        InvalidValueError: The encoder gives no codes.
    """

    def __init__(self, context: AgentContext, kind: str) -> None:
        prepare_torch(context.device)
        self._encoder = load_perception(context).encoder
        self._reads = kind == "macrostates"
        self._of_code = self._encoder.card.code_sizes
        if not self._of_code:
            raise InvalidValueError("Programs need an encoder that gives codes; give one whose name ends in -codes.")
        self.sizes = self._encoder.card.cardinalities if self._reads else self._of_code
        """Numbers of values of the factors."""
        self._codes: dict[State, State] = {}
        """A code of each macrostate."""

    def read(self, frames: Frame) -> list[State]:
        """The symbols of frames (N, 64, 64, 3); a macrostate is drawn as the first frame in which it was read."""
        hot = self._encoder.encode(frames)[0]
        each = [values.argmax(dim=1) for values in hot.split(self._of_code, dim=1)]
        codes = [tuple(row) for row in torch.stack(each, dim=1).tolist()]
        symbols = self._symbols(codes)
        for state, code in zip(symbols, codes, strict=True):
            self._codes.setdefault(state, code)
        return symbols

    def macrostates(self, states: Sequence[State]) -> NDArray[np.int64]:
        """The macrostates that the encoder's probe reads in N symbols. Shape (N, M)."""
        if self._reads:
            return np.array(states, dtype=np.int64).reshape(-1, len(self.sizes))
        return self._encoder.read_macrostate(self._hot(states))

    def images(self, states: Sequence[State]) -> NDArray[np.uint8]:
        """Images of symbols, N of them; black where no code shows them. Shape (N, H, W) or (N, H, W, 3)."""
        if self._reads and not self._codes.keys() >= {*states} and math.prod(self._of_code) <= _MOST:
            every = list(itertools.product(*map(range, self._of_code)))
            for state, code in zip(self._symbols(every), every, strict=True):
                self._codes.setdefault(state, code)
        none = (0,) * len(self._of_code)
        codes = [self._codes.get(state, none) for state in states] if self._reads else states
        drawn = (self._encoder.decode(self._hot(codes)) * 255.0).round().astype(np.uint8)
        if self._reads:
            drawn[[state not in self._codes for state in states]] = 0
        return drawn

    def _symbols(self, codes: Sequence[State]) -> list[State]:
        """The symbols of codes."""
        if not self._reads:
            return list(codes)
        return [tuple(row) for row in self._encoder.read_macrostate(self._hot(codes)).tolist()]

    def _hot(self, codes: Sequence[State]) -> torch.Tensor:
        """Codes as the encoder decodes them: one-hot. Shape (N, sum of their sizes)."""
        columns = torch.tensor(codes, dtype=torch.int64).reshape(-1, len(self._of_code)).T
        each = [functional.one_hot(column, size) for column, size in zip(columns, self._of_code, strict=True)]
        return torch.cat(each, dim=1).float()
