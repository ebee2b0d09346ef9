"""What a handful of seeds allows one to say: pure functions on one score a run, shape (runs,); no random draws.

The score of an agent is the interquartile mean over seeds (Agarwal et al., "Deep RL at the edge of the statistical
precipice", 2021): the middle half, so that one seed that is stuck does not decide. Of three seeds that is their mean.
Intervals and tests are Student's on trimmed means (Tukey and McLaughlin 1963; Yuen 1974), which keep their promise from
three seeds on; ``tests/measure/coverage.py`` measures that on the scores kept in docs/results. Percentile bootstraps do
not: of three seeds theirs cover 73 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts load, slowly, when they are first used
from numpy.typing import ArrayLike, NDArray

from imagine_bench.arrays import Floats
from imagine_bench.errors import InvalidValueError

LEVEL = 0.95  #: coverage of every interval
POWER = 0.8  #: probability with which :func:`detectable` would be found
_TRIM = 0.25  # of the scores, at each end
_DIGITS = 12
"""Decimals of differences: success rates lie on a lattice, and two equal sums in another order must not differ."""


class Estimate(NamedTuple):
    """A point estimate, its interval, and for differences the two-sided p-value; NaN where one run allows none."""

    value: float
    low: float
    high: float
    p: float = math.nan


class _Location(NamedTuple):
    """A trimmed mean, its standard error and degrees of freedom."""

    value: float
    error: float
    freedom: int


def iqm(scores: ArrayLike) -> float:
    """Interquartile mean: the mean of the middle half of all scores (of fewer than four: the plain mean)."""
    return float(scipy.stats.trim_mean(_finite(scores).ravel(), _TRIM))


def interval(
    scores: ArrayLike, *, trials: int | None = None, trim: float = _TRIM, share: bool = False
) -> tuple[float, float]:
    """95 % interval of the interquartile mean over the population of runs, from ``scores`` (runs,).

    Args:
        scores: One score a run.
        trials: Tests behind each score, which is a share of them. Their chance is in the spread between runs too; where
            the runs happen to agree, the interval is as wide as it alone makes it.
        trim: Share of the scores that is left out at each end; 0 for an interval of the plain mean.
        share: Whether scores are shares, so that no interval leaves [0, 1]; with ``trials`` they are.

    Both ends are NaN with fewer than two runs, which say nothing of their spread.

    Raises:
        InvalidValueError: Scores that are empty, not finite, or of another shape.
    """
    values = _runs(scores)
    if len(values) < 2:
        return math.nan, math.nan
    value, error, freedom = _location(values, trials, trim)
    half = float(scipy.stats.t.ppf(0.5 + LEVEL / 2.0, freedom)) * error
    low = value - half
    high = value + half
    return (max(low, 0.0), min(high, 1.0)) if share or trials is not None else (low, high)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success probability after ``trials`` independent trials (Wilson, 1927).

    Raises:
        InvalidValueError: Not 0 <= successes <= trials, or no trial.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidValueError(
            f"{successes} successes in {trials} trials is impossible; give 0 <= successes <= trials."
        )
    found = scipy.stats.binomtest(successes, trials).proportion_ci(confidence_level=LEVEL, method="wilson")
    return float(found.low), float(found.high)


def first_lasting(budgets: Sequence[int], scores: ArrayLike, threshold: float) -> int | None:
    """The first of ascending budgets from which on every score (B,) is at least ``threshold``; None where none is."""
    below = np.flatnonzero(_runs(scores) < threshold)
    first = int(below[-1]) + 1 if len(below) else 0
    return budgets[first] if first < len(budgets) else None


def running_means(budgets: Sequence[int], scores: ArrayLike, at_zero: float) -> Floats:
    """Area under each curve up to each budget, divided by the budget: the mean score of all episodes until then.

    Curves are straight between tests at ascending budgets, and from ``at_zero`` at episode 0 to the first test.
    Scores and result have shape (runs, B).
    """
    table = _finite(scores)
    values = np.insert(table, 0, at_zero, axis=1)  # [runs, B + 1]
    areas = scipy.integrate.cumulative_trapezoid(values, [0, *budgets], axis=1)
    return np.asarray(areas / budgets)


class PairedTests(NamedTuple):
    """Tests of two trained agents from the same starts, by who alone solved them."""

    first: int  #: Solved by the first alone
    second: int  #: Solved by the second alone
    p: float  #: Of so uneven a split or more, were both equally likely: McNemar's test (1947), exact


def mcnemar(first: str, second: str) -> PairedTests:
    """Compare two runs' tests, each a text of ``1`` (solved) and ``0`` for the same starts in the same order.

    It tells two trained agents apart, not two ways of training.

    Raises:
        InvalidValueError: Texts of different lengths.
    """
    if len(first) != len(second):
        raise InvalidValueError(f"{len(first)} and {len(second)} tests are no pairs; give those of the same starts.")
    pairs = list(zip(first, second, strict=True))
    alone = pairs.count(("1", "0"))
    other = pairs.count(("0", "1"))
    p = float(scipy.stats.binomtest(alone, alone + other).pvalue) if alone + other else 1.0
    return PairedTests(alone, other, p)


def detectable_paired(found: PairedTests, pairs: int, *, cells: int) -> float:
    """Smallest difference of two success rates that :func:`mcnemar` would have shown with probability 80 %.

    From the share of ``pairs`` in which one alone succeeded, which is at least the difference, at the strictest level
    of :func:`holm` in a table of so many ``cells``; the normal approximation (Connor 1987).
    """
    level = (1.0 - LEVEL) / max(cells, 1)
    square = float(scipy.stats.norm.isf(level / 2.0) + scipy.stats.norm.ppf(POWER)) ** 2
    least = square / (pairs + square)
    return math.sqrt(least * max(least, (found.first + found.second) / pairs))


def probability_of_improvement(treated: ArrayLike, base: ArrayLike) -> float:
    """Probability that a run of the one scores more than one of the other, half where they tie (Agarwal et al., 2021).

    Over all pairs of their runs, (n,) and (m,).
    """
    return _chance_of_more(_runs(treated), _runs(base))


def difference(treated: ArrayLike, base: ArrayLike, *, trials: int | None = None, trim: float = _TRIM) -> Estimate:
    """Difference of the interquartile means of two agents' runs, (n,) and (m,): Yuen's test for unequal variances.

    Runs of one seed share starts and first weights, but what training makes of them does not agree: of the kept benches
    the correlation over seeds is about 0.1, so they are not paired. ``trials`` and ``trim`` are as in :func:`interval`.
    """
    a = _runs(treated)
    b = _runs(base)
    if min(len(a), len(b)) < 2:
        return Estimate(round(iqm(a) - iqm(b), _DIGITS), math.nan, math.nan)
    value, error, freedom = _contrast(a, b, trials, trim)
    if error == 0.0:
        return Estimate(value, value, value, float(value == 0.0))
    half = float(scipy.stats.t.ppf(0.5 + LEVEL / 2.0, freedom)) * error
    return Estimate(value, value - half, value + half, 2.0 * float(scipy.stats.t.sf(abs(value) / error, freedom)))


def holm(p_values: ArrayLike) -> Floats:
    """Adjusted p-values of one table (Holm 1979): all below 0.05 are right together with probability 95 %.

    Those that are NaN are no tests. Shape as given, (tests,).
    """
    given = np.asarray(p_values, dtype=np.float64)
    adjusted = np.full(given.shape, np.nan)
    tested = np.flatnonzero(~np.isnan(given))
    order = tested[np.argsort(given[tested], kind="stable")]
    adjusted[order] = np.minimum(np.maximum.accumulate(given[order] * np.arange(len(order), 0, -1)), 1.0)
    return adjusted


def detectable(treated: ArrayLike, base: ArrayLike, *, cells: int, trials: int | None = None) -> float:
    """Smallest difference of two agents that a table of so many ``cells`` would have shown with probability 80 %.

    From the spread of their runs, at the strictest level of :func:`holm`; NaN where one run shows no spread.
    """
    a = _runs(treated)
    b = _runs(base)
    if min(len(a), len(b)) < 2:
        return math.nan
    _, error, freedom = _contrast(a, b, trials, _TRIM)
    level = (1.0 - LEVEL) / max(cells, 1)
    return error * float(scipy.stats.t.isf(level / 2.0, freedom) + scipy.stats.t.ppf(POWER, freedom))


def gain(treated: ArrayLike, base: ArrayLike, *, trials: int | None = None) -> Estimate:
    """Relative gain (P_aug - P_base) / P_base of mean success rates (thesis tables 5.2 and 5.4).

    A gain of 0.5 is half as much again; NaN where the base never succeeds. See :func:`ratio` for the interval.
    """
    found = ratio(treated, base, trials=trials)
    return Estimate(found.value - 1.0, found.low - 1.0, found.high - 1.0)


def ratio(treated: ArrayLike, base: ArrayLike, *, trials: int | None = None, paired: bool = False) -> Estimate:
    """Ratio of the means of two sets of runs, with Fieller's 95 % interval (1954).

    Its ends are NaN where the mean of ``base`` is not clear of zero, so that the ratio has no upper end; its value,
    where that mean is zero. ``paired`` says that values at the same index are of the same run.
    """
    a = _runs(treated)
    b = _runs(base)
    mean_a = float(a.mean())
    mean_b = float(b.mean())
    if mean_b == 0.0:
        return Estimate(math.nan, math.nan, math.nan)
    value = mean_a / mean_b
    if min(len(a), len(b)) < 2:
        return Estimate(value, math.nan, math.nan)
    over = _location(a, trials, 0.0)
    under = _location(b, trials, 0.0)
    shared = float(np.cov(a, b)[0, 1]) / len(a) if paired else 0.0
    freedom = len(a) - 1 if paired else _welch(over, under)
    t = float(scipy.stats.t.ppf(0.5 + LEVEL / 2.0, freedom))
    g = (t * under.error / mean_b) ** 2
    if g >= 1.0:
        return Estimate(value, math.nan, math.nan)
    inner = over.error**2 - 2.0 * value * shared + (value * under.error) ** 2
    inner -= g * (over.error**2 - (shared / under.error) ** 2 if under.error > 0.0 else 0.0)
    middle = value - (g * shared / under.error**2 if under.error > 0.0 else 0.0)
    half = t / abs(mean_b) * math.sqrt(max(inner, 0.0))
    return Estimate(value, (middle - half) / (1.0 - g), (middle + half) / (1.0 - g))


def _location(values: Floats, trials: int | None, trim: float) -> _Location:
    """A trimmed mean with the standard error that the winsorised spread gives it, at least that of the tests."""
    count = len(values)
    cut = int(trim * count)
    ordered = np.sort(values)
    kept = ordered[cut : count - cut]
    winsorised = np.clip(ordered, kept[0], kept[-1])
    error = float(winsorised.std(ddof=1)) * math.sqrt((count - 1) / (len(kept) * (len(kept) - 1)))
    if trials is not None:
        tests = count * trials
        share = (float(values.sum()) * trials + 2.0) / (tests + 4.0)  # Agresti and Coull (1998): never 0 or 1
        error = max(error, math.sqrt(share * (1.0 - share) / tests))
    return _Location(float(kept.mean()), error, len(kept) - 1)


def _contrast(a: Floats, b: Floats, trials: int | None, trim: float) -> tuple[float, float, float]:
    """Difference of two trimmed means, its standard error and degrees of freedom (Welch 1947)."""
    first = _location(a, trials, trim)
    second = _location(b, trials, trim)
    return round(first.value - second.value, _DIGITS), math.hypot(first.error, second.error), _welch(first, second)


def _welch(first: _Location, second: _Location) -> float:
    parts = first.error**4 / first.freedom + second.error**4 / second.freedom
    return (first.error**2 + second.error**2) ** 2 / parts if parts > 0.0 else 1.0  # of no error, any number


def _finite(scores: ArrayLike) -> Floats:
    array = np.asarray(scores, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all():
        raise InvalidValueError(f"scores must hold at least one number and only finite ones, not {array.tolist()}.")
    return array


def _runs(scores: ArrayLike) -> Floats:
    array = _finite(scores)
    if array.ndim != 1:
        raise InvalidValueError(f"scores must have shape (runs,), not {array.shape}.")
    return array


def auroc(scores: NDArray[np.floating], wrong: NDArray[np.bool_]) -> float:
    """Probability, 0.5 by chance, that a wrong prediction has a higher score than a right one, ties counting half.

    Area under the receiver operating characteristic (Hanley & McNeil 1982). Both of shape (N,); NaN where all
    predictions are right, or all wrong.

    Raises:
        InvalidValueError: Shapes differ, or a score is NaN.
    """
    if scores.shape != wrong.shape or np.isnan(scores).any():
        raise InvalidValueError(f"AUROC needs one number a prediction, not {scores.shape} for {wrong.shape}, or NaN.")
    return math.nan if wrong.all() or not wrong.any() else _chance_of_more(scores[wrong], scores[~wrong])


def _chance_of_more(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Share of all pairs in which one of (n,) is larger than one of (m,), ties for half (Mann and Whitney 1947)."""
    found = scipy.stats.mannwhitneyu(a.astype(np.float64), b.astype(np.float64), method="asymptotic")
    return float(found.statistic / (len(a) * len(b)))
