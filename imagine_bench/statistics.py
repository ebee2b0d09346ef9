"""What a handful of seeds allows one to say: pure functions on one score a run, shape (runs,).

Every random draw is from a passed generator. Intervals cover 95 % and are percentile bootstraps over runs (Agarwal et
al., "Deep RL at the edge of the statistical precipice", 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy  # its parts load, slowly, when they are first used
from numpy.typing import ArrayLike

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats

RESAMPLES = 4000
_LEVEL = 0.95  #: coverage of every interval
_DIGITS = 12
"""Decimals of differences: success rates lie on a lattice, and two equal sums in another order must not differ."""

Statistic = Literal["iqm", "mean"]


class Estimate(NamedTuple):
    """A point estimate and its interval; the ends are NaN where the data allow none (fewer than two runs)."""

    value: float
    low: float
    high: float


def iqm(scores: ArrayLike) -> float:
    """Interquartile mean: the mean of the middle half of all scores (of fewer than four: the plain mean)."""
    return float(_summary(_finite(scores).ravel(), "iqm"))


def bootstrap_interval(
    scores: ArrayLike, rng: np.random.Generator, *, statistic: Statistic = "iqm"
) -> tuple[float, float]:
    """95 % percentile interval of ``statistic`` by the bootstrap over runs, from ``scores`` (runs,).

    Both ends are NaN with fewer than two runs, which say nothing of their spread.

    Raises:
        InvalidValueError: Scores that are empty, not finite, or of another shape.
    """
    values = _runs(scores)
    return _percentiles(_summary(_resample(values, rng), statistic)) if len(values) > 1 else (np.nan, np.nan)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success probability after ``trials`` independent trials (Wilson, 1927).

    Raises:
        InvalidValueError: Not 0 <= successes <= trials, or no trial.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidValueError(
            f"{successes} successes in {trials} trials is impossible; give 0 <= successes <= trials."
        )
    interval = scipy.stats.binomtest(successes, trials).proportion_ci(confidence_level=_LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def first_lasting(budgets: Sequence[int], scores: ArrayLike, threshold: float) -> int | None:
    """The first of ascending budgets from which on every score (B,) is at least ``threshold``; None where none is.

    Raises:
        InvalidValueError: Not one score a budget.
    """
    values = _finite(scores)
    if values.shape != (len(budgets),):
        raise InvalidValueError(f"{len(budgets)} budgets need as many scores, not an array of shape {values.shape}.")
    below = np.flatnonzero(values < threshold)
    first = 0 if not len(below) else int(below[-1]) + 1
    return budgets[first] if first < len(budgets) else None


def running_means(budgets: Sequence[int], scores: ArrayLike, at_zero: float) -> Floats:
    """Area under each curve up to each budget, divided by the budget: the mean score of all episodes until then.

    Curves are straight between tests at ascending budgets, and from ``at_zero`` at episode 0 to the first test.
    Scores and result have shape (runs, B).

    Raises:
        InvalidValueError: Not one score a budget.
    """
    table = _finite(scores)
    if table.ndim != 2 or table.shape[1] != len(budgets):
        count = len(budgets)
        raise InvalidValueError(f"{count} budgets need scores of shape (runs, {count}), not {table.shape}.")
    episodes = np.array([0, *budgets], dtype=np.float64)
    values = np.concatenate([np.full((len(table), 1), at_zero), table], axis=1)  # [runs, B + 1]
    pieces = np.diff(episodes) * (values[:, 1:] + values[:, :-1]) / 2.0
    return np.asarray(pieces.cumsum(axis=1) / episodes[1:])


def difference(treated: ArrayLike, base: ArrayLike, rng: np.random.Generator) -> Estimate:
    """Difference of the interquartile means of two agents, whose runs, (n,) and (m,), are resampled independently."""
    a, b = _runs(treated), _runs(base)
    value = round(iqm(a) - iqm(b), _DIGITS)
    if min(len(a), len(b)) < 2:
        return Estimate(value, np.nan, np.nan)
    first, second = (_summary(_resample(side, rng), "iqm") for side in (a, b))
    return Estimate(value, *_percentiles(np.round(first - second, _DIGITS)))


def gain(treated: ArrayLike, base: ArrayLike, rng: np.random.Generator) -> Estimate:
    """Relative gain (P_aug - P_base) / P_base of mean success rates (thesis tables 5.2 and 5.4).

    Both sides are resampled independently, as in :func:`difference`: runs of one seed share starts and first weights,
    but what training makes of them differs, so pairing them would promise more than a few seeds hold.
    A gain of 0.5 is half as much again; NaN where the base never succeeds. Its ends are NaN where too many resamples of
    the base never do, so that the interval has no upper end.
    """
    a, b = _runs(treated), _runs(base)
    value = float(_relative(a[None], b[None])[0])
    if min(len(a), len(b)) < 2 or np.isnan(value):
        return Estimate(value, np.nan, np.nan)
    draws = _relative(_resample(a, rng), _resample(b, rng))
    if np.isnan(draws).mean() >= (1.0 - _LEVEL) / 2.0 - 10**-_DIGITS:  # where the base is 0 the gain is boundless
        return Estimate(value, np.nan, np.nan)
    return Estimate(value, *_percentiles(np.where(np.isnan(draws), np.inf, draws)))


def _summary(scores: Floats, statistic: Statistic) -> Floats:
    """The statistic over the last axis."""
    return np.asarray(scores.mean(axis=-1) if statistic == "mean" else scipy.stats.trim_mean(scores, 0.25, axis=-1))


def _relative(a: Floats, b: Floats) -> Floats:
    """Relative gains of mean ``a`` over mean ``b``: (resamples, runs) and (resamples, other runs) to (resamples,)."""
    treated, base = a.mean(axis=1), b.mean(axis=1)
    return np.where(base > 0, (treated - base) / np.where(base > 0, base, 1.0), np.nan)


def _resample(values: Floats, rng: np.random.Generator) -> Floats:
    """Runs drawn with replacement. Shape (resamples, runs)."""
    return values[rng.integers(len(values), size=(RESAMPLES, len(values)))]


def _percentiles(draws: Floats) -> tuple[float, float]:
    low, high = np.percentile(draws, [50.0 * (1.0 - _LEVEL), 50.0 * (1.0 + _LEVEL)])
    return float(low), float(high)


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
