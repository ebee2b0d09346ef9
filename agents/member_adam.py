"""Adam for networks with a leading member axis: decoupled weight decay, and gradients clipped a member at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .flat_adam import FlatAdam


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
        self._parameters, self._decayed = list(module.parameters()), decayed
        self._weight_decay = weight_decay
        self.set_learning_rate(learning_rate)

    def set_learning_rate(self, learning_rate: float) -> None:
        """Take steps of this size from now on, and let weights decay by as much less."""
        super().set_learning_rate(learning_rate)
        self._kept = 1.0 - learning_rate * self._weight_decay

    def step(self, loss: Tensor) -> None:
        """Descend the gradient of the sum of all members' losses once."""
        super().step(loss)
        with torch.no_grad():
            for parameter in self._decayed:
                parameter.mul_(self._kept)

    @torch.no_grad()
    def _clip_gradients(self, limit: float) -> None:
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        norms = torch.stack([g.flatten(1).square().sum(dim=1) for g in gradients]).sum(dim=0).sqrt()  # [E]
        if bool((norms > limit).any()):
            scale = (limit / norms.clamp_min(1e-30)).clamp_max(1.0)  # [E]
            for gradient in gradients:
                gradient.mul_(scale.view(-1, *(1,) * (gradient.dim() - 1)))
