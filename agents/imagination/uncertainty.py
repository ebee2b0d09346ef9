"""The uncertainty of a Bayesian mixture density network, split by cause (thesis 4.4, equations 4.25 to 4.27)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from . import mixture as mdn
from .mixture import Mixture


class Uncertainty(NamedTuple):
    """Predictive variance by cause, a dimension at a time; the three sum to the total (equation 4.24)."""

    epistemic: Tensor  #: spread of the mean over weight samples: too little data. Shape (..., Z).
    aleatoric: Tensor  #: mean variance of the components: noise. Shape (..., Z).
    modal: Tensor  #: mean spread of the components: several possible outcomes. Shape (..., Z).


def decompose(samples: Mixture) -> Uncertainty:
    """Split the predictive variance of T weight samples, mixtures (T, ..., K, Z).

    Each spread is a centred sum of squares: the thesis' differences of squares are equal to it, but cancel in float32.
    """
    weights = samples.log_weights.exp().unsqueeze(-1)  # [T, ..., K, 1]
    means = mdn.mean(samples)  # [T, ..., Z]
    modal = (weights * (samples.means - means.unsqueeze(-2)).square()).sum(dim=-2)  # [T, ..., Z]
    aleatoric = (weights * torch.exp(2.0 * samples.log_sigmas)).sum(dim=-2)  # [T, ..., Z]
    return Uncertainty(means.var(dim=0, correction=0), aleatoric.mean(dim=0), modal.mean(dim=0))


def nll(samples: Mixture, values: Tensor) -> Tensor:
    """Negative log-likelihood of sampled values under all weight samples together, in nats: (..., Z) to (...)."""
    log_p = mdn.log_likelihood(samples, values.unsqueeze(0))  # [T, ...]
    return math.log(len(log_p)) - torch.logsumexp(log_p, dim=0)


REDUCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "sum": lambda values: values.sum(dim=-1),
    "mean": lambda values: values.mean(dim=-1),
    "max": lambda values: values.amax(dim=-1),
}
"""How a vector of variances (..., Z) becomes the one number that a threshold is compared with."""
