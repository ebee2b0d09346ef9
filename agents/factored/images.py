"""What was imagined in codes, as pictures and numbers for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from imagine_bench.capabilities import ImaginedRollout

from ..encoders.encoder import Encoder

KEPT = 0.5
"""A transition of which more than this is unknown is doubted, and what follows from it too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Imagined:
    """One imagined step.

    Attributes:
        action: The macro-action.
        code: The code it leads to.
        reward: Expected reward.
        p_terminated: Probability that the episode ends.
        values: Worth of every action before it. Shape (A,).
        unknown: Probability that something untested decides.
        otherwise: Probability that it leads elsewhere than to the likeliest code.
    """

    action: int
    code: tuple[int, ...]
    reward: float
    p_terminated: float
    values: NDArray[np.float64]
    unknown: float
    otherwise: float


def picture(encoder: Encoder, start: tuple[int, ...], steps: Sequence[Imagined]) -> ImaginedRollout:
    """The rollout that bench and recordings show: codes decoded to pictures, and read by the evaluation's probe."""
    latents = one_hot(np.array([start, *(step.code for step in steps)]), encoder.card.code_sizes)
    frames = encoder.decode(latents)
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
        modal=np.array([step.otherwise for step in steps], dtype=np.float32),
        accepted=np.logical_and.accumulate(unknown <= KEPT),
        macrostates=encoder.read_macrostate(latents[1:]),
    )


def one_hot(codes: NDArray[np.int64], sizes: tuple[int, ...]) -> torch.Tensor:
    """Codes (N, P), whose parts have so many values, as what the encoder decodes. Shape (N, sum(sizes))."""
    parts = zip(torch.as_tensor(codes).unbind(dim=1), sizes, strict=True)
    return torch.cat([functional.one_hot(part, size) for part, size in parts], dim=1).float()
