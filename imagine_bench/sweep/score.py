"""An agent's score in an experiment: where it stands between chance and optimum, mean over the levels.

Shapes: ``S`` seeds, ``L`` levels; NaN where a level has no value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench import statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats
from imagine_bench.store.results import OpenLoop


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The ends of a level's scale: the results of blind choice and of perfect play."""

    chance: float
    optimum: float

    def __post_init__(self) -> None:
        if not self.chance < self.optimum:
            raise InvalidValueError(
                f"Chance {self.chance} is not below the optimum {self.optimum}: nothing can be learned in this level."
            )


def score(values: Floats, scales: Sequence[Scale], *, trials: int | None = None) -> statistics.Estimate:
    """Mean over levels and seeds of ``values`` (S, L), each on its level's scale, with a 95 % interval.

    The interval is Student's over seeds, and at least as wide as the tests alone make it, where the values are shares
    of so many ``trials``; with one seed it is of the tests alone, and more that are too few have none. A level without
    values is left out; all is NaN where none has any.
    """
    there = ~np.isnan(values).all(axis=0)
    known = values[:, there]
    if np.isnan(known).all(axis=1).any():  # also where no level has values
        return statistics.Estimate(math.nan)
    chance, optimum = np.array([(scale.chance, scale.optimum) for scale in scales])[there].T
    span = optimum - chance
    seeds = np.nanmean((known - chance) / span, axis=1)
    value = float(seeds.mean())
    low, high = statistics.interval(seeds, trim=0.0, share=False)
    if trials is not None and (len(seeds) == 1 or not math.isnan(low)):
        half = scipy.stats.norm.isf(0.025) * _error_of_tests(known, span, trials)
        low, high = np.fmin(low, value - half), np.fmax(high, value + half)
    return statistics.Estimate(value, float(low), float(high))


def _error_of_tests(values: Floats, spans: Floats, trials: int) -> float:
    """Standard error that the tests' chance gives the mean of independent shares, as Agresti and Coull (1998)."""
    count = np.maximum((~np.isnan(values)).sum(axis=0), 1) * trials  # [L]
    share = (np.nanmean(values, axis=0) * count + 2.0) / (count + 4.0)
    return float(np.sqrt((share * (1.0 - share) / count / spans**2).sum())) / len(spans)


def auroc(found: OpenLoop | None) -> float:
    """How well epistemic uncertainty finds wrong transitions, over all depths, weighted by how many could be wrong.

    An agent that says nothing of its imagination has 0.5, as guessing; NaN where none, or all, were wrong.
    """
    if found is None:
        return 0.5
    known = np.isfinite(found.auroc_epistemic) & (found.judged > 0)
    if not known.any():
        return math.nan
    return float(np.average(found.auroc_epistemic[known], weights=found.judged[known]))
