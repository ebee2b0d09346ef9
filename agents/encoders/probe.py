"""An evaluation-only reader of the macrostate from latents. It sees labels; no agent learns from it or acts on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.arrays import Ints

from ..networks.mlp import initialise, relu_layers

HIDDEN = 256
"""Units of each hidden layer of the stored probe."""
_BATCH = 256
_LEARNING_RATE = 3e-3


class Latents(NamedTuple):
    """Posterior means and standard deviations of N frames. Each of shape (N, Z)."""

    mu: Tensor
    sigma: Tensor

    def sample(self, generator: torch.Generator) -> Tensor:
        """One draw of every frame's latents. Shape (N, Z)."""
        noise = torch.randn(self.mu.shape, generator=generator)
        return self.mu + self.sigma * noise.to(self.mu.device)


class Probe(nn.Module):
    """A classifier for every coordinate of the macrostate on shared features.

    Args:
        latent_size: Latents Z.
        cardinalities: Values of each of the M coordinates.
        hidden: Units of each of two hidden layers; 0 makes it linear.

    Its weights are undefined before :func:`train_probe`, or before they are loaded.
    """

    centre: Tensor
    scale: Tensor

    def __init__(self, latent_size: int, cardinalities: Sequence[int], hidden: int = HIDDEN) -> None:
        super().__init__()
        self.cardinalities = tuple(cardinalities)
        self.register_buffer("centre", torch.zeros(latent_size))
        self.register_buffer("scale", torch.ones(latent_size))
        sizes = (latent_size, hidden, hidden, sum(cardinalities)) if hidden else (latent_size, sum(cardinalities))
        self.layers = relu_layers(sizes)

    def logits(self, latents: Tensor) -> tuple[Tensor, ...]:
        """Unnormalised log probabilities of each coordinate's values. M tensors of shape (N, cardinality)."""
        joined = self.layers((latents - self.centre) / self.scale)  # [N, sum of cardinalities]
        return torch.split(joined, list(self.cardinalities), dim=1)

    @torch.no_grad()
    def read(self, latents: Tensor) -> Ints:
        """The most likely macrostates of ``latents`` (N, Z). Shape (N, M)."""
        return torch.stack([part.argmax(dim=1) for part in self.logits(latents)], dim=1).cpu().numpy()


def train_probe(probe: Probe, latents: Latents, macrostates: Ints, *, steps: int, generator: torch.Generator) -> None:
    """Fit ``probe`` in place, on the CPU, by cross-entropy to freshly sampled latents: it must read imagined ones too.

    ``macrostates`` (N, M) are the labels of ``latents`` (N, Z); ``generator`` draws weights, batches and latent noise.
    """
    initialise(probe, generator)
    probe.centre.copy_(latents.mu.mean(dim=0))
    probe.scale.copy_((latents.mu.var(dim=0) + latents.sigma.square().mean(dim=0)).sqrt().clamp_min(1e-6))
    labels = torch.from_numpy(macrostates)
    optimiser = torch.optim.Adam(probe.parameters(), lr=_LEARNING_RATE, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, T_max=steps)
    for _ in range(steps):
        rows = torch.randint(len(labels), (_BATCH,), generator=generator)
        sampled = Latents(latents.mu[rows], latents.sigma[rows]).sample(generator)
        parts = zip(probe.logits(sampled), labels[rows].T, strict=True)
        loss = torch.stack([functional.cross_entropy(logits, right) for logits, right in parts]).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def accuracy(probe: Probe, latents: Tensor, macrostates: Ints) -> float:
    """Fraction of ``latents`` (N, Z) whose whole macrostate (N, M) is read right."""
    return float((probe.read(latents) == macrostates).all(axis=1).mean())
