"""Adam for networks with a leading member axis: weight decay in the gradient, which is clipped a member at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .flat_adam import FlatAdam, require_finite


class MemberAdam(FlatAdam):
    """Adam on a module all of whose parameters begin with the member axis; decay is that of :class:`torch.optim.Adam`.

    Nothing that happens to one member changes another: each has a gradient norm of its own. Decay is part of the
    gradient, as with an L2 term in the loss, and comes after clipping.

    Args:
        module: E networks.
        decayed: Those of its parameters that decay.
        learning_rate: Step size.
        weight_decay: How many times a decayed parameter is added to its gradient.
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
        self._members, self._weight_decay = len(self.parameters[0]), weight_decay
        chosen = {id(parameter) for parameter in decayed}
        self._decays = [id(parameter) in chosen for parameter in self.parameters]

    def _clip_gradient(self, gradient: Tensor) -> None:
        parts = [part.view(self._members, -1) for part in gradient.split([p.numel() for p in self.parameters])]
        norms = torch.stack([part.square().sum(dim=1) for part in parts]).sum(dim=0).sqrt()  # [E]
        require_finite(norms.tolist())
        if self._clip is not None and bool((norms > self._clip).any()):
            scale = (self._clip / norms.clamp_min(1e-30)).clamp_max(1.0)[:, None]
            for part in parts:
                part.mul_(scale)
        with torch.no_grad():
            for part, parameter, decays in zip(parts, self.parameters, self._decays, strict=True):
                if decays:
                    part.add_(parameter.view_as(part), alpha=self._weight_decay)
