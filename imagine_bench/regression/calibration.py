"""Calibration of a regressor's networks on unseen points, and whether uncertainty finds wrong predictions."""

from __future__ import annotations

from operator import itemgetter

import numpy as np

from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import SCORES, RegressionSpec, Regressor
from imagine_bench.regression.results import Row
from imagine_bench.regression.scores import (
    LEVELS,
    coverage,
    crps,
    log_score,
    probability_transform,
    transform_distance,
)
from imagine_bench.seeding import SeedTree
from imagine_bench.statistics import auroc

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

    Two predictive distributions are judged: ``predictive``, from which the regressor samples its predictions (for
    dropout the thesis' averaged parameters), and ``pooled``, all weight samples' mixtures side by side.

    Args:
        task: Gives the points and says how wrong a prediction is.
        regressor: E networks, trained on ``variant``.
        variant: Of the task.
        networks: One node of the seed tree each, for its test points.
        points: Unseen points a network, N.
        rng: Samples the predictions.

    Returns:
        One row a network, and arrays: ``transform``, ``pooled_transform`` (E, N, D), ``error`` and each score (E, N).
    """
    tests = [task.testing(variant, node.child("test", variant).generator(), points) for node in networks]
    inputs = np.stack([test.inputs for test in tests])
    targets = np.stack([test.targets for test in tests])
    prediction = regressor.predict(inputs, rng)
    error = np.stack([task.errors(variant, *pair) for pair in zip(inputs, prediction.prediction, strict=True)])
    scores = {name: score(prediction) for name, score in SCORES.items()}
    pooled_transform, pooled_crps = _pooled(regressor, inputs, targets)
    transforms = {"": probability_transform(prediction.predictive, targets), "pooled_": pooled_transform}
    rows: list[Row] = []
    for e in range(len(networks)):
        own = prediction.predictive.map(itemgetter(e))
        own_crps = crps(own, targets[e])  # [N, D]
        wrong = error[e] > task.wrong_above
        row = {
            "error_mean": error[e].mean(),
            "error_median": np.median(error[e]),
            "wrong": wrong.mean(),
            "log_score": log_score(own, targets[e]).mean(),
            "crps": own_crps.mean(),
            "crps_shared": own_crps[:CRPS_POINTS].mean(),
            "pooled_crps_shared": pooled_crps[e].mean(),
        }
        for prefix, transform in transforms.items():
            row |= {f"{prefix}coverage_{level:g}": coverage(transform[e], level) for level in LEVELS}
            row[f"{prefix}transform_distance"] = transform_distance(transform[e])
        row |= {f"auroc_{name}": auroc(values[e], wrong) for name, values in scores.items()}
        rows.append({name: float(value) for name, value in row.items()})
    arrays = {f"{prefix}transform": transform for prefix, transform in transforms.items()}
    return rows, {**arrays, "error": error, **scores}


def _pooled(regressor: Regressor, inputs: Floats, targets: Floats) -> tuple[Floats, Floats]:
    """Transforms (E, N, D), and scores at the first points (E, CRPS_POINTS, D), of all weight samples pooled."""
    transforms = []
    scores = []
    for start in range(0, inputs.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        mixtures = regressor.pooled(inputs[:, part])
        transforms.append(probability_transform(mixtures, targets[:, part]))
        for point in range(start, min(start + _CHUNK, CRPS_POINTS, inputs.shape[1])):
            one = mixtures.map(itemgetter((slice(None), point - start)))
            scores.append(crps(one, targets[:, point]))  # [E, D]
    return np.concatenate(transforms, axis=1), np.stack(scores, axis=1)
