"""What a handful of seeds allows one to say: pure functions on scores, every random draw from a passed generator.

Scores have shape (runs,) or (runs, strata), a stratum being a task; they are resampled within each stratum
(Agarwal et al., "Deep RL at the edge of the statistical precipice", 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from imagine_bench.errors import InvalidValueError

LEVEL = 0.95
RESAMPLES = 4000
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
    return float(_summary(_finite("scores", scores).ravel()[None], "iqm")[0])


def bootstrap_interval(
    scores: ArrayLike,
    rng: np.random.Generator,
    *,
    statistic: Statistic = "iqm",
    level: float = LEVEL,
    resamples: int = RESAMPLES,
) -> tuple[float, float]:
    """Percentile interval of ``statistic`` by the stratified bootstrap over runs.

    Args:
        scores: Shape (runs,) or (runs, strata).
        rng: Draws the resamples.
        statistic: ``"iqm"`` or ``"mean"``, of all scores of a resample.
        level: Coverage, in (0, 1).
        resamples: Bootstrap samples.

    Returns:
        The two ends; both NaN with fewer than two runs, which say nothing of their spread.

    Raises:
        InvalidValueError: Scores that are empty, not finite, or of another shape.
    """
    table = _table(scores)
    if len(table) < 2:
        return float("nan"), float("nan")
    draws = _resample(table, rng, resamples).reshape(resamples, -1)  # [resamples, runs * strata]
    return _percentiles(_summary(draws, statistic), level)


def wilson(successes: int, trials: int, *, level: float = LEVEL) -> tuple[float, float]:
    """Wilson's score interval of a success probability after ``trials`` independent trials (Wilson, 1927).

    Raises:
        InvalidValueError: Not 0 <= successes <= trials, or no trial.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidValueError(
            f"{successes} successes in {trials} trials is impossible; give 0 <= successes <= trials."
        )
    interval = stats.binomtest(successes, trials).proportion_ci(confidence_level=level, method="wilson")
    return float(interval.low), float(interval.high)


def first_lasting(budgets: Sequence[int], scores: ArrayLike, level: float) -> int | None:
    """The first budget from which on every score is at least ``level``; None where even the last one is not.

    Args:
        budgets: Ascending. Length B.
        scores: The score at each of them. Shape (B,).
        level: What counts as reached.

    Raises:
        InvalidValueError: Not one score a budget.
    """
    values = _finite("scores", scores)
    if values.shape != (len(budgets),):
        raise InvalidValueError(f"{len(budgets)} budgets need as many scores, not an array of shape {values.shape}.")
    below = np.flatnonzero(values < level)
    first = 0 if not len(below) else int(below[-1]) + 1
    return budgets[first] if first < len(budgets) else None


def running_means(budgets: Sequence[int], scores: ArrayLike, at_zero: float) -> NDArray[np.float64]:
    """Area under each curve up to each budget, divided by the budget: the mean score of all episodes until then.

    Curves are straight between tests, and from episode 0 to the first test.

    Args:
        budgets: Episodes at which there was a test, ascending. Length B.
        scores: Shape (runs, B).
        at_zero: Score before the first episode.

    Returns:
        Shape (runs, B).

    Raises:
        InvalidValueError: Not one score a budget.
    """
    table = _finite("scores", scores)
    if table.ndim != 2 or table.shape[1] != len(budgets):
        raise InvalidValueError(
            f"{len(budgets)} budgets need scores of shape (runs, {len(budgets)}), not {table.shape}."
        )
    episodes = np.array([0, *budgets], dtype=np.float64)
    values = np.concatenate([np.full((len(table), 1), at_zero), table], axis=1)  # [runs, B + 1]
    pieces = np.diff(episodes) * (values[:, 1:] + values[:, :-1]) / 2.0
    means: NDArray[np.float64] = pieces.cumsum(axis=1) / episodes[1:]
    return means


