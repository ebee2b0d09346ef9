"""Conclusions from a handful of seeds: pure functions on one score a run, shape (runs,); no random draws.

The score of an agent is the interquartile mean over seeds (Agarwal et al., "Deep RL at the edge of the statistical
precipice", 2021): the middle half, so that one seed that is stuck does not decide. Of three seeds that is their mean.
Seeds often fall into two groups, those that learn and those that are stuck. A trimmed mean then hides a group, and its
spread with it. So whatever is said holds of the trimmed mean (Tukey and McLaughlin 1963; Yuen 1974) and of the mean of
all (Student; Welch 1947) alike, and of too few seeds nothing is said. ``tests/measure/interval_coverage.py`` measures
on kept scores and on eight laws how often that is right.
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
FEWEST = 7  #: runs of an interval: of six, a third of them stuck, 9 % of samples show none that is
FEWEST_TESTED = 5  #: runs of each of two agents whose difference is tested
_MOST_RUNS = 100  # nobody trains more of one agent
_TRIM = 0.25  # of the scores, at each end
_DIGITS = 12
"""Decimals of differences: success rates lie on a lattice, and two equal sums in another order must not differ."""


class Estimate(NamedTuple):
    """A point estimate, its interval, and for differences the two-sided p-value; NaN where too few runs allow none."""

    value: float
    low: float = math.nan
    high: float = math.nan
    p: float = math.nan


class _Location(NamedTuple):
    """Trimmed means (...) of runs (..., runs), their standard errors and degrees of freedom."""

    value: Floats
    error: Floats
    freedom: int


def iqm(scores: ArrayLike) -> float:
    """Interquartile mean: the mean of the middle half of all scores (of fewer than four: the plain mean)."""
    return float(scipy.stats.trim_mean(_finite(scores).ravel(), _TRIM))


def left_out(runs: int) -> int:
    """How many of so many scores :func:`iqm` leaves out."""
    return 2 * int(_TRIM * runs)


def interval(
    scores: ArrayLike, *, trials: int | None = None, trim: float = _TRIM, share: bool = True
) -> tuple[float, float]:
    """95 % interval of the interquartile mean over the population of runs, from ``scores`` (runs,): see :func:`bounds`.

    Raises:
        InvalidValueError: Scores that are empty, not finite, of another shape, or no shares though ``share`` says so.
    """
    low, high = bounds(_runs(scores), trials=trials, trim=trim, share=share).tolist()
    return low, high


def bounds(scores: ArrayLike, *, trials: int | None = None, trim: float = _TRIM, share: bool = True) -> Floats:
    """Both ends (2, ...) of the 95 % intervals of interquartile means, from ``scores`` (..., runs).

    The least interval that holds Student's, of the trimmed and of the plain mean, and the median's exact one. Both ends
    are NaN with fewer than :data:`FEWEST` runs.

    Args:
        scores: One score a run.
        trials: Tests behind each score, which is a share of them. All runs are tested from the same starts, so that no
            spread between runs shows the chance of these: Wilson's interval of so many tests is added, in squares.
        trim: Share of the scores that is left out at each end; 0 for an interval of the plain mean.
        share: Whether scores are shares, so that no interval leaves [0, 1].

    Raises:
        InvalidValueError: Scores that are empty, not finite, or no shares though ``share`` says so.
    """
    values = np.sort(_finite(scores))
    if share and (values.min() < 0.0 or values.max() > 1.0 + 10.0**-_DIGITS):
        raise InvalidValueError(
            f"scores from {values.min():g} to {values.max():g} are no shares in [0, 1]; pass share=False for others."
        )
    count = values.shape[-1]
    if count < FEWEST:
        return np.full((2, *values.shape[:-1]), math.nan)
    place = int(scipy.stats.binom.ppf((1.0 - LEVEL) / 2.0, count, 0.5))  # of the median's interval, from each end
    low = values[..., place - 1]
    high = values[..., count - place]
    for cut in (0.0, trim):
        found = _location(values, None, cut)
        half = scipy.stats.t.ppf(0.5 + LEVEL / 2.0, found.freedom) * found.error
        low = np.minimum(low, found.value - half)
        high = np.maximum(high, found.value + half)
    if trials is not None:
        least, most = _wilson(found.value, trials)
        low = found.value - np.hypot(found.value - low, found.value - least)
        high = found.value + np.hypot(high - found.value, most - found.value)
    ends = np.stack([low, high])
    return ends.clip(0.0, 1.0) if share else ends


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success probability after ``trials`` independent trials (Wilson, 1927).

    Raises:
        InvalidValueError: Not 0 <= successes <= trials, or no trial.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidValueError(
            f"{successes} successes in {trials} trials is impossible; give 0 <= successes <= trials."
        )
    low, high = _wilson(np.array(successes / trials), trials).tolist()
    return low, high


def _wilson(shares: Floats, trials: int) -> Floats:
    """Both ends (2, ...) of Wilson's intervals of shares (...) of so many trials."""
    within = shares.clip(0.0, 1.0)
    z = scipy.special.ndtri(0.5 + 0.5 * LEVEL)
    twice = 2.0 * (trials + z**2)
    middle = (2.0 * trials * within + z**2) / twice
    half = z / twice * np.sqrt(4.0 * trials * within * (1.0 - within) + z**2)
    return np.stack([np.where(within > 0.0, middle - half, 0.0), np.where(within < 1.0, middle + half, 1.0)])


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
    """Tests of two trained agents from the same starts, by those that one alone solved."""

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
    """Difference of the interquartile means of two agents' runs, (n,) and (m,): see :func:`differences`."""
    a = _runs(treated)
    b = _runs(base)
    return Estimate(*differences(a, b, trials=trials, trim=trim).tolist())


