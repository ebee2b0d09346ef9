"""Calibration measures against scipy, numerical integration and cases done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.regression import Mixtures
from imagine_bench.judge import calibration
from imagine_bench.judge.calibration import coverage, crps, log_score, probability_transform, transform_distance
from imagine_bench.statistics import auroc


def mixture(seed: int = 0, rows: int = 4, components: int = 3, size: int = 2) -> Mixtures:
    rng = np.random.default_rng(seed)
    return Mixtures(
        weights=rng.dirichlet(np.ones(components), size=rows),
        means=rng.normal(0.0, 2.0, (rows, components, size)),
        sigmas=rng.uniform(0.2, 1.5, (rows, components, size)),
    )


def distribution(m: Mixtures, row: int, d: int, y: np.ndarray) -> np.ndarray:
    parts = zip(m.weights[row], m.means[row, :, d], m.sigmas[row, :, d], strict=True)
    return sum(w * stats.norm.cdf(y, mean, sigma) for w, mean, sigma in parts)


def test_crps_integrates_the_squared_difference_of_distributions() -> None:
    m, outcomes = mixture(), np.array([[0.3, -1.0], [5.0, 0.0], [-7.0, 2.0], [0.0, 0.0]])
    closed = crps(m, outcomes)
    for row in range(4):
        for d in range(2):
            y = outcomes[row, d]
            below = integrate.quad(lambda t, r=row, k=d: distribution(m, r, k, t) ** 2, -20, y, limit=200)[0]
            above = integrate.quad(lambda t, r=row, k=d: (1 - distribution(m, r, k, t)) ** 2, y, 20, limit=200)[0]
            assert closed[row, d] == pytest.approx(below + above, rel=1e-6)


def test_crps_in_parts_is_that_of_all_pairs_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    m, outcomes = mixture(components=7), np.zeros((4, 2))
    whole = crps(m, outcomes)
    for pairs in (1, 2 * m.means.size, 3 * m.means.size):
        monkeypatch.setattr(calibration, "_AT_ONCE", pairs)
        np.testing.assert_allclose(crps(m, outcomes), whole, rtol=1e-12)


def test_crps_of_one_gaussian_and_of_a_point() -> None:
    one = Mixtures(weights=np.ones((1, 1)), means=np.array([[[1.0]]]), sigmas=np.array([[[2.0]]]))
    # Gneiting & Raftery 2007, equation 21, at the mean: sigma (2 pdf(0) - 1 / sqrt(pi))
    assert crps(one, np.array([[1.0]]))[0, 0] == pytest.approx(2 * (2 * stats.norm.pdf(0) - 1 / np.sqrt(np.pi)))
    point = Mixtures(weights=np.ones((1, 1)), means=np.array([[[1.0]]]), sigmas=np.array([[[1e-9]]]))
    assert crps(point, np.array([[3.5]]))[0, 0] == pytest.approx(2.5)


def test_crps_prefers_the_truth() -> None:
    rng = np.random.default_rng(0)
    outcomes = rng.normal(size=(4000, 1))
    score = {}
    for sigma in (0.5, 1.0, 2.0):
        shape = (4000, 1, 1)
        own = Mixtures(weights=np.ones((4000, 1)), means=np.zeros(shape), sigmas=np.full(shape, sigma))
        score[sigma] = crps(own, outcomes).mean()
    assert score[1.0] < min(score[0.5], score[2.0])


def test_transforms_are_the_cdf_and_uniform_for_the_truth() -> None:
    m = mixture(rows=2000)
    rng = np.random.default_rng(1)
    chosen = np.array([rng.choice(3, p=w) for w in m.weights])
    rows = np.arange(2000)
    outcomes = m.means[rows, chosen] + m.sigmas[rows, chosen] * rng.standard_normal((2000, 2))
    transforms = probability_transform(m, outcomes)
    assert transforms[5, 1] == pytest.approx(distribution(m, 5, 1, outcomes[5, 1]))
    assert stats.kstest(transforms.ravel(), "uniform").pvalue > 0.01
    assert transform_distance(transforms) < 0.04
    assert coverage(transforms, 0.8) == pytest.approx(0.8, abs=0.03)
    narrow = Mixtures(weights=m.weights, means=m.means, sigmas=m.sigmas / 3)
    assert coverage(probability_transform(narrow, outcomes), 0.8) < 0.7  # surer than it may be


def test_coverage_by_hand() -> None:
    transforms = np.array([0.0, 0.1, 0.25, 0.5, 0.9])
    assert coverage(transforms, 0.5) == 2 / 5
    assert coverage(transforms, 0.8) == 4 / 5
    with pytest.raises(InvalidValueError, match=r"a level in \(0, 1\), not 5 and 1"):
        coverage(transforms, 1.0)


def test_log_score_is_the_density() -> None:
    m, outcomes = mixture(), np.zeros((4, 2))
    density = [
        sum(
            w * stats.multivariate_normal.pdf(outcomes[r], m.means[r, k], np.diag(m.sigmas[r, k] ** 2))
            for k, w in enumerate(m.weights[r])
        )
        for r in range(4)
    ]
    np.testing.assert_allclose(log_score(m, outcomes), -np.log(density))


def test_auroc_by_hand_and_against_counting_pairs() -> None:
    assert auroc(np.array([0.1, 0.2, 0.3, 0.4]), np.array([False, False, True, True])) == 1.0
    assert auroc(np.array([0.4, 0.3, 0.2, 0.1]), np.array([False, False, True, True])) == 0.0
    assert auroc(np.array([1.0, 1.0, 1.0]), np.array([False, True, True])) == 0.5
    assert np.isnan(auroc(np.array([1.0, 2.0]), np.array([True, True])))
    rng = np.random.default_rng(0)
    scores, wrong = rng.integers(0, 6, 60).astype(float), rng.random(60) < 0.3
    pairs = [(a > b) + 0.5 * (a == b) for a in scores[wrong] for b in scores[~wrong]]
    assert auroc(scores, wrong) == pytest.approx(np.mean(pairs))
    u = stats.mannwhitneyu(scores[wrong], scores[~wrong]).statistic
    assert auroc(scores, wrong) == pytest.approx(u / (wrong.sum() * (~wrong).sum()))
    with pytest.raises(InvalidValueError, match="one number a prediction"):
        auroc(np.array([1.0]), np.array([True, False]))
