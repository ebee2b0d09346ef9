"""Whether a model that says how sure it is, is right about that, on points that it has never seen.

Gneiting & Raftery, "Strictly proper scoring rules, prediction, and estimation" (2007), and Gneiting, Balabdaoui &
Raftery, "Probabilistic forecasts, calibration and sharpness" (2007). Shapes: ``...`` any leading axes, ``E`` networks,
``N`` points, ``K`` mixture components, ``D`` dimensions, each judged by itself unless said otherwise.
"""

from __future__ import annotations

import math

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import Mixtures, RegressionSpec, Regressor
from imagine_bench.regression.results import Row
from imagine_bench.seeding import SeedTree
from imagine_bench.statistics import auroc

LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""
CRPS_POINTS = 50
"""Points of each network at which both distributions are scored: all weight samples together cost (T K)^2 a point."""
_CHUNK = 100
"""Points whose pooled mixtures are in memory."""


def calibrate(
    task: RegressionSpec,
    regressor: Regressor,
    variant: str,
    networks: tuple[SeedTree, ...],
    *,
    points: int,
    rng: np.random.Generator,
) -> tuple[list[Row], Arrays]:
    """Measure every network on points of its own.

    Two predictive distributions are judged: the one from which the regressor samples its predictions (for dropout the
    thesis' averaged parameters), and ``pooled``, all weight samples' mixtures side by side.

    Args:
        task: Gives the points and says how wrong a prediction is.
        regressor: E networks, trained on ``variant``.
        variant: Of the task.
        networks: One node of the seed tree each, for its test points.
        points: Unseen points a network, N.
        rng: Samples the predictions.

    Returns:
        One row a network, and arrays below ``calibration/``: ``transform``, ``pooled_transform`` (E, N, D), ``error``
        and each score (E, N).
    """
    tests = [task.testing(variant, node.child("test", variant).generator(), points) for node in networks]
    inputs = np.stack([test.inputs for test in tests])
    targets = np.stack([test.targets for test in tests])
    prediction = regressor.predict(inputs, rng)
    error = np.stack([task.errors(variant, *pair) for pair in zip(inputs, prediction.prediction, strict=True)])
    wrong = error > task.wrong_above
    own_crps = crps(prediction, targets)
    transforms = {"": probability_transform(prediction, targets), "pooled_": np.empty(targets.shape)}
    for start in range(0, points, _CHUNK):
        part = slice(start, start + _CHUNK)
        mixtures = regressor.pooled(inputs[:, part])
        transforms["pooled_"][:, part] = probability_transform(mixtures, targets[:, part])
        if start == 0:
            pooled_crps = crps(mixtures, targets[:, :CRPS_POINTS])
    log_scores = log_score(prediction, targets)
    scores = prediction.scores
    rows: list[Row] = []
    for e in range(len(networks)):
        row = {
            "error_mean": error[e].mean(),
            "error_median": np.median(error[e]),
            "wrong": wrong[e].mean(),
            "log_score": log_scores[e].mean(),
            "crps": own_crps[e].mean(),
            "crps_shared": own_crps[e, :CRPS_POINTS].mean(),
            "pooled_crps_shared": pooled_crps[e].mean(),
        }
        for prefix, transform in transforms.items():
            row |= {f"{prefix}coverage_{level:g}": coverage(transform[e], level) for level in LEVELS}
            row[f"{prefix}transform_distance"] = scipy.stats.kstest(transform[e].ravel(), "uniform").statistic
        row |= {f"auroc_{name}": auroc(values[e], wrong[e]) for name, values in scores.items()}
        rows.append({name: float(value) for name, value in row.items()})
    arrays = {"transform": transforms[""], "pooled_transform": transforms["pooled_"], "error": error, **scores}
    return rows, {f"calibration/{name}": array for name, array in arrays.items()}


def probability_transform(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """The probability integral transform: P(Y <= outcome), uniform in [0, 1] if the prediction is calibrated.

    Mixtures of leading axes (...) and outcomes (..., D) give shape (..., D).
    """
    scaled = (outcomes[..., None, :] - mixtures.means) / mixtures.sigmas  # [..., K, D]
    return np.asarray((mixtures.weights[..., None] * scipy.special.ndtr(scaled)).sum(axis=-2))


def coverage(transforms: Floats, level: float) -> float:
    """Share of outcomes inside their central predictive interval of probability ``level``, in [0, 1]."""
    return float((np.abs(transforms - 0.5) <= 0.5 * level).mean())


def crps(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """Continuous ranked probability score, in the unit of y; lower is better, and the absolute error for a point mass.

    Closed form for Gaussian mixtures (Grimit et al. 2006, equation 5): ``sum_k w_k A(y - m_k, s_k^2)
    - 1/2 sum_kl w_k w_l A(m_k - m_l, s_k^2 + s_l^2)`` with ``A(m, v) = E|N(m, v)|``. Outcomes (..., D) may be of the
    first mixtures only.
    """
    score: Floats = np.empty(outcomes.shape)
    for place in np.ndindex(outcomes.shape[:-1]):
        weights = mixtures.weights[place]
        means = mixtures.means[place]
        variances = mixtures.sigmas[place] ** 2
        away = _mean_size(outcomes[place] - means, variances)  # [K, D]
        apart = _mean_size(means[:, None] - means, variances[:, None] + variances)  # [K, K, D]
        spread = np.einsum("k,l,kld->d", weights, weights, apart)
        score[place] = np.einsum("k,kd->d", weights, away) - 0.5 * spread
    return score


def log_score(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """Negative log density of the whole outcome, all dimensions together, in nats. Outcomes (..., D), result (...)."""
    scaled = (outcomes[..., None, :] - mixtures.means) / mixtures.sigmas
    log_normal = (-0.5 * (scaled**2 + math.log(2.0 * math.pi)) - np.log(mixtures.sigmas)).sum(axis=-1)  # [..., K]
    with np.errstate(divide="ignore"):
        return np.asarray(-scipy.special.logsumexp(np.log(mixtures.weights) + log_normal, axis=-1))


def _mean_size(mean: Floats, variance: Floats) -> Floats:
    """E|X| of a normal X."""
    sigma = np.sqrt(variance)
    ratio = mean / sigma
    density = 2.0 * sigma * np.exp(-0.5 * ratio**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(density + mean * (2.0 * scipy.special.ndtr(ratio) - 1.0))
