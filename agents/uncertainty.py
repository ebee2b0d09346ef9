"""What a Bayesian mixture density network does not know, split by cause (thesis 4.4, equations 4.25 to 4.27)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from imagine_bench.errors import require_known

from . import mixture as mdn
from .mixture import Mixture


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Predictive variance by cause, a dimension at a time; the three sum to the total (equation 4.24).

    Attributes:
        epistemic: Spread of the mean over weight samples: too little data. Shape (..., Z).
        aleatoric: Mean variance of the components: noise. Shape (..., Z).
        modal: Mean spread of the components: several possible outcomes. Shape (..., Z).
    """

    epistemic: Tensor
    aleatoric: Tensor
    modal: Tensor


def decompose(samples: Mixture) -> Uncertainty:
    """Split the predictive variance of T weight samples.

    Each spread is a centred sum of squares: the thesis' differences of squares are equal to it, but cancel in float32.

    Args:
        samples: Mixtures whose first axis is the weight sample, (T, ..., K, Z).
    """
    weights = samples.log_weights.exp().unsqueeze(-1)  # [T, ..., K, 1]
    means = mdn.mean(samples)  # [T, ..., Z]
    modal = (weights * (samples.means - means.unsqueeze(-2)).square()).sum(dim=-2)  # [T, ..., Z]
    aleatoric = (weights * torch.exp(2.0 * samples.log_sigmas)).sum(dim=-2)  # [T, ..., Z]
    return Uncertainty(means.var(dim=0, correction=0), aleatoric.mean(dim=0), modal.mean(dim=0))


REDUCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "sum": lambda values: values.sum(dim=-1),
    "mean": lambda values: values.mean(dim=-1),
    "max": lambda values: values.amax(dim=-1),
}
"""How a vector of variances (..., Z) becomes the one number that a threshold is compared with."""


def reduction(name: str) -> Callable[[Tensor], Tensor]:
    """The reduction over dimensions of that name.

    Raises:
        UnknownNameError: No such reduction.
    """
    return REDUCTIONS[require_known("uncertainty reduction", name, REDUCTIONS)]
