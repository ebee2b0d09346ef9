"""The environment model: where a macro-action leads, its reward and whether the episode ends (thesis 5.2.2).

A mixture density network gives ``p(z' | z, a)``; reward and termination networks read the next state. Networks share no
weights (but reward and termination, where they have one trunk); one backward pass through the sum of the losses trains
them all. The dynamics may be an ensemble of E networks, which a leading member axis trains as one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.errors import DivergedError

from ..networks.adam import Adam, TrainedModule
from ..networks.mlp import Masks, MemberMLP, clip_gradient_norm, clip_unit_norms
from ..networks.precision import hidden_dtype
from ..networks.weight_samples import sample_outputs
from ..replay import Batch
from . import mixture as mdn
from .mixture import Mixture
from .settings import WorldModelSettings


class ModelLosses(NamedTuple):
    """Means over a batch: negative log-likelihood (nats, members summed), log-cosh (of reward units), cross-entropy."""

    dynamics: float
    reward: float
    termination: float


def log_cosh(x: Tensor) -> Tensor:
    """``log(cosh(x))`` without overflow: quadratic near 0, linear far away."""
    size = x.abs()
    return size + functional.softplus(-2.0 * size) - math.log(2.0)


class RewardTerminationHead(nn.Module):
    """Reward and termination networks, or one network with both outputs.

    The thesis reads both from the next state alone, ``r(z')`` and ``d(z')``. Where a right and a wrong macro-action
    lead to frames that are alike, that cannot tell the two apart; reading the whole transition can.
    """

    def __init__(
        self, latent_size: int, n_actions: int, settings: WorldModelSettings, network: Callable[..., MemberMLP]
    ) -> None:
        super().__init__()
        self._reads_transition = settings.head_input == "transition"
        n_in = 2 * latent_size + n_actions if self._reads_transition else latent_size
        outputs = [(settings.reward_hidden, 1), (settings.termination_hidden, 1)]
        if settings.shared_hidden:
            outputs = [(settings.shared_hidden, 2)]
        self.networks = nn.ModuleList(network((n_in, *hidden, n), members=1) for hidden, n in outputs)
        self._one_hot = torch.eye(n_actions, device=self.reward_network.weights[0].device)

    @property
    def reward_network(self) -> MemberMLP:
        """The network whose first output is the reward."""
        return self.networks[0]  # type: ignore[return-value]

    def inputs(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        """The inputs of the networks for N transitions. Shape (N, in)."""
        return torch.cat([z, self._one_hot[action], next_z], dim=-1) if self._reads_transition else next_z

    def forward(
        self, z: Tensor, action: Tensor, next_z: Tensor, masks: Sequence[Masks | None] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Rewards and termination logits of N transitions, two of shape (N,); without ``masks`` deterministic."""
        read = self.inputs(z, action, next_z).unsqueeze(0)  # [1, N, in]
        drawn = [None] * len(self.networks) if masks is None else masks
        outputs = [network(read, mask)[0] for network, mask in zip(self.networks, drawn, strict=True)]
        reward, logit = torch.cat(outputs, dim=-1).unbind(dim=-1)  # [N, 2] to [N] and [N]
        return reward, logit


