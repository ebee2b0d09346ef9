"""The Bayesian mixture density network (Bishop 1994; thesis 4.4): any inputs, any outputs, weights that are uncertain.

Many networks of one shape train as one batched computation; each has its own generators, so a network is the
same, up to rounding, whether it trains alone or among others. Shapes: ``E`` networks, ``N`` rows, ``X`` inputs,
``D`` outputs, ``K`` components, ``T`` weight samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from imagine_bench.errors import DivergedError

from ..imagination import mixture as mdn
from ..imagination.mixture import Mixture
from ..networks.adam import Adam
from ..networks.mlp import MemberMLP, clip_member_gradients
from ..networks.normed_mlp import NormedMLP
from ..networks.precision import hidden_dtype
from .settings import MDNSettings


class BayesianMDN:
    """E mixture density networks of X inputs and D outputs, trained side by side.

    Each has a generator, of its initial weights, then of its dropout masks.
    """

    def __init__(
        self, n_inputs: int, n_outputs: int, settings: MDNSettings, generators: Sequence[torch.Generator]
    ) -> None:
        self.n_outputs = n_outputs
        self.settings = settings
        self._generators = generators
        sizes = (n_inputs, *settings.hidden, mdn.output_size(settings.components, n_outputs))
        precision = hidden_dtype(settings.precision, generators[0].device.type)
        self.network = NormedMLP(sizes, generators=generators, dropout=settings.dropout, precision=precision)
        hidden = [*self.network.weights[:-1], *self.network.biases[:-1]]
        output = [self.network.weights[-1], self.network.biases[-1]]
        self.optimiser = Adam([(hidden, settings.weight_decay), (output, 0.0)], settings.learning_rate)

    def mixture(self, outputs: Tensor) -> Mixture:
        """Network outputs (..., out) as mixtures."""
        settings = self.settings
        floor = math.log(settings.sigma_floor)
        ceiling = math.log(settings.sigma_ceiling)
        return mdn.from_outputs(outputs, settings.components, self.n_outputs, floor, ceiling)

    def update(self, x: Tensor, y: Tensor) -> Tensor:
        """One step of Adam on the mean negative log-likelihood of each network's own batch (equation 4.28).

        From ``x`` (E, N, X) and ``y`` (E, N, D) to the losses (E,) before the step, in nats.

        Raises:
            DivergedError: A loss or gradient is NaN or infinite; weights and statistics are left as they were.
        """
        masks = self.network.draw_masks(x.shape[1], self._generators)
        outputs = self.network(x.mT.contiguous(), masks).mT  # [E, N, out]
        losses = -mdn.log_likelihood(self.mixture(outputs), y).mean(dim=1)  # [E]
        if not bool(losses.isfinite().all()):
            wrong = [index for index, loss in enumerate(losses.tolist()) if not math.isfinite(loss)]
            raise DivergedError(
                f"The likelihood of network {wrong[0]} of {len(losses)} is no longer finite "
                f"({losses[wrong[0]].item()}). Lower learning_rate or raise sigma_floor."
            )
        self.optimiser.zero_grad()
        losses.sum().backward()
        norms = clip_member_gradients(self.network, self.settings.gradient_clip)
        if not bool(norms.isfinite().all()):
            raise DivergedError(
                f"Gradients are no longer finite: their norms are {norms.tolist()}. Lower learning_rate."
            )
        self.optimiser.step()
        self.network.update_running_stats()
        return losses.detach()


def members(network: MemberMLP, first: int, count: int) -> MemberMLP:
    """Members ``first`` to ``first + count`` of a network by themselves."""
    blank = torch.Generator(device=network.weights[0].device)
    part = MemberMLP(network.sizes, members=count, dropout=network.dropout, generator=blank)
    with torch.no_grad():
        for whole, own in zip(network.parameters(), part.parameters(), strict=True):
            own.copy_(whole[first : first + count])
    return part
