"""The environment model: a mixture density network for the dynamics, and what the next state means (thesis 5.2.2).

``p(z' | z, a)`` says where a macro-action leads; :mod:`.assessment` what it earns and whether the episode ends there.
Networks share no weights (but reward and termination, where they have one trunk); one backward pass through the sum of
the losses trains them all. The dynamics may be an ensemble of E networks, which a leading member axis trains as one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.bench.cohort import answer_each, together
from imagine_bench.errors import DivergedError

from ..networks import joint
from ..networks.flat_adam import FlatAdam
from ..networks.mlp import Masks, MemberMLP, Parameters, by_network, clip_unit_norms
from ..networks.precision import hidden_dtype
from ..replay import Batch
from ..settings import WorldModelSettings
from . import mixture as mdn
from .mixture import Mixture
from .reward_termination import RewardTerminationHead


@dataclass(frozen=True, slots=True)
class ModelLosses:
    """Means over a batch: negative log-likelihood (nats, members summed), log-cosh (of reward units), cross-entropy."""

    dynamics: float
    reward: float
    termination: float


def log_cosh(x: Tensor) -> Tensor:
    """``log(cosh(x))`` without overflow: quadratic near 0, linear far away."""
    size = x.abs()
    return size + functional.softplus(-2.0 * size) - math.log(2.0)


@dataclass(frozen=True, slots=True)
class Update:
    """A model, the batch that it learns from now, and what draws its dropout masks."""

    model: WorldModel
    batch: Batch
    dropout: torch.Generator


def update_together(updates: Sequence[Update]) -> list[ModelLosses | Exception]:
    """Update models of one shape by one joint gradient; see :meth:`WorldModel.update`."""
    models = [update.model for update in updates]
    terms, gradients = joint.gradients(
        [model.optimiser for model in models], lambda parameters: models[0].losses(updates, parameters)
    )
    losses = [ModelLosses(*values) for values in terms.T.tolist()]
    return answer_each(WorldModel.descend, list(zip(models, losses, gradients, strict=True)))


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
        self.assessment = RewardTerminationHead(latent_size, n_actions, settings, generator)
        self.networks: tuple[MemberMLP, ...] = (self.dynamics, *self.assessment.networks)
        self.optimiser = FlatAdam(
            self.networks, learning_rate=settings.learning_rate, gradient_clip=settings.gradient_clip
        )
        self._one_hot = torch.eye(n_actions, device=generator.device)

    def _mixture(
        self, z: Tensor, action: Tensor, masks: Iterable[Tensor] | None, parameters: Parameters | None = None
    ) -> Mixture:
        """``p(z' | z, a)`` of every row (S, N) by every member of the seed's ensemble, with leading axes (S E, N)."""
        settings = self.settings
        inputs = self._to_members(torch.cat([z, self._one_hot[action]], dim=-1))  # [S E, N, Z + A]
        outputs = self.dynamics(inputs, masks, parameters)  # [S E, N, K (1 + 2 Z)]
        mixture = mdn.from_outputs(outputs, settings.components, self.latent_size, math.log(settings.sigma_floor))
        if not settings.predict_change:
            return mixture
        return replace(mixture, means=mixture.means + self._to_members(z).unsqueeze(-2))

    def _to_members(self, rows: Tensor) -> Tensor:
        """Rows of S seeds (S, N, ...) for each of their E members. Shape (S E, N, ...)."""
        return rows.unsqueeze(1).expand(-1, self.members, *rows.shape[1:]).flatten(0, 1)

    def losses(self, updates: Sequence[Update], parameters: Parameters) -> Tensor:
        """Mean losses of dynamics (summed over members), reward and termination, under fresh dropout masks.

        Args:
            updates: Those of S models of this shape.
            parameters: Theirs, one network after the other, with a leading axis of S E.

        Returns:
            Shape (3, S).
        """
        rows, seeds = len(updates[0].batch.action), len(updates)
        batch = joint.batches([update.batch for update in updates])
        draws = [update.dropout for update in updates]
        dynamics, *assessment = [joint.masks(network, rows, draws) for network in self.networks]
        own, *others = by_network(self.networks, parameters)
        mixture = self._mixture(batch.z, batch.action, dynamics, own)
        read = batch.z, batch.action, batch.next_z
        reward, logit = self.assessment(*read, assessment, others)
        likelihood = mdn.log_likelihood(mixture, self._to_members(batch.next_z)).mean(dim=1)  # [S E]
        return torch.stack(
            [
                -likelihood.view(seeds, -1).sum(dim=1),  # no member's loss reads another; a clip does
                log_cosh(reward - batch.reward / self.settings.reward_scale).mean(dim=1),
                functional.binary_cross_entropy_with_logits(logit, batch.terminated, reduction="none").mean(dim=1),
            ]
        )

    def update(self, batch: Batch, dropout: torch.Generator) -> ModelLosses:
        """One step of Adam on all networks, then the max-norm constraint.

        Raises:
            DivergedError: A loss is NaN or infinite; the weights are left as they were.
        """
        kind = (self.settings, self.latent_size, self.n_actions)
        return together(update_together, Update(self, batch, dropout), kind=kind)

    def descend(self, losses: ModelLosses, gradient: Tensor) -> ModelLosses:
        """What follows from the gradient (P,) of losses: Adam and the max-norm constraint. Raises as :meth:`update`."""
        if not all(map(math.isfinite, (losses.dynamics, losses.reward, losses.termination))):
            raise DivergedError(f"The world model's losses are no longer finite: {losses}. Lower model.learning_rate.")
        self.optimiser.descend(gradient)
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
        mixture = self._mixture(z.repeat(1, samples, 1), action.repeat(1, samples), masks)  # [E, T N, ...]
        return mixture.map(lambda values: values.reshape(-1, rows, *values.shape[2:]))

    @torch.no_grad()
    def assess(self, z: Tensor, action: Tensor, next_z: Tensor) -> tuple[Tensor, Tensor]:
        """Predicted rewards and termination probabilities of N transitions, without dropout: two of shape (N,)."""
        reward, logit = self.assessment(z.unsqueeze(0), action.unsqueeze(0), next_z.unsqueeze(0))
        return reward.squeeze(0) * self.settings.reward_scale, logit.squeeze(0).sigmoid()

    @torch.no_grad()
    def reward_std(self, z: Tensor, action: Tensor, next_z: Tensor, weights: Masks) -> Tensor:
        """Standard deviation of the rewards of N transitions over T weight samples, in units of reward: (N,).

        Args:
            z: Shape (N, Z).
            action: Shape (N,).
            next_z: Shape (N, Z).
            weights: From :meth:`draw_reward_weights`.
        """
        samples = self.assessment.sample_rewards(z, action, next_z, weights)  # [T, N]
        return samples.std(dim=0, correction=0) * self.settings.reward_scale
