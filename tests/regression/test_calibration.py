"""Scores of predictive mixtures against scipy, numerical integration and cases done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from imagine_bench import registry
from imagine_bench.interfaces.regression import Mixtures, Prediction
from imagine_bench.regression.calibration import (
    calibrate,
    coverage,
    crps,
    log_score,
    probability_transform,
)
from imagine_bench.seeding import SeedTree


def mixture(rows: int, components: int = 3) -> Mixtures:
    rng = np.random.default_rng(0)
    shape = (rows, components, 2)
    return Mixtures(
        weights=rng.dirichlet(np.ones(components), size=rows),
        means=rng.normal(0.0, 2.0, shape),
        sigmas=rng.uniform(0.2, 1.5, shape),
    )


def cdf(m: Mixtures, row: int, dimension: int, y: float) -> float:
    normal = stats.norm.cdf(y, m.means[row, :, dimension], m.sigmas[row, :, dimension])
    return float((m.weights[row] * normal).sum())


def gaussian(mean: float, sigma: float) -> Mixtures:
    return Mixtures(weights=np.ones((1, 1)), means=np.full((1, 1, 1), mean), sigmas=np.full((1, 1, 1), sigma))


def test_crps_integrates_the_squared_difference_of_distributions() -> None:
    m = mixture(3)
    outcomes = np.array([[0.3, -1.0], [5.0, 0.0]])  # of the first mixtures alone
    closed = crps(m, outcomes)
    for (row, dimension), y in np.ndenumerate(outcomes):
        below = integrate.quad(lambda t, at=(row, dimension): cdf(m, *at, t) ** 2, -20, y)[0]
        above = integrate.quad(lambda t, at=(row, dimension): (1 - cdf(m, *at, t)) ** 2, y, 20)[0]
        assert closed[row, dimension] == pytest.approx(below + above, rel=1e-6)


def test_crps_of_one_gaussian_and_of_a_point() -> None:
    # Gneiting & Raftery 2007, equation 21, at the mean: sigma (2 pdf(0) - 1 / sqrt(pi))
    expected = 2 * (2 * stats.norm.pdf(0) - 1 / np.sqrt(np.pi))
    assert crps(gaussian(1.0, 2.0), np.array([[1.0]]))[0, 0] == pytest.approx(expected)
    assert crps(gaussian(1.0, 1e-9), np.array([[3.5]]))[0, 0] == pytest.approx(2.5)


def test_transforms_are_the_cdf_and_uniform_for_the_truth() -> None:
    m = mixture(2000)
    rng = np.random.default_rng(1)
    chosen = np.array([rng.choice(3, p=weights) for weights in m.weights])
    rows = np.arange(2000)
    outcomes = m.means[rows, chosen] + m.sigmas[rows, chosen] * rng.standard_normal((2000, 2))
    transforms = probability_transform(m, outcomes)
    assert transforms[5, 1] == pytest.approx(cdf(m, 5, 1, outcomes[5, 1]))
    assert stats.kstest(transforms.ravel(), "uniform").pvalue > 0.01
    assert coverage(transforms, 0.8) == pytest.approx(0.8, abs=0.03)
    assert coverage(np.array([0.0, 0.1, 0.25, 0.5, 0.9]), 0.5) == 2 / 5


def test_log_score_is_the_density() -> None:
    m = mixture(4)
    normal = stats.norm.pdf(0.0, m.means, m.sigmas).prod(axis=-1)  # [N, K]
    np.testing.assert_allclose(log_score(m, np.zeros((4, 2))), -np.log((m.weights * normal).sum(axis=-1)))


class Knowing:
    """Says one thing everywhere, and knows how wrong that is: its epistemic variance, and the negative of its modal."""

    def predict(self, inputs: np.ndarray, rng: np.random.Generator) -> Prediction:
        prediction = np.zeros((*inputs.shape[:2], 1))
        toy = registry.regression("toy_regression")
        wrong = np.stack([toy.errors("base", *pair) for pair in zip(inputs, prediction, strict=True)])[..., None]
        constant = np.zeros(wrong.shape)
        wide = self.pooled(inputs)
        return Prediction(
            weights=wide.weights,
            means=wide.means,
            sigmas=wide.sigmas,
            prediction=prediction,
            mean=prediction,
            epistemic=wrong,
            aleatoric=constant,
            modal=-wrong,
            stationarity=constant[..., 0],
            sampled_variance=constant[..., 0],
            nll=-wrong[..., 0],
            drawn=prediction[:, :, None],
        )

    def pooled(self, inputs: np.ndarray) -> Mixtures:
        shape = (*inputs.shape[:2], 1)
        return Mixtures(weights=np.ones(shape), means=np.zeros((*shape, 1)), sigmas=np.full((*shape, 1), 1e6))


def test_errors_are_paired_with_the_scores_of_the_same_points() -> None:
    task = registry.regression("toy_regression")
    networks = (SeedTree(0), SeedTree(1))
    rows, arrays = calibrate(task, Knowing(), "base", networks, points=130, rng=np.random.default_rng(0))  # type: ignore[arg-type]
    assert arrays["calibration/error"].shape == (2, 130)
    assert not np.array_equal(*arrays["calibration/error"])
    for row in rows:
        assert 0.0 < float(row["wrong"]) < 1.0
        assert row["auroc_epistemic"] == 1.0
        assert row["auroc_modal"] == row["auroc_nll"] == 0.0
        assert row["auroc_total"] == row["auroc_aleatoric"] == row["auroc_stationarity"] == 0.5
        assert row["coverage_0.5"] == row["pooled_coverage_0.5"] == 1.0, "so wide: every outcome is near its median"
