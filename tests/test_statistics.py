"""Statistics against answers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from imagine_bench import statistics
from imagine_bench.errors import InvalidValueError


def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_iqm_drops_a_quarter_at_each_end() -> None:
    assert statistics.iqm([1.0, 2.0, 4.0, 100.0]) == 3.0
    assert statistics.iqm([[0.0, 8.0], [1.0, 2.0], [3.0, 100.0], [4.0, -50.0]]) == 2.5  # of -50 0 | 1 2 3 4 | 8 100
    assert statistics.iqm([1.0, 2.0, 9.0]) == 4.0  # three: nothing to trim


def test_wilson_by_hand() -> None:
    z = 1.959963984540054
    n, p = 10, 0.8
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    assert statistics.wilson(8, 10) == pytest.approx((centre - half, centre + half), abs=1e-12)
    assert statistics.wilson(0, 5)[0] == 0.0
    assert statistics.wilson(5, 5)[1] == 1.0


def test_wilson_refuses_impossible_counts() -> None:
    with pytest.raises(InvalidValueError, match="6 successes in 5 trials is impossible"):
        statistics.wilson(6, 5)


def test_bootstrap_of_two_runs_has_the_three_possible_means() -> None:
    # Resamples of (0, 1): mean 0 with 1/4, 1/2 with 1/2, 1 with 1/4; so 95 % spans everything.
    assert statistics.bootstrap_interval([0.0, 1.0], rng(), statistic="mean") == (0.0, 1.0)
    # Of five runs, one of them 1, a mean above 0.6 has 0.67 %, one of at least 0.6 has 5.8 %: 95 % ends at 0.6.
    assert statistics.bootstrap_interval([0.0] * 4 + [1.0], rng(), statistic="mean") == (0.0, 0.6)


def test_running_means_by_hand() -> None:
    # 0.1 at episode 0, 0.3 at 10, 0.5 at 30: areas 2 and 2 + 8.
    means = statistics.running_means((10, 30), [[0.3, 0.5], [0.1, 0.1]], 0.1)
    assert means == pytest.approx(np.array([[0.2, 10.0 / 30.0], [0.1, 0.1]]), abs=1e-12)


def test_who_learns_earlier_has_the_larger_running_mean() -> None:
    early, late = statistics.running_means((100, 250, 1000), [[0.9, 0.9, 0.9], [0.1, 0.1, 0.9]], 0.05)
    assert (early > late).all()


def test_running_means_need_one_score_a_budget() -> None:
    with pytest.raises(InvalidValueError, match=r"2 budgets need scores of shape \(runs, 2\), not \(1, 3\)"):
        statistics.running_means((10, 30), [[0.1, 0.2, 0.3]], 0.0)


def test_bootstrap_repeats_and_brackets_the_point() -> None:
    scores = [0.2, 0.5, 0.55, 0.6, 0.9]
    first = statistics.bootstrap_interval(scores, rng())
    assert first == statistics.bootstrap_interval(scores, rng())
    assert first[0] < statistics.iqm(scores) < first[1]


def test_bootstrap_covers_as_often_as_it_says() -> None:
    draw = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        low, high = statistics.bootstrap_interval(draw.normal(size=20), draw, statistic="mean")
        hits += low <= 0.0 <= high
    assert 0.87 <= hits / 200 <= 0.98  # percentile bootstrap of 20 undercovers slightly


def test_one_run_gives_no_interval() -> None:
    assert all(math.isnan(end) for end in statistics.bootstrap_interval([0.3], rng()))
    assert math.isnan(statistics.gain([0.3], [0.2], rng()).low)


def test_difference_by_hand() -> None:
    assert statistics.difference([3.0, 3.0], [1.0, 1.0, 1.0], rng()) == (2.0, 2.0, 2.0)
    value, low, high = statistics.difference([0.0, 1.0], [0.0, 1.0], rng())
    assert (value, low, high) == (0.0, -1.0, 1.0)  # either side is 0 or 1 with 1/4 each: both ends have 1/16


def test_a_difference_of_nothing_is_nothing() -> None:
    """Success rates lie on a lattice: an end at exactly 0 must not be ahead by the rounding of its sums."""
    ours, theirs = np.array([997, 999, 998]) / 1000, np.array([998, 995, 994]) / 1000
    lows = [statistics.difference(ours, theirs, np.random.default_rng(seed)).low for seed in range(20)]
    assert 0.0 in lows and all(low == 0.0 or abs(low) > 1e-6 for low in lows)
    assert statistics.difference([0.1, 0.2, 0.3], [0.3, 0.1, 0.2], np.random.default_rng(0)).value == 0.0


def test_gain_is_the_thesis_table() -> None:
    value, _, _ = statistics.gain([62.17], [42.18], rng())
    assert value == pytest.approx(0.4739, abs=1e-4)  # table 5.2 at 2000 episodes


def test_gain_resamples_both_sides() -> None:
    assert statistics.gain([0.6, 0.6, 0.6], [0.4, 0.4], rng()) == pytest.approx((0.5, 0.5, 0.5))
    # Base means 0.2, 0.3, 0.4 with 1/4, 1/2, 1/4: gains 2, 1, 0.5.
    assert statistics.gain([0.6, 0.6], [0.2, 0.4], rng()) == pytest.approx((1.0, 0.5, 2.0))


def test_a_gain_boundless_in_just_its_tail_has_no_interval(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def resampled(values: np.ndarray, _: object) -> np.ndarray:
        draws = np.full((statistics.RESAMPLES, *values.shape), 0.5)
        draws[: statistics.RESAMPLES // 40] = 0.0  # 2.5 %
        return draws

    monkeypatch.setattr(statistics, "_resample", resampled)
    assert math.isnan(statistics.gain([0.5, 0.5], [0.5, 0.5], rng()).high)


def test_a_gain_without_bound_has_no_interval() -> None:
    """8 of 27 resamples of the base never succeed: leaving them out would cut off the upper end."""
    value, low, high = statistics.gain([0.3, 0.4, 0.5], [0.0, 0.0, 0.1], rng())
    assert value == pytest.approx(11.0) and math.isnan(low) and math.isnan(high)
    scarce = statistics.gain([0.3] * 8, [0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1, 0.1], rng())
    assert 0.0 < scarce.low < scarce.high < math.inf, "so few that the upper end is not among them"


def test_gain_over_nothing_is_not_a_number() -> None:
    assert math.isnan(statistics.gain([0.1, 0.2], [0.0, 0.0], rng()).value)


@pytest.mark.parametrize("scores", [[], [float("nan"), 1.0]])
def test_scores_must_be_numbers(scores: list[float]) -> None:
    with pytest.raises(InvalidValueError, match="only finite ones"):
        statistics.iqm(scores)


def test_a_success_that_is_lost_again_does_not_last() -> None:
    budgets = (10, 20, 40, 80)
    assert statistics.first_lasting(budgets, [0.9, 0.2, 0.1, 0.95], 0.9) == 80
    assert statistics.first_lasting(budgets, [0.2, 0.9, 0.1, 0.1], 0.9) is None
    assert statistics.first_lasting(budgets, [0.2, 0.9, 0.95, 0.9], 0.9) == 20
