"""Whether a model that says how sure it is, is right about that: pure functions on predictive mixtures and outcomes.

Gneiting & Raftery, "Strictly proper scoring rules, prediction, and estimation" (2007), and Gneiting, Balabdaoui &
Raftery, "Probabilistic forecasts, calibration and sharpness" (2007). Shapes: ``...`` any leading axes, ``K`` mixture
components, ``D`` dimensions, each judged by itself unless said otherwise.
"""

from __future__ import annotations

import math

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import Mixtures

LEVELS = (0.5, 0.8, 0.95)  # central intervals whose coverage is reported
_LOG_2PI = math.log(2.0 * math.pi)
_AT_ONCE = 2**24  # pairs of components, in all dimensions, that a score compares at a time: 128 MiB an array


def probability_transform(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """The probability integral transform: P(Y <= outcome), uniform in [0, 1] if the prediction is calibrated.

    Mixtures of leading axes (...) and outcomes (..., D) give shape (..., D).
    """
    scaled = (outcomes[..., None, :] - mixtures.means) / mixtures.sigmas  # [..., K, D]
    return np.asarray((mixtures.weights[..., None] * scipy.special.ndtr(scaled)).sum(axis=-2))


def coverage(transforms: Floats, level: float) -> float:
    """Share of outcomes inside their central predictive interval of probability ``level``, in [0, 1].

    Raises:
        InvalidValueError: The level is not in (0, 1), or there are no outcomes.
    """
    if not 0.0 < level < 1.0 or transforms.size == 0:
        raise InvalidValueError(f"Coverage needs outcomes and a level in (0, 1), not {transforms.size} and {level}.")
    return float((np.abs(transforms - 0.5) <= 0.5 * level).mean())


def transform_distance(transforms: Floats) -> float:
    """Kolmogorov-Smirnov distance of the transforms from uniform, in [0, 1]."""
    values = np.clip(np.sort(transforms.ravel()), 0.0, 1.0)
    steps = np.arange(len(values) + 1) / len(values)
    return float(max((steps[1:] - values).max(), (values - steps[:-1]).max()))


def crps(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """Continuous ranked probability score, in the unit of y; lower is better, and the absolute error for a point mass.

    Closed form for Gaussian mixtures (Grimit et al. 2006, equation 5): ``sum_k w_k A(y - m_k, s_k^2)
    - 1/2 sum_kl w_k w_l A(m_k - m_l, s_k^2 + s_l^2)`` with ``A(m, v) = E|N(m, v)|``. Shapes as above.
    """
    weights = mixtures.weights
    means = mixtures.means
    variances = mixtures.sigmas**2
    away = _mean_size(outcomes[..., None, :] - means, variances)  # [..., K, D]
    score: Floats = np.einsum("...k,...kd->...d", weights, away)
    step = max(1, _AT_ONCE // max(1, means.size))
    for start in range(0, means.shape[-2], step):
        some = slice(start, start + step)
        apart = means[..., some, None, :] - means[..., None, :, :]  # [..., step, K, D]
        between = _mean_size(apart, variances[..., some, None, :] + variances[..., None, :, :])
        score = score - 0.5 * np.einsum("...k,...l,...kld->...d", weights[..., some], weights, between)
    return score


def log_score(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """Negative log density of the whole outcome, all dimensions together, in nats. Outcomes (..., D), result (...)."""
    scaled = (outcomes[..., None, :] - mixtures.means) / mixtures.sigmas
    log_normal = (-0.5 * (scaled**2 + _LOG_2PI) - np.log(mixtures.sigmas)).sum(axis=-1)  # [..., K]
    with np.errstate(divide="ignore"):
        return np.asarray(-scipy.special.logsumexp(np.log(mixtures.weights) + log_normal, axis=-1))


def _mean_size(mean: Floats, variance: Floats) -> Floats:
    """E|X| of a normal X."""
    sigma = np.sqrt(variance)
    ratio = mean / sigma
    density = 2.0 * sigma * np.exp(-0.5 * ratio**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(density + mean * (2.0 * scipy.special.ndtr(ratio) - 1.0))
