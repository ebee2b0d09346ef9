"""Frames to codes of factors, and imagined codes back to images and macrostates for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, Floats, Frame
from imagine_bench.interfaces.capabilities import ImaginedRollout

from ..encoders.encoder import Encoder
from ..encoders.perception import load_perception
from .factors import Code

ACCEPTED = 0.5
"""A transition of which more than this is unknown is not accepted, and neither is what follows from it."""


@dataclass(frozen=True, slots=True)
class ImaginedCode:
    """One imagined transition to ``code``, with expected reward and the probability that the episode ends."""

    action: int
    code: Code
    reward: float
    p_terminated: float
    values: Floats  #: value of every action before it. Shape (A,).
    unknown: float  #: probability that something untested decides
    p_other: float  #: probability that it leads elsewhere than to the likeliest code


class CodePerception:
    """Frames to codes as the model takes them, and back; ``sizes`` are the numbers of values of the P factors.

    Where it is not ``factored``, the encoder's whole code is one factor.
    """

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
        rows = torch.stack([values.argmax(dim=1) for values in hot.split(self._encoded, dim=1)], dim=1).tolist()
        return [tuple(row) if self._factored else (int(np.ravel_multi_index(row, self._encoded)),) for row in rows]

    def _latents(self, codes: Sequence[Code]) -> torch.Tensor:
        """N codes as the encoder decodes them: one-hot. Shape (N, sum of the encoder's sizes)."""
        if self._factored:
            values = list(np.array(codes, dtype=np.int64).reshape(-1, len(self._encoded)).T)
        else:
            values = list(np.unravel_index(np.array(codes, dtype=np.int64).ravel(), self._encoded))
        pairs = zip(values, self._encoded, strict=True)
        return torch.cat([functional.one_hot(torch.as_tensor(value), size) for value, size in pairs], dim=1).float()

    def macrostates(self, codes: Sequence[Code]) -> NDArray[np.int64]:
        """What the evaluation's probe reads from N codes; the agent must not use it. Shape (N, M)."""
        return self._encoder.read_macrostate(self._latents(codes))

    def rollout(self, start: Code, steps: Sequence[ImaginedCode]) -> ImaginedRollout:
        """The rollout that bench and recordings show: codes decoded to images, and read by the evaluation's probe."""
        codes = [start, *(step.code for step in steps)]
        frames = self._encoder.decode(self._latents(codes))
        unknown = np.array([step.unknown for step in steps], dtype=np.float32)
        return ImaginedRollout(
            actions=np.array([step.action for step in steps], dtype=np.int64),
            frames=frames[1:],
            start_frame=frames[0],
            rewards=np.array([step.reward for step in steps], dtype=np.float32),
            p_terminated=np.array([step.p_terminated for step in steps], dtype=np.float32),
            q_values=np.array([step.values for step in steps], dtype=np.float32),
            epistemic=unknown,
            aleatoric=np.zeros_like(unknown),
            modal=np.array([step.p_other for step in steps], dtype=np.float32),
            accepted=np.logical_and.accumulate(unknown <= ACCEPTED),
            macrostates=self.macrostates(codes[1:]),
        )


def load_code_perception(context: AgentContext, *, factored: bool) -> CodePerception:
    """The perception of an agent that reads codes; InvalidValueError if the context's encoder gives none."""
    encoder = load_perception(context).encoder
    if not encoder.card.code_sizes:
        raise InvalidValueError(
            f"This agent reads codes of factors, and encoder {encoder.card.recipe.name!r} gives continuous latents; "
            "give one made with `imagine-bench encoder --recipe codes`."
        )
    return CodePerception(encoder, factored=factored)