def differences(treated: ArrayLike, base: ArrayLike, *, trials: int | None = None, trim: float = _TRIM) -> Floats:
    """Differences of interquartile means, both ends of their 95 % intervals, and p-values: (4, ...).

    From the runs of two agents, (..., n) and (..., m). Two tests for unequal variances must agree, Welch's (1947) of
    the means and Yuen's (1974) of the trimmed means: the larger p-value counts, and the interval holds both. Where all
    runs of either agent are alike, no test sees that they might have fallen into another group; so no p-value is below
    the chance of that, 2 / 4^n of n runs each. All but the differences is NaN with fewer than :data:`FEWEST_TESTED`
    runs of either.

    Runs of one seed share starts and first weights, but the trained results do not agree: of the kept benches
    the correlation over seeds is about 0.1, so they are not paired. ``trials`` are tests behind each score: the error
    of a mean is at least theirs. Starts that are equally hard for both agents cancel.
    """
    a = _finite(treated)
    b = _finite(base)
    means = (scipy.stats.trim_mean(each, trim, axis=-1) for each in (a, b))
    value = np.asarray(np.round(np.subtract(*means), _DIGITS))
    runs = a.shape[-1], b.shape[-1]
    if min(runs) < FEWEST_TESTED:
        return np.stack([value, *[np.full(value.shape, math.nan)] * 3])
    low = high = value
    p = np.full(value.shape, _least_p(*runs))
    for cut in (0.0, trim):
        moved, error, freedom = _contrast(a, b, trials, cut)
        half = scipy.stats.t.ppf(0.5 + LEVEL / 2.0, freedom) * error
        low = np.minimum(low, moved - half)
        high = np.maximum(high, moved + half)
        sizes = np.divide(abs(moved), error, out=np.where(moved == 0.0, 0.0, np.inf), where=error > 0.0)
        p = np.maximum(p, 2.0 * scipy.stats.t.sf(sizes, freedom))
    return np.stack([value, low, high, p])


def can_show(runs: tuple[int, int], cells: int) -> bool:
    """Whether a table of so many ``cells`` can show any difference of two agents with so many runs each."""
    return min(runs) >= FEWEST_TESTED and cells * _least_p(*runs) < 1.0 - LEVEL


