"""Adam (Kingma & Ba 2015) as one fused kernel a step, to the bit ``torch.optim.Adam(..., fused=True)``.

torch's own class loads its compiler with the first optimiser, which costs every process 4 CPU seconds where bytecode is
not cached, and 1 where it is. Nothing here is compiled.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import torch
from torch import Tensor, nn

_BETAS = (0.9, 0.999)
_EPSILON = 1e-8
MOMENTS = ("exp_avg", "exp_avg_sq")
"""Names of a weight's running means of its gradient and of its square, as in torch's class."""


class Adam:
    """Adam over groups of weights that share a learning rate and differ in their decay.

    Args:
        groups: Weights with their decay, which is added to the gradient as ``decay * weight``.
        learning_rate: Of all groups; it may be set between steps.
    """

    def __init__(self, groups: Iterable[tuple[Iterable[nn.Parameter], float]], learning_rate: float) -> None:
        self.groups = [(list(weights), decay) for weights, decay in groups]
        self.learning_rate = learning_rate
        self.state: dict[Tensor, dict[str, Tensor]] = defaultdict(dict)
        """Moments and number of steps of each weight that has been updated."""

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for weights, _ in self.groups:
            for weight in weights:
                weight.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update every weight that has a gradient."""
        for weights, decay in self.groups:
            moved = {weight: weight.grad for weight in weights if weight.grad is not None}
            for weight in moved:
                if not self.state[weight]:
                    self.state[weight] = {name: torch.zeros_like(weight) for name in MOMENTS}
                    self.state[weight]["step"] = torch.zeros((), device=weight.device)
            if not moved:
                continue
            first, second, steps = ([self.state[weight][name] for weight in moved] for name in (*MOMENTS, "step"))
            torch._foreach_add_(steps, 1)
            torch._fused_adam_(
                list(moved),
                list(moved.values()),
                first,
                second,
                [],
                steps,
                lr=self.learning_rate,
                beta1=_BETAS[0],
                beta2=_BETAS[1],
                weight_decay=decay,
                eps=_EPSILON,
                amsgrad=False,
                maximize=False,
            )


class TrainedModule(nn.Module):
    """A network with its optimiser, as snapshots hold it."""

    optimiser: Adam
