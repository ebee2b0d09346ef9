"""CPU seconds of code of the agents (``"ours"``) beside the plain torch that an expert would write (``"plain"``)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import torch
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS, WorldModelSettings
from imagine_bench.agents.imagination.world_model import EnvironmentModel, log_cosh
from imagine_bench.agents.replay import Batch
from imagine_bench_regression.regressor import MixtureRegressor
from imagine_bench_regression.settings import RegressorSettings
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.interfaces.regression import RegressionData, RegressorContext
from imagine_bench.seeding import SeedTree

LATENTS, ACTIONS = 24, 6
"""Those of the arrow puzzle's bundled encoders."""


def least_cpu_s(actions: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Least CPU seconds of each action, taken in turn: noise on a shared machine only ever adds."""
    least = dict.fromkeys(actions, float("inf"))
    for _ in range(rounds):
        for name, action in actions.items():
            start = time.process_time()
            action()
            least[name] = min(least[name], time.process_time() - start)
    return least


class _PlainMLP(nn.Module):
    """E ReLU networks as one ``baddbmm`` a layer, with a Bernoulli draw a unit for dropout."""

    def __init__(self, sizes: tuple[int, ...], members: int, dropout: float, draws: torch.Generator) -> None:
        super().__init__()
        self.dropout = dropout
        self.draws = draws
        shapes = [(members, *pair) for pair in pairwise(sizes)]
        self.weights = nn.ParameterList(nn.init.normal_(torch.empty(shape), 0.0, 0.1, draws) for shape in shapes)
        self.biases = nn.ParameterList(torch.zeros(members, 1, n_out) for n_out in sizes[1:])

    def forward(self, x: Tensor) -> Tensor:
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for inner, shift in hidden:
            x = torch.baddbmm(shift, x, inner).relu()
            if self.dropout > 0.0:
                kept = torch.empty_like(x).bernoulli_(1.0 - self.dropout, generator=self.draws)
                x = x * kept.div_(1.0 - self.dropout)
        return torch.baddbmm(bias, x, weight)


class PlainWorldModel:
    """The world model in the plain torch that an expert would write: autograd, a member axis, fused Adam, float32.

    The reward and termination networks must read the next state, and share no layers.
    """

    def __init__(self, latents: int, actions: int, settings: WorldModelSettings, draws: torch.Generator) -> None:
        self.latents, self.actions, self.settings = latents, actions, settings
        outputs = mdn.output_size(settings.components, latents)
        shapes = [
            ((latents + actions, *settings.dynamics_hidden, outputs), settings.members),
            ((latents, *settings.reward_hidden, 1), 1),
            ((latents, *settings.termination_hidden, 1), 1),
        ]
        self.networks = [_PlainMLP(sizes, members, settings.dropout, draws) for sizes, members in shapes]
        self._adam = torch.optim.Adam(nn.ModuleList(self.networks).parameters(), settings.learning_rate, fused=True)

    def losses(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Losses of the dynamics (summed over members), reward and termination on a batch."""
        settings = self.settings
        dynamics, reward, termination = self.networks
        inputs = torch.cat([batch.z, functional.one_hot(batch.action, self.actions).float()], dim=-1)
        outputs = dynamics(inputs.expand(settings.members, -1, -1))
        mixture = mdn.from_outputs(outputs, settings.components, self.latents, math.log(settings.sigma_floor))
        if settings.predict_change:
            mixture = replace(mixture, means=mixture.means + batch.z.unsqueeze(1))
        r, logit = (network(batch.next_z.unsqueeze(0))[0, :, 0] for network in (reward, termination))
        return (
            -mdn.log_likelihood(mixture, batch.next_z).mean(dim=1).sum(),
            log_cosh(r - batch.reward / settings.reward_scale).mean(),
            functional.binary_cross_entropy_with_logits(logit, batch.terminated),
        )

    def update(self, batch: Batch) -> None:
        """One step of Adam on all networks, then the max-norm constraint."""
        self._adam.zero_grad()
        torch.stack(self.losses(batch)).sum().backward()
        for network in self.networks:
            if self.settings.gradient_clip is not None:
                nn.utils.clip_grad_norm_(network.parameters(), self.settings.gradient_clip)
        self._adam.step()
        if self.settings.max_norm is None:
            return
        with torch.no_grad():
            for weight in [weight for network in self.networks for weight in network.weights]:
                norm = weight.norm(dim=1, keepdim=True).clamp_min(1e-12)
                weight.mul_((self.settings.max_norm / norm).clamp_max(1.0))


def model_update(hyperparameters: str, rounds: int = 25) -> dict[str, float]:
    """One update of the world model with a set of hyperparameters of chapter 5, on one thread."""
    prepare_torch("cpu")
    settings = HYPERPARAMETERS.resolve(hyperparameters, {}, "chapter_5").model
    draws = torch.Generator().manual_seed(0)
    rows = settings.batch_size
    batch = Batch(
        z=torch.randn(rows, LATENTS, generator=draws),
        action=torch.randint(ACTIONS, (rows,), generator=draws),
        reward=torch.randn(rows, generator=draws),
        next_z=torch.randn(rows, LATENTS, generator=draws),
        terminated=(torch.rand(rows, generator=draws) < 0.3).float(),
    )
    plain = PlainWorldModel(LATENTS, ACTIONS, settings, draws)
    own = EnvironmentModel(LATENTS, ACTIONS, settings, draws)
    return least_cpu_s({"plain": lambda: plain.update(batch), "ours": lambda: own.update(batch, draws)}, rounds)


def training(networks: int, rows: int, updates: int, rounds: int) -> dict[str, float]:
    """A number of updates of E regressors: as one batch, and one network after another."""
    draws = torch.Generator().manual_seed(0)
    x = torch.randn(networks, rows, 2, generator=draws)
    y = torch.randn(networks, rows, 3, generator=draws)
    data = RegressionData(inputs=x[0].double().numpy(), targets=y[0].double().numpy())

    def updating(count: int) -> Callable[[], object]:
        """Updates of all networks, so many at a time."""
        context = RegressorContext(datasets=(data,) * count, seeds=tuple(map(SeedTree, range(count))))
        models = [MixtureRegressor(context, RegressorSettings(precision="auto")) for _ in range(networks // count)]
        parts = list(zip(models, x.split(count), y.split(count), strict=True))
        return lambda: [model.update(*data) for model, *data in parts for _ in range(updates)]

    return least_cpu_s({"ours": updating(networks), "plain": updating(1)}, rounds)
