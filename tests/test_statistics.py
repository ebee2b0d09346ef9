"""Statistics against answers worked out by hand, against scipy's, and against what defines them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from imagine_bench import statistics
from imagine_bench.errors import InvalidValueError


def test_iqm_drops_a_quarter_at_each_end() -> None:
    assert statistics.iqm([1.0, 2.0, 4.0, 100.0]) == 3.0
    assert statistics.iqm([[0.0, 8.0], [1.0, 2.0], [3.0, 100.0], [4.0, -50.0]]) == 2.5  # of -50 0 | 1 2 3 4 | 8 100
    assert statistics.iqm([1.0, 2.0, 9.0]) == 4.0  # three: nothing to trim


def test_impossible_counts_and_no_numbers_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="6 successes in 5 trials is impossible"):
        statistics.wilson(6, 5)
    with pytest.raises(InvalidValueError, match="only finite ones"):
        statistics.iqm([math.nan, 1.0])


def test_running_means_by_hand() -> None:
    # 0.1 at episode 0, 0.35 at 10, 0.5 at 30: areas 2.25 and 2.25 + 8.5.
    means = statistics.running_means((10, 30), [[0.35, 0.5], [0.1, 0.1]], 0.1)
    assert means == pytest.approx(np.array([[0.225, 10.75 / 30.0], [0.1, 0.1]]), abs=1e-12)


FIVE, OTHERS = [0.2, 0.5, 0.55, 0.6, 0.9], [0.1, 0.15, 0.3, 0.2, 0.8, 0.25, 0.2, 0.35]


@pytest.mark.parametrize(("trim", "cut"), [(0.0, 0), (0.25, 2)])
def test_an_interval_is_student_s_and_of_a_trimmed_mean_tukey_s(trim: float, cut: int) -> None:
    """Of eight, so many are cut off at each end."""
    spread = stats.mstats.winsorize(np.array(OTHERS), limits=(trim, trim)).std(ddof=1)
    left = 8 - 2 * cut
    half = stats.t.ppf(0.975, left - 1) * spread * math.sqrt(7 / (left * (left - 1)))  # Yuen (1974)
    middle = stats.trim_mean(OTHERS, trim)
    assert statistics.interval(OTHERS, trim=trim) == pytest.approx((middle - half, middle + half), abs=1e-12)


def test_one_stuck_seed_in_five_does_not_decide() -> None:
    low, high = statistics.interval([0.16, 0.95, 0.96, 0.97, 0.99], trials=200)
    assert 0.85 < low < 0.96 < high <= 1.0
    assert statistics.interval([0.16, 0.95, 0.96], trials=200)[0] == 0.0, "of three it is not trimmed, and says so"


def test_equal_scores_are_as_sure_as_their_tests() -> None:
    low, high = statistics.interval([1.0, 1.0, 1.0], trials=200)
    assert high == 1.0 and 0.985 < low < 0.995
    few_tests, _ = statistics.interval([1.0, 1.0, 1.0], trials=10)
    assert few_tests < 0.9
    assert statistics.interval([0.5, 0.5, 0.5]) == (0.5, 0.5)


def test_intervals_of_shares_stay_shares() -> None:
    assert statistics.interval([0.0, 0.1], trim=0.0)[0] < 0.0
    assert statistics.interval([0.0, 0.1], trim=0.0, share=True)[0] == 0.0


def test_one_run_gives_no_interval() -> None:
    assert all(math.isnan(end) for end in statistics.interval([0.3], trials=200))
    assert math.isnan(statistics.gain([0.3], [0.2]).low)
    assert all(math.isnan(part) for part in statistics.difference([0.3], [0.2])[1:])
    assert math.isnan(statistics.detectable([0.3], [0.2], cells=1))
    assert math.isfinite(statistics.gain([0.3, 0.31], [0.2, 0.21]).low), "two do"


@pytest.mark.parametrize("trim", [0.0, 0.25])
def test_a_difference_is_welch_s_and_of_trimmed_means_yuen_s(trim: float) -> None:
    found = statistics.difference(FIVE, OTHERS, trim=trim)
    expected = stats.ttest_ind(FIVE, OTHERS, equal_var=False, trim=trim)
    assert found.p == pytest.approx(expected.pvalue, abs=1e-12)
    assert found[1:3] == pytest.approx(tuple(expected.confidence_interval(0.95)), abs=1e-11)
    assert found.value == pytest.approx(stats.trim_mean(FIVE, trim) - stats.trim_mean(OTHERS, trim))


def test_equal_runs_differ_by_more_than_their_tests() -> None:
    far = statistics.difference([1.0, 1.0, 1.0], [0.16, 0.16, 0.16], trials=200)
    assert far.value == 0.84 and 0.0 < far.p < 0.01 and 0.7 < far.low < 0.84 < far.high
    near = statistics.difference([1.0, 1.0, 1.0], [0.995, 0.995, 0.995], trials=200)
    assert near.p > 0.2
    assert statistics.difference([3.0, 3.0], [1.0, 1.0, 1.0]) == (2.0, 2.0, 2.0, 0.0), "without tests there is no doubt"


def test_holm_by_hand() -> None:
    found = statistics.holm([0.04, 0.01, math.nan, 0.03])
    assert found.tolist() == pytest.approx([0.06, 0.03, math.nan, 0.06], nan_ok=True), "never below a smaller one's"
    assert statistics.holm([0.9, 0.8]).tolist() == [1.0, 1.0]
    assert statistics.holm([]).shape == (0,)


def test_a_detectable_difference_is_found_four_times_in_five() -> None:
    draw = np.random.default_rng(0)
    found = sizes = 0.0
    for _ in range(400):
        a, b = draw.normal(size=(2, 12))
        size = statistics.detectable(a, b, cells=1)
        sizes += size / 400
    for _ in range(400):
        a, b = draw.normal(size=(2, 12))
        found += statistics.difference(a + sizes, b).p < 0.05
    assert 0.7 < found / 400 < 0.93
    assert statistics.detectable(FIVE, OTHERS, cells=9) > statistics.detectable(FIVE, OTHERS, cells=1)
    assert statistics.detectable([1.0, 1.0], [0.0, 0.0], cells=1) == 0.0


def test_gain_is_the_thesis_table() -> None:
    assert statistics.gain([62.17], [42.18]).value == pytest.approx(0.4739, abs=1e-4)  # table 5.2 at 2000 episodes
    gain, ratio = statistics.gain(FIVE, [0.4, 0.45, 0.5]), statistics.ratio(FIVE, [0.4, 0.45, 0.5])
    assert gain[:3] == pytest.approx([end - 1.0 for end in ratio[:3]])


@pytest.mark.parametrize("paired", [False, True])
def test_a_ratio_s_ends_are_fieller_s(paired: bool) -> None:
    """A ratio r lies inside where a - r b is not clear of zero; at the ends it is just that."""
    a, b = np.array([0.6, 0.7, 0.9, 0.75]), np.array([0.4, 0.5, 0.55, 0.5])
    found = statistics.ratio(a, b, paired=paired)
    assert found.low < found.value == a.mean() / b.mean() < found.high
    for end in found[1:3]:
        if paired:
            p = stats.ttest_1samp(a - end * b, 0.0).pvalue
            assert p == pytest.approx(0.05, abs=1e-9)
        else:
            errors = np.array([a.var(ddof=1), b.var(ddof=1)]) / 4
            freedom = errors.sum() ** 2 / (errors**2 / 3).sum()  # of the difference, which stands for all ratios
            t = (a.mean() - end * b.mean()) / math.sqrt(errors[0] + end**2 * errors[1])
            assert abs(t) == pytest.approx(stats.t.ppf(0.975, freedom), abs=1e-9)


def test_a_gain_over_perhaps_nothing_has_no_interval_and_over_nothing_no_value() -> None:
    value, low, high, _ = statistics.gain([0.3, 0.4, 0.5], [0.0, 0.0, 0.1])
    assert value == pytest.approx(11.0) and math.isnan(low) and math.isnan(high)
    assert math.isnan(statistics.gain([0.1, 0.2], [0.0, 0.0]).value)


def test_a_success_that_is_lost_again_does_not_last() -> None:
    budgets = (10, 20, 40, 80)
    assert statistics.first_lasting(budgets, [0.9, 0.2, 0.1, 0.95], 0.9) == 80
    assert statistics.first_lasting(budgets, [0.2, 0.9, 0.1, 0.1], 0.9) is None
    assert statistics.first_lasting(budgets, [0.2, 0.9, 0.95, 0.9], 0.9) == 20
    assert statistics.first_lasting(budgets, [0.9] * 4, 0.9) == 10


def test_a_ratio_that_every_run_has_is_certain() -> None:
    """Rounding makes the variance of it less than 0 as often as more."""
    for values in np.random.default_rng(0).uniform(0.5, 0.8, (20, 5)):
        found = statistics.ratio(1.1 * values, values, paired=True)
        assert found[:3] == pytest.approx((1.1, 1.1, 1.1), abs=1e-6)


@pytest.mark.parametrize(
    ("first", "second", "alone", "p"),
    [
        ("1111100000", "0000000000", (5, 0), 2 / 2**5),
        ("1100", "0011", (2, 2), 1.0),
        ("1010", "1010", (0, 0), 1.0),
        ("1111111100", "0000000011", (8, 2), 2 * (1 + 10 + 45) / 2**10),
    ],
)
def test_equal_starts_are_compared_exactly(first: str, second: str, alone: tuple[int, int], p: float) -> None:
    """The binomial of an even coin, by hand; tests that both solve or both fail say nothing."""
    found = statistics.mcnemar(first + "1101", second + "1101")
    assert (found.first, found.second) == alone and found.p == pytest.approx(p)
    assert statistics.mcnemar(second, first) == (*reversed(alone), pytest.approx(p))
    with pytest.raises(InvalidValueError, match="are no pairs"):
        statistics.mcnemar(first, second + "1")


@pytest.mark.parametrize(("pairs", "alone", "cells"), [(400, 80, 1), (1000, 100, 6), (200, 1, 1)])
def test_a_detectable_difference_of_pairs_is_found_as_often(pairs: int, alone: int, cells: int) -> None:
    """Benches whose agents differ by just that: four in five of McNemar's exact tests say so."""
    rng = np.random.default_rng(0)
    size = statistics.detectable_paired(statistics.PairedTests(alone // 2, alone - alone // 2, 1.0), pairs, cells=cells)
    share = max(size, alone / pairs)
    chances = [(share + size) / 2, (share - size) / 2]
    found = [
        stats.binomtest(int(b), int(b + c)).pvalue < 0.05 / cells if b + c else False
        for b, c, _ in rng.multinomial(pairs, [*chances, 1.0 - share], size=1000)
    ]
    assert 0.7 < np.mean(found) < 0.9


def test_auroc_and_the_probability_of_improvement_count_pairs() -> None:
    rng = np.random.default_rng(0)
    scores = rng.integers(0, 6, 60).astype(float)
    wrong = rng.random(60) < 0.3
    pairs = np.subtract.outer(scores[wrong], scores[~wrong])
    share = np.mean(0.5 * (np.sign(pairs) + 1.0))
    assert statistics.auroc(scores, wrong) == pytest.approx(share)
    assert statistics.auroc(-scores, wrong) == pytest.approx(1.0 - share)
    assert statistics.probability_of_improvement(scores[wrong], scores[~wrong]) == pytest.approx(share)
    assert statistics.auroc(np.ones(60), wrong) == 0.5
    assert math.isnan(statistics.auroc(scores, np.ones(60, dtype=np.bool_)))
    with pytest.raises(InvalidValueError, match="one number a prediction"):
        statistics.auroc(np.array([1.0]), np.array([True, False]))