def difference(
    treated: ArrayLike, base: ArrayLike, rng: np.random.Generator, *, level: float = LEVEL, resamples: int = RESAMPLES
) -> Estimate:
    """Difference of the interquartile means of two agents, whose runs are resampled independently.

    Args:
        treated: Shape (runs,) or (runs, strata).
        base: Shape (other runs,) or (other runs, strata).
        rng: Draws the resamples.
        level: Coverage of the interval.
        resamples: Bootstrap samples.
    """
    a, b = _table(treated), _table(base)
    value = round(iqm(a) - iqm(b), _DIGITS)
    if min(len(a), len(b)) < 2:
        return Estimate(value, float("nan"), float("nan"))
    sides = [_summary(_resample(side, rng, resamples).reshape(resamples, -1), "iqm") for side in (a, b)]
    return Estimate(value, *_percentiles(np.round(sides[0] - sides[1], _DIGITS), level))


def gain(
    treated: ArrayLike, base: ArrayLike, rng: np.random.Generator, *, level: float = LEVEL, resamples: int = RESAMPLES
) -> Estimate:
    """Relative gain (P_aug - P_base) / P_base of mean success rates (thesis tables 5.2 and 5.4).

    Both sides are resampled independently, as in :func:`difference`: runs of one seed share starts and first weights,
    but what training makes of them differs, so pairing them would promise more than a few seeds hold.

    Args:
        treated: Success rates of the augmented agent. Shape (runs,) or (runs, strata).
        base: Success rates of the base agent. Shape (other runs,) or (other runs, strata).
        rng: Draws the resamples.
        level: Coverage of the interval.
        resamples: Bootstrap samples.

    Returns:
        The gain, 0.5 for half as much again; NaN where the base never succeeds. Its ends are NaN where too many
        resamples of the base never do, so that the interval has no upper end.
    """
    a, b = _table(treated), _table(base)
    value = float(_relative(a[None], b[None])[0])
    if min(len(a), len(b)) < 2 or np.isnan(value):
        return Estimate(value, float("nan"), float("nan"))
    draws = _relative(_resample(a, rng, resamples), _resample(b, rng, resamples))
    if np.isnan(draws).mean() >= (1.0 - level) / 2.0 - 10**-_DIGITS:  # where the base is 0 the gain is boundless
        return Estimate(value, float("nan"), float("nan"))
    return Estimate(value, *_percentiles(np.where(np.isnan(draws), np.inf, draws), level))


def _summary(draws: NDArray[np.float64], statistic: Statistic) -> NDArray[np.float64]:
    """The statistic of each row: (resamples, scores) to (resamples,)."""
    if statistic == "mean":
        return draws.mean(axis=1)
    trimmed: NDArray[np.float64] = stats.trim_mean(draws, 0.25, axis=1)
    return trimmed


def _relative(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Relative gains of mean ``a`` over mean ``b``: two tables with a leading resamples axis to (resamples,)."""
    treated, base = a.mean(axis=(1, 2)), b.mean(axis=(1, 2))
    return np.where(base > 0, (treated - base) / np.where(base > 0, base, 1.0), np.nan)


def _resample(table: NDArray[np.float64], rng: np.random.Generator, resamples: int) -> NDArray[np.float64]:
    """Runs drawn with replacement, for each stratum independently. Shape (resamples, runs, strata)."""
    picks = rng.integers(len(table), size=(resamples, *table.shape))
    return np.take_along_axis(table[None], picks, axis=1)


def _percentiles(draws: NDArray[np.float64], level: float) -> tuple[float, float]:
    tail = 50.0 * (1.0 - level)
    low, high = np.percentile(draws, [tail, 100.0 - tail])
    return float(low), float(high)


def _finite(name: str, values: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all():
        raise InvalidValueError(f"{name} must hold at least one number and only finite ones, not {array.tolist()}.")
    return array


def _table(values: ArrayLike) -> NDArray[np.float64]:
    array = _finite("scores", values)
    if array.ndim > 2:
        raise InvalidValueError(f"scores must have shape (runs,) or (runs, strata), not {array.shape}.")
    return array.reshape(len(array), -1)
