"""The toy regression of thesis 4.5.1: three branches, noise, a region with little data, a region with much noise.

``y = f(x) + eta``: f is one of three functions, each as likely as the others, eta is Gaussian noise. All true
uncertainties are known in closed form.
"""

from __future__ import annotations

import numpy as np

from imagine_bench.arrays import Arrays
from imagine_bench.errors import require_known
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import Predict, RegressionData, RegressionSpec
from imagine_bench.seeding import SeedTree

EDGE = 30.0
"""The training inputs lie in [-30, 30]."""
REGION = 10.0
"""The variants differ in [-10, 10]: little data, or much noise."""
FARTHEST = 40.0
"""The networks are asked in [-30, 40]: beyond 30 they extrapolate."""
SAMPLES = 2000
DECIMATION = 50
SIGMA = 1.0
SIGMA_HIGH = 3.0
GRID = 1000
"""Test inputs of figure 4.1."""
VARIANTS = ("base", "low_data", "high_noise")


def branches(x: Floats) -> Floats:
    """The three functions of thesis 4.5.1. Inputs (...), result (..., 3)."""
    return np.stack(
        [7 * np.sin(0.75 * x) + 0.5 * x, 3 * np.sin(0.5 * x) + 3 * x - 5, 2 * np.sin(0.3 * x) - 0.2 * x + 20], axis=-1
    )


def noise_sigma(variant: str, x: Floats) -> Floats:
    """Standard deviation of the noise at each input."""
    return np.where((variant == "high_noise") & (np.abs(x) <= REGION), SIGMA_HIGH, SIGMA)


def require_variant(variant: str) -> None:
    """Raise UnknownNameError unless ``variant`` is one of the three datasets."""
    require_known("variant of toy_regression", variant, VARIANTS)


def training(variant: str, rng: np.random.Generator) -> RegressionData:
    """The training data: 2000 points, or with the region decimated by 50, as many as are expected to remain.

    Counts inside and outside of the region are at their expectation, so that all datasets of a variant are as long.
    """
    require_variant(variant)
    inside = round(SAMPLES * REGION / EDGE)
    outside = SAMPLES - inside
    kept = round(inside / DECIMATION) if variant == "low_data" else inside
    left = rng.uniform(-EDGE, -REGION, size=outside // 2)
    right = rng.uniform(REGION, EDGE, size=outside - outside // 2)
    middle = rng.uniform(-REGION, REGION, size=kept)
    return _with_targets(variant, np.concatenate([left, right, middle]), rng)


def testing(variant: str, rng: np.random.Generator, count: int) -> RegressionData:
    """Points of the same process, uniform over the training domain: the region has its full share here."""
    return _with_targets(variant, rng.uniform(-EDGE, EDGE, size=count), rng)


def _with_targets(variant: str, x: Floats, rng: np.random.Generator) -> RegressionData:
    chosen = rng.integers(3, size=len(x))
    y = branches(x)[np.arange(len(x)), chosen] + noise_sigma(variant, x) * rng.standard_normal(len(x))
    return RegressionData(inputs=x[:, None], targets=y[:, None])


def errors(variant: str, inputs: Floats, predictions: Floats) -> Floats:
    """Distance to the nearest branch in standard deviations of the noise there. Shape (N,)."""
    x = inputs[:, 0]
    y = predictions[:, 0]
    nearest: Floats = np.abs(branches(x) - y[:, None]).min(axis=1)
    return nearest / noise_sigma(variant, x)


def evaluate(variant: str, predict: Predict, seeds: tuple[SeedTree, ...]) -> Arrays:
    """The curves of figure 4.1 on a common grid, with the truth beside them.

    Returns:
        ``x``, ``true_modal``, ``true_aleatoric`` (GRID,); ``true_epistemic`` (equation 4.6, which needs the networks'
        means), ``prediction``, every score of :data:`SCORES` and, from new targets, the left side of equation 4.8,
        ``squared_error``, (E, GRID); the training data of the first network.
    """
    x = np.linspace(-EDGE, FARTHEST, GRID)
    predicted = predict(np.broadcast_to(x[:, None], (len(seeds), GRID, 1)), "figure_4_1")
    data = training(variant, seeds[0].child("data").generator())
    repeated = np.repeat(x, predicted.drawn.shape[2])
    new = [_with_targets(variant, repeated, node.child("targets", variant).generator()).targets for node in seeds]
    missed = np.reshape(new, predicted.drawn.shape) - predicted.drawn
    scores = predicted.scores
    bias = branches(x).mean(axis=-1) - predicted.mean[..., 0]
    return {
        "x": x,
        "true_modal": branches(x).var(axis=-1),  # equation 4.7
        "true_aleatoric": noise_sigma(variant, x) ** 2,
        "true_epistemic": bias**2 + scores["epistemic"],
        "prediction": predicted.prediction[..., 0],
        "squared_error": (missed[..., 0] ** 2).mean(axis=2),
        "training_x": data.inputs[:, 0],
        "training_y": data.targets[:, 0],
        **scores,
    }


SPEC = RegressionSpec(
    id="toy_regression",
    title="Toy regression",
    description=(
        "A number x leads to one of three curves, plus noise; the variants take data away in a region, or add noise "
        "there. Each kind of uncertainty is known exactly, so it can be seen whether a model knows it too."
    ),
    variants=VARIANTS,
    require_variant=require_variant,
    training=training,
    testing=testing,
    errors=errors,
    error_name="distance to the nearest branch (standard deviations of the noise)",
    wrong_above=3.0,
    evaluate=evaluate,
    sections="imagine_bench_regression.sections:toy_sections",
    recorder="imagine_bench_regression.recordings:record_toy",
)
