"""Adam on one flat vector: the parameters of a module become views of it, so that an update is a handful of operations.

Small networks spend more time in calls, one a tensor, than in arithmetic; the arithmetic here is that of
:class:`torch.optim.Adam`, element by element.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn


class FlatAdam:
    """Adam (Kingma & Ba 2015) for modules whose parameters it gathers into one vector.

    Args:
        modules: Independent networks; their parameters are replaced by views of the vector.
        learning_rate: Step size.
        gradient_clip: Largest gradient norm of each module; None clips nothing.
    """

    def __init__(self, modules: Sequence[nn.Module], *, learning_rate: float, gradient_clip: float | None) -> None:
        parameters = [list(module.parameters()) for module in modules]
        self._clip = gradient_clip
        self._vector = nn.Parameter(torch.cat([p.detach().reshape(-1) for group in parameters for p in group]))
        self._gradient = torch.zeros_like(self._vector)
        self._vector.grad = self._gradient
        self._segments: list[Tensor] = []
        start = 0
        for group in parameters:
            first = start
            for parameter in group:
                end = start + parameter.numel()
                parameter.data = self._vector.data[start:end].view(parameter.shape)
                parameter.grad = self._gradient[start:end].view(parameter.shape)
                start = end
            self._segments.append(self._gradient[first:start])
        self._adam = torch.optim.Adam([self._vector], lr=learning_rate, fused=True)

    def step(self, loss: Tensor) -> None:
        """Descend the gradient of a scalar loss once."""
        self._gradient.zero_()
        loss.backward()
        if self._clip is not None:
            for segment in self._segments:
                norm = float(segment.norm())
                if norm > self._clip:
                    segment.mul_(self._clip / norm)
        self._adam.step()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies of parameters and moments; before the first step the moments are 0."""
        blank = {"exp_avg": self._gradient * 0.0, "exp_avg_sq": self._gradient * 0.0, "step": torch.zeros(())}
        parts = {"value": self._vector.detach(), **blank, **self._adam.state.get(self._vector, {})}
        return {name: tensor.cpu().numpy().copy() for name, tensor in parts.items()}

    @torch.no_grad()
    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take up the result of :meth:`arrays`."""
        self._vector.copy_(torch.tensor(arrays["value"]))
        moments = {name: torch.tensor(arrays[name]) for name in ("exp_avg", "exp_avg_sq", "step")}
        groups = self._adam.state_dict()["param_groups"]
        self._adam.load_state_dict({"state": {0: moments}, "param_groups": groups})
