"""Statistics against answers worked out by hand, against scipy's, and against their definitions."""

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


@pytest.mark.parametrize("trials", [1, 7, 200])
def test_one_run_s_interval_is_wilson_s(trials: int) -> None:
    for successes in {0, 1, trials // 3, trials}:
        wanted = stats.binomtest(successes, trials).proportion_ci(method="wilson")
        assert statistics.wilson(successes, trials) == pytest.approx((wanted.low, wanted.high), abs=1e-12)


FIVE, OTHERS = [0.2, 0.5, 0.55, 0.6, 0.9], [0.1, 0.15, 0.3, 0.2, 0.8, 0.25, 0.2, 0.35]


def student(values: list[float], trim: float) -> tuple[float, float]:
    """Tukey and McLaughlin's interval (1963), with the degrees of freedom of all values."""
    cut, count = int(trim * len(values)), len(values)
    spread = stats.mstats.winsorize(np.array(values), limits=(trim, trim)).std(ddof=1)
    left = count - 2 * cut
    half = stats.t.ppf(0.975, count - 1) * spread * math.sqrt((count - 1) / (left * (left - 1)))  # Yuen (1974)
    middle = stats.trim_mean(values, trim)
    return middle - half, middle + half


@pytest.mark.parametrize("scores", [OTHERS, [0.1, 0.12, 0.15, 0.2, 0.8, 0.85, 0.9, 0.95]])
def test_an_interval_holds_what_the_trimmed_and_the_plain_mean_allow(scores: list[float]) -> None:
    """And the median's exact interval: of eight, from the least to the greatest. Of two groups, the trimmed decides."""
    found = statistics.interval(scores, share=False)
    ends = [student(scores, 0.0), student(scores, 0.25), (min(scores), max(scores))]
    assert found == pytest.approx((min(low for low, _ in ends), max(high for _, high in ends)), abs=1e-12)
    assert statistics.bounds([scores, scores], share=False).T.tolist() == [list(found), list(found)], "many at once"


def test_a_trimmed_mean_hides_a_stuck_run_and_its_interval_does_not() -> None:
    """One of nine is stuck and cut off, as in the median's interval: the trimmed mean says 95 %."""
    scores = [0.16, 0.94, 0.95, 0.95, 0.96, 0.96, 0.97, 0.98, 0.99]
    assert statistics.iqm(scores) == pytest.approx(0.958)
    low, high = statistics.interval(scores)
    assert low == pytest.approx(student(scores, 0.0)[0]) and low < 0.68 and high == 1.0


def test_the_chance_of_common_starts_is_in_a_level() -> None:
    """Runs that agree are as sure as one run's tests: the starts are the same for all."""
    equal = [1.0] * statistics.FEWEST
    assert statistics.interval(equal, trials=200) == pytest.approx(statistics.wilson(200, 200))
    assert statistics.interval(equal, trials=10) == pytest.approx(statistics.wilson(10, 10))
    assert statistics.interval(equal) == (1.0, 1.0)
    apart = [0.5, 0.52, 0.55, 0.6, 0.62, 0.65, 0.7]
    alone, starts = statistics.interval(apart), statistics.wilson(round(0.588 * 1000), 1000)
    both = statistics.interval(apart, trials=1000)
    assert 0.588 - both[0] == pytest.approx(math.hypot(0.588 - alone[0], 0.588 - starts[0]), abs=1e-12)


def test_no_interval_of_rates_leaves_zero_to_one() -> None:
    rates = [0.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.9]
    assert statistics.interval(rates)[0] == 0.0 > statistics.interval(rates, share=False)[0]
    assert statistics.interval([1.0 - rate for rate in rates])[1] == 1.0
    with pytest.raises(InvalidValueError, match=r"-1 to 2 are no shares in \[0, 1\]; pass share=False for others"):
        statistics.interval([-1.0, 2.0])


@pytest.mark.parametrize("runs", range(1, statistics.FEWEST))
def test_too_few_runs_say_nothing(runs: int) -> None:
    """Between two groups of equal size three runs are all of one group in 25 of 100 samples, six still in 3."""
    few, base = [0.3] * runs, [0.2, 0.25, 0.2, 0.2, 0.2, 0.3, 0.25]
    assert all(math.isnan(end) for end in statistics.interval(few, trials=200))
    found = statistics.difference(few, base)
    assert found.value == pytest.approx(0.3 - statistics.iqm(base))
    nothing = [*found[1:], *statistics.gain(few, base)[1:3], statistics.detectable(few, base, cells=1)]
    assert all(map(math.isnan, nothing)) == (runs < statistics.FEWEST_TESTED)
    assert statistics.can_show((runs, 7), 1) == (runs >= statistics.FEWEST_TESTED)


def test_both_the_trimmed_and_the_plain_means_must_differ() -> None:
    """Each of two groups, four runs and one: the trimmed means see one group alone."""
    most_fail, most_solve = [0.2, 0.21, 0.22, 0.2, 0.95], [0.95, 0.96, 0.94, 0.95, 0.2]
    found = statistics.difference(most_fail, most_solve)
    assert found.p > stats.ttest_ind(most_fail, most_solve, equal_var=False).pvalue > 0.05 and found.high > 0.0
    assert stats.ttest_ind(most_fail, most_solve, equal_var=False, trim=0.25).pvalue < 0.001, "Yuen's alone would"


def test_a_difference_has_welchs_statistic() -> None:
    found = statistics.difference(FIVE, OTHERS, trim=0.0)
    welch = stats.ttest_ind(FIVE, OTHERS, equal_var=False)
    freedom = (welch.df + 4) / 2
    assert found.p == pytest.approx(2 * stats.t.sf(welch.statistic, freedom))
    apart = np.mean(FIVE) - np.mean(OTHERS)
    half = stats.t.ppf(0.975, freedom) * apart / welch.statistic
    assert found[:3] == pytest.approx((apart, apart - half, apart + half))
    trimmed = statistics.difference(FIVE, OTHERS)
    assert trimmed.value == pytest.approx(stats.trim_mean(FIVE, 0.25) - stats.trim_mean(OTHERS, 0.25))
    assert (trimmed.low <= found.low) and (trimmed.high >= found.high) and trimmed.p >= found.p


@pytest.mark.parametrize("runs", [(5, 5), (5, 10), (7, 7), (20, 6)])
def test_no_p_value_is_below_the_chance_of_two_groups(runs: tuple[int, int]) -> None:
    """Runs of one law that has two groups fall apart by agents so often, at the worst share of the groups."""
    shares = np.linspace(0.001, 0.999, 999)
    worst = 2.0 * (shares ** runs[0] * (1.0 - shares) ** runs[1]).max()
    found = statistics.difference([1.0] * runs[0], [0.0] * runs[1])
    assert found.p == pytest.approx(worst, rel=1e-4) and found[:3] == (1.0, 1.0, 1.0)
    cells = int(0.05 / found.p)
    assert statistics.can_show(runs, cells) and not statistics.can_show(runs, cells + 1)
    assert math.isnan(statistics.detectable([1.0] * runs[0], [0.0] * runs[1], cells=cells + 1))


def test_equal_runs_differ_by_more_than_their_tests() -> None:
    """Five runs of 200 tests have the error of 1,000 tests, by Agresti and Coull's share (1998)."""
    ones, few = [1.0] * 5, [0.16] * 5
    errors = np.array([math.sqrt(p * (1.0 - p) / 1000) for p in (1002 / 1004, 162 / 1004)])
    both, welch = math.hypot(*errors), (errors**2).sum() ** 2 / (errors**4 / 4).sum()
    freedom = (welch + 4) / 2
    half = stats.t.ppf(0.975, freedom) * both
    assert statistics.difference(ones, few, trials=200) == pytest.approx((0.84, 0.84 - half, 0.84 + half, 2 / 2**10))
    least = both * (stats.t.isf(0.05 / 6, freedom) + stats.t.ppf(0.8, freedom))
    assert statistics.detectable(ones, few, cells=3, trials=200) == pytest.approx(least)
    ratio = statistics.ratio(ones, few, trials=200)
    assert statistics.gain(ones, few, trials=200)[:3] == pytest.approx([end - 1.0 for end in ratio[:3]])
    for end in ratio[1:3]:
        assert abs(1.0 - end * 0.16) == pytest.approx(
            stats.t.ppf(0.975, welch) * math.hypot(errors[0], end * errors[1])
        )
    assert statistics.difference([0.5] * 6, [0.5] * 6) == (0.0, 0.0, 0.0, 1.0), "all alike"


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
    assert statistics.detectable([1.0] * 5, [0.0] * 5, cells=1) == 0.0


def test_gain_is_the_thesis_table() -> None:
    assert statistics.gain([62.17], [42.18]).value == pytest.approx(0.4739, abs=1e-4)  # table 5.2 at 2000 episodes


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


def test_a_gain_over_nothing_has_no_value() -> None:
    assert statistics.gain([0.3, 0.4, 0.5, 0.3, 0.5], [0.0, 0.0, 0.1, 0.0, 0.0]).value == pytest.approx(19.0)
    assert math.isnan(statistics.gain([0.1, 0.2], [0.0, 0.0]).value)


@pytest.mark.parametrize("paired", [False, True])
def test_a_ratio_has_ends_exactly_where_its_base_is_clear_of_zero(paired: bool) -> None:
    rng, clear = np.random.default_rng(0), []
    for a, b in rng.uniform(0.2, 0.8, (100, 2, 4)) - [[0.0], [0.25]]:
        if paired:
            freedom = 3.0
        else:
            freedom = stats.ttest_ind(a, b, equal_var=False).df
        least, most = stats.t.interval(0.95, freedom, b.mean(), stats.sem(b))
        clear.append(least > 0.0 or most < 0.0)
        found = statistics.ratio(a, b, paired=paired)
        assert math.isnan(found.low) == math.isnan(found.high) == (not clear[-1])
    assert 20 < sum(clear) < 80


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


def test_a_table_without_other_cells_is_strict() -> None:
    pairs = statistics.PairedTests(40, 20, 1.0)
    least, one = (
        (
            statistics.detectable(FIVE, OTHERS, cells=cells),
            statistics.detectable_paired(pairs, 400, cells=cells),
            statistics.more_seeds(FIVE, OTHERS, cells=cells),
        )
        for cells in (0, 1)
    )
    assert least == one and min(one) > 0.0


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


def test_so_many_more_runs_would_show_a_difference_in_four_of_five() -> None:
    """Of normal runs 20 points apart, with a standard deviation of 15: the answer of more_seeds for 6 is their true
    need.
    """
    rng = np.random.default_rng(0)
    pairs = rng.normal([[0.6], [0.4]], 0.15, (200, 2, 6))
    counts = [6 + statistics.more_seeds(a, b, cells=2) for a, b in pairs if statistics.difference(a, b).p > 0.025]
    enough = int(np.median(counts))
    a, b = rng.normal([[0.6], [0.4]], 0.15, (500, 2, enough)).swapaxes(0, 1)
    assert 0.7 < np.mean(statistics.differences(a, b)[3] < 0.025) < 0.97
    now = math.sqrt(sum(p * (1.0 - p) / tests for p, tests in ((552 / 1004, 1000), (702 / 1404, 1400))))  # of 200 tests
    least = (sum(stats.t.ppf([0.9875, 0.8], count - 1)) * now * math.sqrt(5 / count) for count in range(6, 99))
    needed = next(more for more, size in enumerate(least, 1) if size <= 0.05)
    assert statistics.more_seeds([0.55] * 5, [0.5] * 7, cells=2, trials=200) == needed == 6
    assert statistics.more_seeds([0.5], [0.7], cells=2) == 0, "a single run has no spread"
    assert statistics.more_seeds([0.5, 0.6], [0.6, 0.5], cells=2) == 0, "no number of runs shows that nothing differs"
    assert statistics.more_seeds([0.9, 0.91, 0.92], [0.1, 0.11, 0.12], cells=2) == 2, (
        "three runs are too few, five are not"
    )
