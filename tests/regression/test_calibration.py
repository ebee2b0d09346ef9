"""Scores of predictive mixtures against scipy, numerical integration and cases done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from imagine_bench import registry
from imagine_bench.interfaces.regression import Mixtures, Prediction
from imagine_bench.regression.runner import calibrate, coverage, log_score


def mixture(rows: int, components: int = 3) -> Mixtures:
    rng = np.random.default_rng(0)
    shape = (rows, components, 2)
    return Mixtures(
        weights=rng.dirichlet(np.ones(components), size=rows),
        means=rng.normal(0.0, 2.0, shape),
        sigmas=rng.uniform(0.2, 1.5, shape),
    )


def test_intervals_of_the_truth_hold_what_they_say() -> None:
    m = mixture(2000)
    rng = np.random.default_rng(1)
    chosen = np.array([rng.choice(3, p=weights) for weights in m.weights])
    rows = np.arange(2000)
    outcomes = m.means[rows, chosen] + m.sigmas[rows, chosen] * rng.standard_normal((2000, 2))
    for level in (0.5, 0.8, 0.95):
        assert coverage(m, outcomes, level).mean() == pytest.approx(level, abs=0.03)


def test_the_interval_of_one_gaussian_is_between_its_quantiles() -> None:
    one = Mixtures(weights=np.ones((4, 1)), means=np.full((4, 1, 1), 1.0), sigmas=np.full((4, 1, 1), 2.0))
    low, high = stats.norm.interval(0.8, 1.0, 2.0)
    outcomes = np.array([low - 1e-6, low + 1e-6, high - 1e-6, high + 1e-6])[:, None]
    assert coverage(one, outcomes, 0.8).ravel().tolist() == [False, True, True, False]


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
        return Prediction(
            weights=np.ones(wrong.shape),
            means=constant[..., None],
            sigmas=np.full((*wrong.shape, 1), 20.0),
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


def test_errors_are_paired_with_the_scores_of_the_same_points() -> None:
    task = registry.regression("toy_regression")
    tests = [task.testing("base", np.random.default_rng(seed), 130) for seed in (0, 1)]
    found = calibrate(task, "base", tests, Knowing(), np.random.default_rng(0))  # type: ignore[arg-type]
    for network, test in enumerate(tests):
        row = {name: values[network] for name, values in found.items()}
        errors = task.errors("base", test.inputs, np.zeros((130, 1)))
        assert 0.0 < row["wrong"] == (errors > 3.0).mean() < 1.0
        assert (row["error_mean"], row["error_median"]) == (errors.mean(), np.median(errors))
        assert row["log_score"] == pytest.approx(-stats.norm.logpdf(test.targets, 0.0, 20.0).mean())
        for level in (0.5, 0.8, 0.95):
            within = abs(test.targets) <= 20.0 * stats.norm.ppf(0.5 + level / 2)
            assert row[f"coverage_{level:g}"] == within.mean()
        assert row["auroc_epistemic"] == 1.0
        assert row["auroc_modal"] == row["auroc_nll"] == 0.0
        assert row["auroc_total"] == row["auroc_aleatoric"] == row["auroc_stationarity"] == 0.5
