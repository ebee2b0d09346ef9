"""Adam on one flat vector: the parameters of a module become views of it, so that an update is a handful of operations.

Small networks spend more time in calls, one a tensor, than in arithmetic; the arithmetic here is that of
:class:`torch.optim.Adam`, element by element.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.adam import adam

from imagine_bench.errors import DivergedError


class FlatAdam:
    """Adam (Kingma & Ba 2015) for modules whose parameters it gathers into one vector.

    Args:
        modules: Independent networks; their parameters are replaced by views of the vector.
        learning_rate: Step size.
        gradient_clip: Largest gradient norm of each module; None clips nothing.
    """

    def __init__(self, modules: Sequence[nn.Module], *, learning_rate: float, gradient_clip: float | None) -> None:
        groups = [list(module.parameters()) for module in modules]
        self.parameters = [parameter for group in groups for parameter in group]
        self._rate, self._clip = learning_rate, gradient_clip
        self._sizes = [sum(parameter.numel() for parameter in group) for group in groups]
        self.settle(torch.cat([parameter.detach().reshape(-1) for parameter in self.parameters]).unsqueeze(0), 0)
        self._mean, self._square = torch.zeros_like(self.vector), torch.zeros_like(self.vector)
        self._step = torch.zeros((), device=self.vector.device)

    def settle(self, home: Tensor, row: int) -> None:
        """Let the vector be a row of ``home`` (S, P), which already holds its values, from now on."""
        self.home, self.row, self.vector = home, row, home[row]
        parts = self.vector.split([parameter.numel() for parameter in self.parameters])
        for parameter, values in zip(self.parameters, parts, strict=True):
            parameter.data = values.view(parameter.shape)

    def step(self, loss: Tensor) -> None:
        """Descend the gradient of a scalar loss once.

        Raises:
            DivergedError: A gradient is NaN or infinite; the parameters are left as they were.
        """
        gradients = torch.autograd.grad(loss, self.parameters)
        self.descend(torch.cat([gradient.reshape(-1) for gradient in gradients]))

    def descend(self, gradient: Tensor) -> None:
        """Descend a gradient (P,) once; it is overwritten.

        Raises:
            DivergedError: It is NaN or infinite; the parameters are left as they were.
        """
        self._clip_gradient(gradient)
        adam(
            [self.vector],
            [gradient],
            [self._mean],
            [self._square],
            [],
            [self._step],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self._rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )

    def set_learning_rate(self, learning_rate: float) -> None:
        """Take steps of this size from now on."""
        self._rate = learning_rate

    def _clip_gradient(self, gradient: Tensor) -> None:
        """Check the gradient of each module, and scale it down to the largest norm that is allowed."""
        segments = gradient.split(self._sizes)
        norms = [float(segment.norm()) for segment in segments]
        require_finite(norms)
        for segment, norm in zip(segments, norms, strict=True):
            if self._clip is not None and norm > self._clip:
                segment.mul_(self._clip / norm)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies of parameters and moments; before the first step the moments are 0."""
        return {name: tensor.cpu().numpy().copy() for name, tensor in self._tensors().items()}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take up the result of :meth:`arrays`."""
        for name, tensor in self._tensors().items():
            tensor.copy_(torch.tensor(arrays[name]))

    def _tensors(self) -> dict[str, Tensor]:
        return {"value": self.vector, "exp_avg": self._mean, "exp_avg_sq": self._square, "step": self._step}


def require_finite(norms: Sequence[float]) -> None:
    """Raise DivergedError if a gradient's norm is NaN or infinite."""
    if not all(map(math.isfinite, norms)):
        raise DivergedError(f"Gradients are no longer finite: their norms are {norms}. Lower the learning rate.")
