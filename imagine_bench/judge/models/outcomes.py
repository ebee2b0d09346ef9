"""Distances of an imagined distribution of outcomes from the exact one.

A model that keeps one of several possible outcomes, or blurs them into one that cannot happen, may look right on each
single prediction; here it does not.
"""

from __future__ import annotations

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.interfaces import State

MODE = 0.05  # least probability of an outcome that counts as a mode
MISSED = 0.2  # a mode is missed if it is imagined less than this times as often as it happens


def total_variation(exact: dict[State, float], imagined: dict[State, float]) -> float:
    """Half the sum of absolute differences of two distributions: 0 for equal ones, 1 for those that share nothing."""
    return 0.5 * sum(abs(exact.get(key, 0.0) - imagined.get(key, 0.0)) for key in {*exact, *imagined})


def sampling_noise_floor(exact: dict[State, float], count: int) -> float:
    """Expected total variation between ``exact`` and ``count`` samples of itself: what a perfect model would show.

    Half the sum of the mean absolute deviations of binomial counts, by De Moivre's formula (Diaconis & Zabell 1991).
    """
    p = np.minimum(np.array(list(exact.values())), 1.0)
    m = np.floor(count * p)
    deviation = 2.0 * (m + 1.0) * (1.0 - p) * scipy.stats.binom.pmf(m + 1.0, count, p)  # E |X - count p|
    return float(0.5 * deviation.sum() / count)


def missed_modes(exact: dict[State, float], imagined: dict[State, float]) -> int:
    """Outcomes of at least :data:`MODE` that are imagined less than :data:`MISSED` times as often as they happen."""
    return sum(share >= MODE and imagined.get(key, 0.0) < MISSED * share for key, share in exact.items())


def hallucinated_modes(exact: dict[State, float], imagined: dict[State, float]) -> int:
    """Outcomes imagined at least :data:`MODE` of the time that the rules make impossible."""
    return sum(share >= MODE and exact.get(key, 0.0) == 0.0 for key, share in imagined.items())
