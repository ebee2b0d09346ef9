"""Adam for networks with a leading member axis: decoupled weight decay, and gradients clipped a member at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .flat_adam import FlatAdam, require_finite


class MemberAdam(FlatAdam):
    """AdamW (Loshchilov & Hutter 2019) on a module all of whose parameters begin with the member axis.

    Nothing that happens to one member changes another: each has a gradient norm of its own.

    Args:
        module: E networks.
        decayed: Those of its parameters that decay.
        learning_rate: Step size.
        weight_decay: Decay a step, in units of the learning rate.
        gradient_clip: Largest gradient norm of each member; None clips nothing.
    """

    def __init__(
        self,
        module: nn.Module,
        decayed: Sequence[Tensor],
        *,
        learning_rate: float,
        weight_decay: float,
        gradient_clip: float | None,
    ) -> None:
        super().__init__([module], learning_rate=learning_rate, gradient_clip=gradient_clip)
        self._members, self._decayed, self._weight_decay = len(self._parameters[0]), decayed, weight_decay
        sizes = [parameter.numel() for parameter in self._parameters]
        self._by_member = [part.view(self._members, -1) for part in self._gradient.split(sizes)]

    def step(self, loss: Tensor) -> None:
        """Descend the gradient of the sum of all members' losses once.

        Raises:
            DivergedError: A gradient is NaN or infinite; the parameters are left as they were.
        """
        super().step(loss)
        with torch.no_grad():
            for parameter in self._decayed:
                parameter.mul_(1.0 - self._rate * self._weight_decay)

    def _clip_gradients(self) -> None:
        norms = torch.stack([part.square().sum(dim=1) for part in self._by_member]).sum(dim=0).sqrt()  # [E]
        require_finite(norms.tolist())
        if self._clip is not None and bool((norms > self._clip).any()):
            scale = (self._clip / norms.clamp_min(1e-30)).clamp_max(1.0)[:, None]
            for part in self._by_member:
                part.mul_(scale)