class EnvironmentModel(TrainedModule):
    """Dynamics, reward and termination, trained together from batches of transitions.

    The generator draws the initial weights; its device is the model's. ``predicted`` says how many of the numbers of a
    state its dynamics predict, the first ones: None for all.
    """

    def __init__(
        self,
        latent_size: int,
        n_actions: int,
        settings: WorldModelSettings,
        generator: torch.Generator,
        *,
        predicted: int | None = None,
    ) -> None:
        super().__init__()
        self.latent_size = latent_size
        self.n_actions = n_actions
        self.settings = settings
        self.members = settings.members
        self.predicted = latent_size if predicted is None else predicted
        outputs = mdn.output_size(settings.components, self.predicted)
        sizes = (latent_size + n_actions, *settings.dynamics_hidden, outputs)
        dtype = hidden_dtype(settings.precision, generator.device.type)
        network = partial(MemberMLP, dropout=settings.dropout, generator=generator, hidden_dtype=dtype)
        self.dynamics = network(sizes, members=self.members)
        self.head = RewardTerminationHead(latent_size, n_actions, settings, network)
        self.networks: tuple[MemberMLP, ...] = (self.dynamics, *self.head.networks)
        self.clipped: tuple[nn.Module, ...] = self.networks
        self.optimiser = Adam([(self.parameters(), 0.0)], settings.learning_rate)
        self._one_hot = torch.eye(n_actions, device=generator.device)

    def losses(self, batch: Batch, dropout: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Mean losses of dynamics (summed over members), reward and termination, under new dropout masks."""
        masks, *head_masks = [network.draw_masks(len(batch.action), dropout) for network in self.networks]
        target = batch.next_z[:, : self.predicted]
        likelihood = mdn.log_likelihood(self._mixture(batch.z, batch.action, masks), target)  # [E, B]
        reward, logit = self.head(batch.z, batch.action, batch.next_z, head_masks)
        return (
            -likelihood.mean(dim=1).sum(),  # no member's loss reads another
            log_cosh(reward - batch.reward / self.settings.reward_scale).mean(),
            functional.binary_cross_entropy_with_logits(logit, batch.terminated),
        )

    def update(self, batch: Batch, dropout: torch.Generator) -> ModelLosses:
        """One step of Adam on all networks, then the max-norm constraint.

        DivergedError if a loss is NaN or infinite, with the weights as they were.
        """
        terms = torch.stack(self.losses(batch, dropout))
        losses = ModelLosses(*terms.tolist())
        if not all(map(math.isfinite, losses)):
            raise DivergedError(f"The world model's losses are no longer finite: {losses}. Lower model.learning_rate.")
        self.optimiser.zero_grad()
        terms.sum().backward()
        if self.settings.gradient_clip is not None:
            for part in self.clipped:
                clip_gradient_norm([*part.parameters()], self.settings.gradient_clip)
        self.optimiser.step()
        if self.settings.max_norm is not None:
            self.limit_norms(self.settings.max_norm)
        return losses

    def limit_norms(self, limit: float) -> None:
        """Scale weights down to the max-norm constraint: the incoming weights of each unit have at most this norm."""
        for network in self.networks:
            clip_unit_norms(network, limit)

    def _mixture(self, z: Tensor, action: Tensor, masks: Sequence[Tensor] | None) -> Mixture:
        """``p(z' | z, a)`` of N rows by every member, with leading axes (E, N)."""
        settings = self.settings
        inputs = torch.cat([z, self._one_hot[action]], dim=-1).expand(self.members, -1, -1)  # [E, N, Z + A]
        outputs = self.dynamics(inputs, masks)  # [E, N, K (1 + 2 Z)]
        mixture = mdn.from_outputs(outputs, settings.components, self.predicted, math.log(settings.sigma_floor))
        if not settings.predict_change:
            return mixture
        return replace(mixture, means=mixture.means + z[..., : self.predicted].unsqueeze(-2))

    def keep_dynamics_of(self, other: EnvironmentModel) -> None:
        """Take over the dynamics of another model of the same shape."""
        self.dynamics.load_state_dict(other.dynamics.state_dict())

    @torch.no_grad()
    def draw_weights(self, count: int, dropout: torch.Generator) -> Masks | None:
        """Draw T weight samples of each member: masks (E, T, H) that every state of a prediction shares."""
        return self.dynamics.draw_masks(count, dropout)

    @torch.no_grad()
    def draw_reward_weights(self, count: int, dropout: torch.Generator) -> Masks | None:
        """Draw T weight samples of the reward network: masks (1, T, H)."""
        return self.head.reward_network.draw_masks(count, dropout)

    @torch.no_grad()
    def predict(self, z: Tensor, action: Tensor, weights: Masks | None) -> Mixture:
        """``p(z' | z, a)`` of z (N, Z) and a (N,) under every weight sample of every member, in one batched pass.

        Weights are from :meth:`draw_weights`; None drops nothing, as one sample. Mixtures have leading axes (E T, N).
        """
        if weights is None:
            return self._mixture(z, action, None)
        rows = len(z)
        samples = weights[0].shape[1]
        masks = tuple(mask.repeat_interleave(rows, dim=1) for mask in weights)
        mixture = self._mixture(z.repeat(samples, 1), action.repeat(samples), masks)  # [E, T N, ...]
        return mixture.map(lambda values: values.reshape(-1, rows, *values.shape[2:]))

    @torch.no_grad()
    def predict_outcome(self, z: Tensor, action: Tensor, next_z: Tensor) -> tuple[Tensor, Tensor]:
        """Predicted rewards and termination probabilities of N transitions, without dropout: two of shape (N,)."""
        reward, logit = self.head(z, action, next_z)
        return reward * self.settings.reward_scale, logit.sigmoid()

    @torch.no_grad()
    def reward_std(self, z: Tensor, action: Tensor, next_z: Tensor, weights: Masks) -> Tensor:
        """Standard deviation of the rewards of N transitions over T weight samples, in units of reward: (N,).

        Weights are from :meth:`draw_reward_weights`.
        """
        inputs = self.head.inputs(z, action, next_z)
        masks = [mask.squeeze(0) for mask in weights]
        rewards = sample_outputs(self.head.reward_network, inputs, masks)[..., 0]  # [T, N]
        return rewards.std(dim=0, correction=0) * self.settings.reward_scale
