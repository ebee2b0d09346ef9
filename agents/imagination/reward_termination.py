"""What a transition earns and whether it ends the episode: the r- and d-networks (thesis 3.1.2, 5.2.2).

The thesis reads both from the next state alone, ``r(z')`` and ``d(z')``. Where a right and a wrong macro-action lead to
pictures that are alike, that cannot tell the two apart; reading the whole transition can.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from imagine_bench.errors import require_known

from ..networks.mlp import Masks, MemberMLP, Parameters
from ..networks.precision import hidden_dtype
from ..networks.weight_samples import sample_outputs
from ..settings import WorldModelSettings

INPUTS = ("next_state", "transition")
"""What reward and termination may be read from: z', or z, one-hot a and z'."""
_MEMBERS = 1


class RewardTerminationHead(nn.Module):
    """Reward and termination networks, or one network with both outputs.

    Args:
        latent_size: Z.
        n_actions: A.
        settings: Sizes, and what is read.
        generator: Draws the initial weights; its device is the networks'.

    Raises:
        UnknownNameError: Inputs that are none of :data:`INPUTS`.
    """

    def __init__(
        self, latent_size: int, n_actions: int, settings: WorldModelSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self._transition = require_known("assessment input", settings.assessment_input, INPUTS) == "transition"
        n_in = 2 * latent_size + n_actions if self._transition else latent_size
        outputs = [(settings.reward_hidden, 1), (settings.termination_hidden, 1)]
        if settings.shared_hidden:
            outputs = [(settings.shared_hidden, 2)]
        self.networks = nn.ModuleList(
            MemberMLP(
                (n_in, *hidden, n_out),
                members=_MEMBERS,
                dropout=settings.dropout,
                generator=generator,
                hidden_dtype=hidden_dtype(settings.precision, generator.device.type),
            )
            for hidden, n_out in outputs
        )
        self._one_hot = torch.eye(n_actions, device=generator.device)

    @property
    def reward_network(self) -> MemberMLP:
        """The network whose first output is the reward."""
        return self.networks[0]  # type: ignore[return-value]

    def sample_rewards(self, z: Tensor, action: Tensor, next_z: Tensor, weights: Masks) -> Tensor:
        """Rewards of N transitions under each of T weight samples, masks (1, T, H) that all rows share: (T, N)."""
        masks = [mask.squeeze(0) for mask in weights]
        return sample_outputs(self.reward_network, self._read(z, action, next_z), masks)[..., 0]

    def _read(self, z: Tensor, action: Tensor, next_z: Tensor) -> Tensor:
        return torch.cat([z, self._one_hot[action], next_z], dim=-1) if self._transition else next_z

    def forward(
        self,
        z: Tensor,
        action: Tensor,
        next_z: Tensor,
        masks: Sequence[Iterable[Tensor] | None] | None = None,
        parameters: Sequence[Parameters] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Rewards and termination logits of N transitions of S seeds, without ``masks`` deterministic: (S, N) each.

        Args:
            z: Shape (S, N, Z).
            action: Shape (S, N).
            next_z: Shape (S, N, Z).
            masks: Those of each network, or None where it drops nothing.
            parameters: Those of S networks for each network, instead of its own.
        """
        read = self._read(z, action, next_z)
        drawn = [None] * len(self.networks) if masks is None else masks
        own = [None] * len(self.networks) if parameters is None else parameters
        outputs = [network(read, *rest) for network, *rest in zip(self.networks, drawn, own, strict=True)]
        reward, logit = torch.cat(outputs, dim=-1).unbind(dim=-1)  # [S, N, 2] to [S, N] and [S, N]
        return reward, logit