def _least_p(first: int, second: int) -> float:
    """How likely two groups, into which all runs fall by chance, are at most the runs of the one and of the other."""
    runs = first + second
    return 2.0 * (first / runs) ** first * (second / runs) ** second


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

    From the spread of their runs, at the strictest level of :func:`holm`; NaN where so few runs can show none.
    """
    a = _runs(treated)
    b = _runs(base)
    if not can_show((len(a), len(b)), cells):
        return math.nan
    level = (1.0 - LEVEL) / max(cells, 1)
    sizes = []
    for cut in (0.0, _TRIM):
        _, error, freedom = _contrast(a, b, trials, cut)
        quantiles = scipy.stats.t.isf(level / 2.0, freedom) + scipy.stats.t.ppf(POWER, freedom)
        sizes.append(float(error * quantiles))
    return max(sizes)


def more_seeds(treated: ArrayLike, base: ArrayLike, *, cells: int, trials: int | None = None) -> int:
    """How many more runs of each of two agents would show their present difference with probability 80 %, at least 1.

    Were the spread of their runs to stay as it is; in a table of so many ``cells``, at the strictest level of
    :func:`holm`. 0 where nobody can say: a single run has no spread, and a difference of 0 needs runs without end.
    """
    a = _runs(treated)
    b = _runs(base)
    now = min(len(a), len(b))
    if now < 2:
        return 0
    level = (1.0 - LEVEL) / max(cells, 1)
    size = abs(float(differences(a, b, trials=trials)[0]))
    errors = [float(_contrast(a, b, trials, cut)[1]) * math.sqrt(now) for cut in (0.0, _TRIM)]
    for count in range(now + 1, _MOST_RUNS):
        quantiles = scipy.stats.t.isf(level / 2.0, count - 1) + scipy.stats.t.ppf(POWER, count - 1)
        if can_show((count, count), cells) and max(errors) * float(quantiles) / math.sqrt(count) <= size:
            return count - now
    return 0


def gain(treated: ArrayLike, base: ArrayLike, *, trials: int | None = None) -> Estimate:
    """Relative gain (P_aug - P_base) / P_base of mean success rates (thesis tables 5.2 and 5.4).

    A gain of 0.5 is half as much again; NaN where the base never succeeds. See :func:`ratio` for the interval, which
    fewer than :data:`FEWEST_TESTED` runs do not have.
    """
    found = ratio(treated, base, trials=trials)
    if min(len(_runs(treated)), len(_runs(base))) < FEWEST_TESTED:
        return Estimate(found.value - 1.0)
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
        return Estimate(math.nan)
    value = mean_a / mean_b
    if min(len(a), len(b)) < 2:
        return Estimate(value)
    over = _location(a, trials, 0.0)
    under = _location(b, trials, 0.0)
    error_a = float(over.error)
    error_b = float(under.error)
    shared = float(np.cov(a, b)[0, 1]) / len(a) if paired else 0.0
    freedom = len(a) - 1 if paired else float(_welch(over, under))
    t = float(scipy.stats.t.ppf(0.5 + LEVEL / 2.0, freedom))
    g = (t * error_b / mean_b) ** 2
    if g >= 1.0:
        return Estimate(value)
    inner = error_a**2 - 2.0 * value * shared + (value * error_b) ** 2
    inner -= g * (error_a**2 - (shared / error_b) ** 2 if error_b > 0.0 else 0.0)
    middle = value - (g * shared / error_b**2 if error_b > 0.0 else 0.0)
    half = t / abs(mean_b) * math.sqrt(max(inner, 0.0))
    return Estimate(value, (middle - half) / (1.0 - g), (middle + half) / (1.0 - g))


def _location(values: Floats, trials: int | None, trim: float) -> _Location:
    """Trimmed means with the standard errors that the winsorised spread gives them, at least those of the tests."""
    count = values.shape[-1]
    cut = int(trim * count)
    ordered = np.sort(values)
    kept = ordered[..., cut : count - cut]
    winsorised = ordered.clip(kept[..., :1], kept[..., -1:])
    width = kept.shape[-1]
    error = winsorised.std(axis=-1, ddof=1) * math.sqrt((count - 1) / (width * (width - 1)))
    if trials is not None:
        tests = count * trials
        share = (values.sum(axis=-1) * trials + 2.0) / (tests + 4.0)  # Agresti and Coull (1998): never 0 or 1
        error = np.maximum(error, np.sqrt(share * (1.0 - share) / tests))
    return _Location(kept.mean(axis=-1), error, count - 1)


def _contrast(a: Floats, b: Floats, trials: int | None, trim: float) -> tuple[Floats, Floats, Floats]:
    """Differences of two trimmed means, their standard errors and degrees of freedom.

    These are half way from Welch's (1947) to the least that they can be (Hsu 1938): with Welch's, runs in two groups
    make false claims in up to 5 of 100 tables of six and 6 of 100 of 21, with the least few true ones are seen.
    """
    first = _location(a, trials, trim)
    second = _location(b, trials, trim)
    error = np.hypot(first.error, second.error)
    freedom = (_welch(first, second) + min(first.freedom, second.freedom)) / 2.0
    return np.round(first.value - second.value, _DIGITS), error, freedom


def _welch(first: _Location, second: _Location) -> Floats:
    parts = first.error**4 / first.freedom + second.error**4 / second.freedom
    squared = (first.error**2 + second.error**2) ** 2
    return np.divide(squared, parts, out=np.ones_like(parts), where=parts > 0.0)  # of no error, any number


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
