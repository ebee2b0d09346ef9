"""The environment model: a mixture density network for the dynamics, and what the next state means (thesis 5.2.3).

``p(z' | z, a)`` says where a macro-action leads; :mod:`.assessment` what it earns and whether the episode ends there.
Networks share no weights (but reward and termination, where they have one trunk); one backward pass through the sum of
the losses trains them all. The dynamics may be an ensemble of E networks, which a leading member axis trains as one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.errors import DivergedError

from . import mixture as mdn
from .assessment import Assessment
from .flat_adam import FlatAdam
from .layers import Masks, MemberMLP, clip_unit_norms
from .memory import Batch
from .mixture import Mixture
from .precision import hidden_dtype
from .settings import WorldModelSettings


@dataclass(frozen=True, slots=True)
class ModelLosses:
    """Means over a batch: negative log-likelihood (nats), log-cosh (of reward units), cross-entropy (nats)."""

    dynamics: float
    reward: float
    termination: float


def log_cosh(x: Tensor) -> Tensor:
    """``log(cosh(x))`` without overflow: quadratic near 0, linear far away."""
    size = x.abs()
    return size + functional.softplus(-2.0 * size) - math.log(2.0)


class WorldModel(nn.Module):
    """Dynamics, reward and termination, trained together from batches of transitions.

    Args:
        latent_size: Z.
        n_actions: A.
        settings: Sizes and rates.
        generator: Draws the initial weights; its device is the model's.
    """

    def __init__(
        self, latent_size: int, n_actions: int, settings: WorldModelSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.latent_size, self.n_actions, self.settings = latent_size, n_actions, settings
        self.members = settings.members
        outputs = mdn.output_size(settings.components, latent_size)
        sizes = (latent_size + n_actions, *settings.dynamics_hidden, outputs)
        self.dynamics = MemberMLP(
            sizes,
            members=self.members,
            dropout=settings.dropout,
            generator=generator,
            hidden_dtype=hidden_dtype(settings.precision, generator.device.type),
        )
        self.assessment = Assessment(latent_size, n_actions, settings, generator)
        self.networks: tuple[MemberMLP, ...] = (self.dynamics, *self.assessment.networks)  # type: ignore[assignment]
        self.optimiser = FlatAdam(
            self.networks, learning_rate=settings.learning_rate, gradient_clip=settings.gradient_clip
        )
        self._one_hot = torch.eye(n_actions, device=generator.device)

    def _mixture(self, z: Tensor, action: Tensor, masks: Masks | None) -> Mixture:
        """``p(z' | z, a)`` of every row by every member of the ensemble, with leading axes (E, N)."""
        settings = self.settings
        inputs = torch.cat([z, self._one_hot[action]], dim=-1).expand(settings.members, -1, -1)  # [E, N, Z + A]
        outputs = self.dynamics(inputs, masks)  # [E, N, K (1 + 2 Z)]
        mixture = mdn.from_outputs(outputs, settings.components, self.latent_size, math.log(settings.sigma_floor))
        return replace(mixture, means=mixture.means + z.unsqueeze(-2)) if settings.predict_change else mixture

    def losses(self, batch: Batch, dropout: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Mean losses of dynamics (summed over members), reward and termination, under fresh dropout masks."""
        rows = len(batch.action)
        mixture = self._mixture(batch.z, batch.action, self.dynamics.draw_masks(rows, dropout))
        masks = self.assessment.draw_masks(rows, dropout)
        reward, logit = self.assessment(batch.z, batch.action, batch.next_z, masks)
        return (
            -mdn.log_likelihood(mixture, batch.next_z).mean(dim=1).sum(),  # each member descends as if it were alone
            log_cosh(reward - batch.reward / self.settings.reward_scale).mean(),
            functional.binary_cross_entropy_with_logits(logit, batch.terminated),
        )

    def update(self, batch: Batch, dropout: torch.Generator) -> ModelLosses:
        """One step of Adam on all networks, then the max-norm constraint.

        Raises:
            DivergedError: A loss is NaN or infinite; the weights are left as they were.
        """
        terms = self.losses(batch, dropout)
        losses = ModelLosses(*torch.stack(terms).tolist())
        if not all(map(math.isfinite, (losses.dynamics, losses.reward, losses.termination))):
            raise DivergedError(f"The world model's losses are no longer finite: {losses}. Lower model.learning_rate.")
        self.optimiser.step(torch.stack(terms).sum())
        if self.settings.max_norm is not None:
            clip_unit_norms(self.networks, self.settings.max_norm)
        return losses

    def draw_weights(self, count: int, dropout: torch.Generator) -> Masks | None:
        """Draw T weight samples of each member: masks (E, T, H) that every state of a prediction shares."""
        return self.dynamics.draw_masks(count, dropout)

    def draw_reward_weights(self, count: int, dropout: torch.Generator) -> Masks | None:
        """Draw T weight samples of the reward network: masks (1, T, H)."""
        return self.assessment.reward_network.draw_masks(count, dropout)

    @torch.no_grad()
    def predict(self, z: Tensor, action: Tensor, weights: Masks | None) -> Mixture:
        """``p(z' | z, a)`` under every weight sample of every member, in one batched pass.

        Args:
            z: Shape (N, Z).
            action: Shape (N,).
            weights: From :meth:`draw_weights`; None drops nothing, as one sample.

        Returns:
            Mixtures with leading axes (E T, N).
        """
        rows = len(z)
        samples = 1 if weights is None else weights[0].shape[1]
        masks = None if weights is None else tuple(mask.repeat_interleave(rows, dim=1) for mask in weights)
        mixture = self._mixture(z.repeat(samples, 1), action.repeat(samples), masks)  # [E, T N, ...]
        return Mixture(
            *(
                values.reshape(-1, rows, *values.shape[2:])
                for values in (mixture.log_weights, mixture.means, mixture.log_sigmas)
            )
        )

    @torch.no_grad()
    def assess(self, z: Tensor, action: Tensor, next_z: Tensor) -> tuple[Tensor, Tensor]:
        """Predicted rewards and termination probabilities of N transitions, without dropout: two of shape (N,)."""
        reward, logit = self.assessment(z, action, next_z)
        return reward * self.settings.reward_scale, logit.sigmoid()

    @torch.no_grad()
    def reward_doubt(self, z: Tensor, action: Tensor, next_z: Tensor, weights: Masks) -> Tensor:
        """Standard deviation of the rewards of N transitions over T weight samples, in units of reward: (N,).

        Args:
            z: Shape (N, Z).
            action: Shape (N,).
            next_z: Shape (N, Z).
            weights: From :meth:`draw_reward_weights`.
        """
        samples = self.assessment.sample_rewards(z, action, next_z, weights)  # [T, N]
        return samples.std(dim=0, correction=0) * self.settings.reward_scale
