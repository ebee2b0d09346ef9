"""The world model as one would first write it in PyTorch: the measure of how fast the other is, and its oracle.

Ordinary modules, autograd, float32, a Bernoulli draw a unit for dropout, one Adam a network. It trains nothing in a
bench.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..imagination import mixture as mdn
from ..imagination.world_model import log_cosh
from ..networks.weights import initialise
from ..replay import Batch
from ..settings import WorldModelSettings


class PlainWorldModel:
    """Dynamics, reward and termination, trained as :class:`agents.imagination.world_model.WorldModel` is.

    Args:
        latent_size: Z.
        n_actions: A.
        settings: Sizes and rates; the defaults of the thesis, which clip no gradient and predict z', are required.
        generator: Draws the initial weights and the dropout masks.
    """

    def __init__(
        self, latent_size: int, n_actions: int, settings: WorldModelSettings, generator: torch.Generator
    ) -> None:
        self.latent_size, self.n_actions, self.settings = latent_size, n_actions, settings
        self._max_norm = math.inf if settings.max_norm is None else settings.max_norm
        outputs = mdn.output_size(settings.components, latent_size)
        self.dynamics = _network(
            (latent_size + n_actions, *settings.dynamics_hidden, outputs), settings.dropout, generator
        )
        self.reward = _network((latent_size, *settings.reward_hidden, 1), settings.dropout, generator)
        self.termination = _network((latent_size, *settings.termination_hidden, 1), settings.dropout, generator)
        self.networks = (self.dynamics, self.reward, self.termination)
        self._adams = [torch.optim.Adam(net.parameters(), lr=settings.learning_rate) for net in self.networks]

    def losses(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Mean losses of the three networks on one batch."""
        settings = self.settings
        inputs = torch.cat([batch.z, functional.one_hot(batch.action, self.n_actions).float()], dim=-1)
        floor = math.log(settings.sigma_floor)
        mixture = mdn.from_outputs(self.dynamics(inputs), settings.components, self.latent_size, floor)
        reward, logit = self.reward(batch.next_z).squeeze(-1), self.termination(batch.next_z).squeeze(-1)
        return (
            -mdn.log_likelihood(mixture, batch.next_z).mean(),
            log_cosh(reward - batch.reward).mean(),
            functional.binary_cross_entropy_with_logits(logit, batch.terminated),
        )

    def update(self, batch: Batch) -> None:
        """One step of each Adam, then the max-norm constraint."""
        for loss, adam in zip(self.losses(batch), self._adams, strict=True):
            adam.zero_grad()
            loss.backward()
            adam.step()
        with torch.no_grad():
            for network in self.networks:
                for layer in network:
                    if isinstance(layer, nn.Linear):
                        layer.weight.copy_(torch.renorm(layer.weight, p=2, dim=0, maxnorm=self._max_norm))


class _Dropout(nn.Module):
    """``nn.Dropout``, whose draws come from a passed generator."""

    def __init__(self, probability: float, generator: torch.Generator) -> None:
        super().__init__()
        self._kept, self._generator = 1.0 - probability, generator

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.empty_like(x).bernoulli_(self._kept, generator=self._generator).div_(self._kept)


def _network(sizes: tuple[int, ...], dropout: float, generator: torch.Generator) -> nn.Sequential:
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes):
        layers += [nn.Linear(n_in, n_out), nn.ReLU(), _Dropout(dropout, generator)]
    network = nn.Sequential(*layers[:-2])
    initialise(network, generator)
    return network
