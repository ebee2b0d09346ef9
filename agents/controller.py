"""The controller: Q-learning by a small network on latents (thesis 5.2.2; Mnih et al. 2015).

A target network, which the thesis has not, only where settings want one.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from imagine_bench.bench.cohort import answer_each, together
from imagine_bench.errors import DivergedError

from .networks import joint
from .networks.flat_adam import FlatAdam
from .networks.mlp import MemberMLP, Parameters
from .replay import Batch
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
        self.target = None if settings.target_rate == 1.0 else _Target(self.network, settings.target_rate)

    @torch.no_grad()
    def values(self, z: Tensor) -> Tensor:
        """Action values of latents (N, Z). Shape (N, A)."""
        return self.network(z.unsqueeze(0)).squeeze(0)

    def update(self, batch: Batch) -> float:
        """One step of Adam on a batch; returns the loss before it.

        Raises:
            DivergedError: The loss is NaN or infinite; the weights are left as they were.
        """
        return together(update_together, (self, batch), kind=(self.settings, self.network.sizes))

    def descend(self, loss: float, gradient: Tensor) -> float:
        """What follows from the gradient (P,) of a loss: Adam, and the target network. Raises as :meth:`update`."""
        if not math.isfinite(loss):
            raise DivergedError(f"The controller's loss is {loss}. Lower controller.learning_rate.")
        self.optimiser.descend(gradient)
        if self.target is not None:
            self.target.follow()
        return loss

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies of weights and moments, and of the target network's weights where there is one."""
        target = {} if self.target is None else {"target": self.target.array()}
        return {**self.optimiser.arrays(), **target}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take up the result of :meth:`arrays`."""
        self.optimiser.load(arrays)
        if self.target is not None:
            self.target.load(arrays["target"])


def bellman_errors(controllers: Sequence[Controller], batch: Batch, parameters: Parameters) -> Tensor:
    """Mean squared Bellman errors of S controllers of one shape; no gradient flows through the targets.

    Args:
        controllers: S of them.
        batch: Theirs, every shape with a leading S.
        parameters: Theirs, with a leading S.

    Returns:
        Shape (1, S).
    """
    network, settings = controllers[0].network, controllers[0].settings
    with torch.no_grad():
        targets = [other.target for other in controllers if other.target is not None]
        if targets:
            q_next = torch.stack([target.values(z) for target, z in zip(targets, batch.next_z, strict=True)])
        else:
            q_next = network(batch.next_z, None, parameters)
    target = td_target(batch.reward, batch.terminated, q_next, settings.discount)
    q = network(batch.z, None, parameters).gather(2, batch.action.unsqueeze(2)).squeeze(2)  # [S, B]
    return (target - q).square().mean(dim=1).unsqueeze(0)


def update_together(updates: Sequence[tuple[Controller, Batch]]) -> list[float | Exception]:
    """Update controllers of one shape by one joint gradient; see :meth:`Controller.update`."""
    controllers = [controller for controller, _ in updates]
    batch = joint.batches([part for _, part in updates])
    losses, gradients = joint.gradients(
        [controller.optimiser for controller in controllers],
        lambda parameters: bellman_errors(controllers, batch, parameters),
    )
    return answer_each(Controller.descend, list(zip(controllers, losses[0].tolist(), gradients, strict=True)))


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
