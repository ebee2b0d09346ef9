"""The controller: Q-learning by a small network on latents (thesis 5.2.3; Mnih et al. 2015, no target network)."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from imagine_bench.errors import DivergedError

from .flat_adam import FlatAdam
from .layers import MemberMLP
from .memory import Batch
from .settings import ControllerSettings


def td_target(reward: Tensor, terminated: Tensor, q_next: Tensor, discount: float) -> Tensor:
    """One-step target ``r + gamma max_a Q(z', a)``.

    Termination stops bootstrapping; truncation does not, since ``terminated`` is 0 there.

    Args:
        reward: Shape (B,).
        terminated: 0 or 1. Shape (B,).
        q_next: Values of the next states. Shape (B, A).
        discount: Gamma a macro-action, in [0, 1].

    Returns:
        Targets. Shape (B,).
    """
    return reward + discount * (1.0 - terminated) * q_next.amax(dim=-1)


def epsilon(step: int, settings: ControllerSettings) -> float:
    """Exploration probability at real step ``step``: equation 3.3, from the maximum down to the minimum."""
    span = settings.epsilon_max - settings.epsilon_min
    return settings.epsilon_min + span * math.exp(-settings.epsilon_decay * step)


class Controller(nn.Module):
    """Action values of latents.

    Args:
        latent_size: Z.
        n_actions: A.
        settings: Sizes and rates.
        generator: Draws the initial weights; its device is the controller's.
    """

    def __init__(
        self, latent_size: int, n_actions: int, settings: ControllerSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.n_actions, self.settings = n_actions, settings
        sizes = (latent_size, *settings.hidden, n_actions)
        self.network = MemberMLP(sizes, members=1, dropout=0.0, generator=generator)
        self.optimiser = FlatAdam(
            [self.network], learning_rate=settings.learning_rate, gradient_clip=settings.gradient_clip
        )
        self._target = None if settings.target_rate == 1.0 else _Target(self.network, settings.target_rate)

    @torch.no_grad()
    def values(self, z: Tensor) -> Tensor:
        """Action values of latents (N, Z). Shape (N, A)."""
        return self.network(z.unsqueeze(0)).squeeze(0)

    def _next_values(self, next_z: Tensor) -> Tensor:
        return self.values(next_z) if self._target is None else self._target.values(next_z)

    def loss(self, batch: Batch) -> Tensor:
        """Mean squared Bellman error; no gradient flows through the target."""
        target = td_target(batch.reward, batch.terminated, self._next_values(batch.next_z), self.settings.discount)
        q = self.network(batch.z.unsqueeze(0)).squeeze(0).gather(1, batch.action.unsqueeze(1)).squeeze(1)  # [B]
        return (target - q).square().mean()

    def update(self, batch: Batch) -> float:
        """One step of Adam on a batch; returns the loss before it.

        Raises:
            DivergedError: The loss is NaN or infinite; the weights are left as they were.
        """
        loss = self.loss(batch)
        value = loss.item()
        if not math.isfinite(value):
            raise DivergedError(f"The controller's loss is {value}. Lower controller.learning_rate.")
        self.optimiser.step(loss)
        if self._target is not None:
            self._target.follow()
        return value

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies of weights and moments, and of the target network's weights where there is one."""
        target = {} if self._target is None else {"target": self._target.array()}
        return {**self.optimiser.arrays(), **target}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take up the result of :meth:`arrays`."""
        self.optimiser.load(arrays)
        if self._target is not None:
            self._target.load(arrays["target"])


class _Target:
    """A copy of a network that follows it slowly: targets that move less under the feet of what chases them.

    Args:
        source: What it follows.
        rate: Share of the way it goes at each call of :meth:`follow` (Lillicrap et al. 2016, their tau).
    """

    def __init__(self, source: MemberMLP, rate: float) -> None:
        self._source, self._copy, self._rate = source, copy.deepcopy(source).requires_grad_(False), rate

    @torch.no_grad()
    def values(self, z: Tensor) -> Tensor:
        return self._copy(z.unsqueeze(0)).squeeze(0)

    @torch.no_grad()
    def follow(self) -> None:
        for mine, theirs in zip(self._copy.parameters(), self._source.parameters(), strict=True):
            mine.lerp_(theirs, self._rate)

    def array(self) -> NDArray[Any]:
        return torch.cat([weight.reshape(-1) for weight in self._copy.parameters()]).cpu().numpy().copy()

    @torch.no_grad()
    def load(self, array: NDArray[Any]) -> None:
        parts = torch.tensor(array).split([weight.numel() for weight in self._copy.parameters()])
        for weight, part in zip(self._copy.parameters(), parts, strict=True):
            weight.copy_(part.view(weight.shape))
