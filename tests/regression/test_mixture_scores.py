"""Scores of predictive mixtures against scipy, numerical integration and cases done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import Mixtures
from imagine_bench.regression import scores
from imagine_bench.regression.scores import coverage, crps, log_score, probability_transform, transform_distance


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


def gaussian(mean: float, sigma: float, rows: int = 1) -> Mixtures:
    return Mixtures(weights=np.ones((rows, 1)), means=np.full((rows, 1, 1), mean), sigmas=np.full((rows, 1, 1), sigma))


def test_crps_integrates_the_squared_difference_of_distributions() -> None:
    m = mixture(2)
    outcomes = np.array([[0.3, -1.0], [5.0, 0.0]])
    closed = crps(m, outcomes)
    for (row, dimension), y in np.ndenumerate(outcomes):
        below = integrate.quad(lambda t, at=(row, dimension): cdf(m, *at, t) ** 2, -20, y)[0]
        above = integrate.quad(lambda t, at=(row, dimension): (1 - cdf(m, *at, t)) ** 2, y, 20)[0]
        assert closed[row, dimension] == pytest.approx(below + above, rel=1e-6)


def test_crps_in_parts_is_that_of_all_pairs_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    m = mixture(4, components=7)
    whole = crps(m, np.zeros((4, 2)))
    for pairs in (1, 2 * m.means.size, 3 * m.means.size):
        monkeypatch.setattr(scores, "_AT_ONCE", pairs)
        np.testing.assert_allclose(crps(m, np.zeros((4, 2))), whole, rtol=1e-12)


def test_crps_of_one_gaussian_and_of_a_point() -> None:
    # Gneiting & Raftery 2007, equation 21, at the mean: sigma (2 pdf(0) - 1 / sqrt(pi))
    expected = 2 * (2 * stats.norm.pdf(0) - 1 / np.sqrt(np.pi))
    assert crps(gaussian(1.0, 2.0), np.array([[1.0]]))[0, 0] == pytest.approx(expected)
    assert crps(gaussian(1.0, 1e-9), np.array([[3.5]]))[0, 0] == pytest.approx(2.5)


def test_crps_prefers_the_truth() -> None:
    outcomes: Floats = np.random.default_rng(0).normal(size=(4000, 1))
    narrow, right, wide = (crps(gaussian(0.0, sigma, 4000), outcomes).mean() for sigma in (0.5, 1.0, 2.0))
    assert right < min(narrow, wide)


def test_transforms_are_the_cdf_and_uniform_for_the_truth() -> None:
    m = mixture(2000)
    rng = np.random.default_rng(1)
    chosen = np.array([rng.choice(3, p=weights) for weights in m.weights])
    rows = np.arange(2000)
    outcomes = m.means[rows, chosen] + m.sigmas[rows, chosen] * rng.standard_normal((2000, 2))
    transforms = probability_transform(m, outcomes)
    assert transforms[5, 1] == pytest.approx(cdf(m, 5, 1, outcomes[5, 1]))
    assert stats.kstest(transforms.ravel(), "uniform").pvalue > 0.01
    assert transform_distance(transforms) == pytest.approx(stats.kstest(transforms.ravel(), "uniform").statistic)
    assert coverage(transforms, 0.8) == pytest.approx(0.8, abs=0.03)


def test_coverage_by_hand() -> None:
    transforms = np.array([0.0, 0.1, 0.25, 0.5, 0.9])
    assert coverage(transforms, 0.5) == 2 / 5
    assert coverage(transforms, 0.8) == 4 / 5
    with pytest.raises(InvalidValueError, match=r"a level in \(0, 1\), not 5 and 1"):
        coverage(transforms, 1.0)


def test_log_score_is_the_density() -> None:
    m = mixture(4)
    normal = stats.norm.pdf(0.0, m.means, m.sigmas).prod(axis=-1)  # [N, K]
    np.testing.assert_allclose(log_score(m, np.zeros((4, 2))), -np.log((m.weights * normal).sum(axis=-1)))
