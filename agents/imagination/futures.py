"""Many imagined futures of the same beginnings, read by the evaluation-only probe: for the bench, not the agent."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.capabilities import Follow, SampledFutures
from imagine_bench.interfaces import Frame

from ..encoders.encoder import Encoder
from .rollouts import TERMINAL, Imagination, Weights

_PREDICTIONS = 20_000
"""Mixtures predicted at once, over weight samples and rows, to bound memory."""


def sample_futures(
    imagination: Imagination, encoder: Encoder, frames: Frame, actions: NDArray[np.int64], follow: Follow, samples: int,
    depth: int, rng: np.random.Generator,
) -> SampledFutures:  # fmt: skip
    """Imagine D macro-actions of S futures of R rows; see :class:`imagine_bench.capabilities.FutureSampler`.

    The filter is not asked. Frames are (R, 64, 64, 3), first macro-actions (R,); ``follow`` chooses the later ones.
    """
    generator = torch.Generator(encoder.device).manual_seed(int(rng.integers(2**63)))
    z = encoder.encode(frames)[0].repeat_interleave(samples, dim=0)  # [R S, Z]
    action = np.repeat(actions, samples)  # [R S]
    macrostates, ended = encoder.read_macrostate(z), np.zeros(len(action), dtype=np.bool_)
    weights = imagination.draw_weights(generator)
    read, earned, over = [], [], []
    for _ in range(depth):
        rewards = np.zeros(len(action), dtype=np.float32)
        alive = np.flatnonzero(~ended & (action >= 0))
        if alive.size:
            rows = torch.from_numpy(alive).to(z.device)
            next_z, reward, p_terminated = predict(imagination, z[rows], action[alive], weights, generator)
            z[rows] = next_z
            macrostates[alive] = encoder.read_macrostate(next_z)
            rewards[alive], ended[alive] = reward.cpu().numpy(), (p_terminated > TERMINAL).cpu().numpy()
            action[alive] = follow(macrostates[alive])
        read.append(macrostates.copy())
        earned.append(rewards)
        over.append(ended.copy())
    shape = (depth, len(frames), samples)
    return SampledFutures(
        macrostates=np.stack(read).reshape(*shape, -1),
        rewards=np.stack(earned).reshape(shape),
        ended=np.stack(over).reshape(shape),
    )


def predict(
    imagination: Imagination, z: Tensor, action: NDArray[np.int64], weights: Weights, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Next latents (N, Z), rewards (N,) and P(terminal) (N,), in pieces that fit the memory."""
    model, settings = imagination.model, imagination.settings
    samples = model.members * (1 if weights.dynamics is None else settings.weight_samples)
    size = max(1, _PREDICTIONS // samples)
    parts = zip(z.split(size), torch.from_numpy(action).to(z.device).split(size), strict=True)
    steps = [imagination.step(*part, weights, generator) for part in parts]
    next_z, rewards, ends = zip(*((step.next_z, step.reward, step.p_terminated) for step in steps), strict=True)
    return torch.cat(next_z), torch.cat(rewards), torch.cat(ends)
