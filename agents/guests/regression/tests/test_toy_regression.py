"""The toy data and its closed-form truth."""

from __future__ import annotations

import numpy as np
import pytest
from imagine_bench_regression import toy_regression as toy
from scipy import stats


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_branches_by_hand() -> None:
    expected = [7 * np.sin(1.5) + 1, 3 * np.sin(1.0) + 1, 2 * np.sin(0.6) + 19.6]
    np.testing.assert_allclose(toy.branches(np.array(2.0)), expected)


@pytest.mark.parametrize("variant", toy.VARIANTS)
def test_data_has_the_counts_and_the_noise_of_its_variant(variant: str) -> None:
    data = toy.training(variant, rng())
    inside = abs(data.inputs) <= toy.REGION
    assert (inside.sum(), (~inside).sum()) == ((13 if variant == "low_data" else 667), 1333)
    assert abs(data.inputs).max() <= 30
    many = toy.testing(variant, rng(), 60_000)
    nearest = toy.errors(variant, many.inputs, many.targets)  # in standard deviations of the noise
    far = np.abs(np.diff(np.sort(toy.branches(many.inputs[:, 0]), axis=1), axis=1)).min(axis=1) > 20
    assert far.sum() > 500
    assert stats.kstest(nearest[far], "halfnorm").pvalue > 1e-4  # where branches are far apart, the nearest is the own


def test_noise_is_three_times_as_large_in_the_noisy_region_only() -> None:
    x = np.array([-10.1, -10.0, 0.0, 10.0, 10.1])
    np.testing.assert_array_equal(toy.noise_sigma("high_noise", x), [1, 3, 3, 3, 1])
    np.testing.assert_array_equal(toy.noise_sigma("base", x), np.ones(5))
