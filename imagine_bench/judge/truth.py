"""The exact answers, by enumeration: nothing on the truth's side is sampled.

The scene obeys its dynamics also after an episode has ended, and images are judged by them to any depth; rewards stop
at the end. Mistakes are charged by values: plans that are optimal in a model are followed by the exact rules.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping
from typing import TypeVar

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.arrays import State
from imagine_bench.rules import Outcomes

MODE = 0.05  # least probability of an outcome that counts as a mode
MISSED = 0.2  # a mode is missed if it is imagined less than this times as often as it happens
Value = TypeVar("Value", bound=Hashable)
Distribution = dict[State, float]
"""Probability of each macrostate; of an image that shows nothing of this world, all coordinates are -1."""


def added_up(pairs: Iterable[tuple[Value, float]]) -> dict[Value, float]:
    """The probability of each value, of pairs in which a value may come more than once."""
    found: dict[Value, float] = {}
    for value, share in pairs:
        found[value] = found.get(value, 0.0) + share
    return found


def shares(outcomes: Outcomes) -> Distribution:
    """Probability of each macrostate, whether or not the episode is over."""
    return added_up((state, share) for (state, _), (share, _) in outcomes.items())


def p_ended(outcomes: Outcomes) -> float:
    """Probability that the episode is over."""
    return sum(share for (_, over), (share, _) in outcomes.items() if over)


def expected_reward(outcomes: Outcomes) -> float:
    """Expected reward of the latest action."""
    return sum(share * reward for share, reward in outcomes.values())


def total_variation(exact: Mapping[State, float], imagined: Mapping[State, float]) -> float:
    """Half the sum of absolute differences of two distributions: 0 for equal ones, 1 for those that share nothing."""
    return 0.5 * sum(abs(exact.get(key, 0.0) - imagined.get(key, 0.0)) for key in {*exact, *imagined})


def squared_distance(exact: Mapping[State, float], imagined: Mapping[State, float], drawn: int = 0) -> float:
    """Sum over macrostates of the squared difference of two probabilities, without bias; 0 for equal ones, at most 2.

    It is how much larger the expected Brier score of the model's probabilities q is than that of the exact ones p:
    E |q - 1_X|^2 - E |p - 1_X|^2 = sum_x (q_x - p_x)^2, where X is drawn from p and 1_X is 1 at X and 0 elsewhere.

    A model that gives q is charged just that. Of one that draws S independent futures only their shares f are known.
    f_x has mean q_x and variance q_x (1 - q_x) / S, so E sum_x (f_x - p_x)^2 exceeds the sum above by
    sum_x q_x (1 - q_x) / S; and E f_x (1 - f_x) = q_x (1 - q_x) (S - 1) / S. Hence

        sum_x (f_x - p_x)^2 - sum_x f_x (1 - f_x) / (S - 1)

    has the expected value sum_x (q_x - p_x)^2: 0 for a perfect sampler, whatever S. It is the U-statistic over pairs of
    futures i and j, the mean of sum_x (1[x_i = x] - p_x) (1[x_j = x] - p_x) over all i != j. A single one may be less
    than 0, and its mean is where futures are spread more evenly than independent ones. Of futures that share a draw of
    the model's weights q are the probabilities under those weights.

    Args:
        exact: Probabilities p.
        imagined: Probabilities q, or shares f of the futures.
        drawn: S; 0 if the model gives probabilities. Of one future nothing is known: NaN.
    """
    if drawn == 1:
        return math.nan
    away = sum((exact.get(key, 0.0) - imagined.get(key, 0.0)) ** 2 for key in {*exact, *imagined})
    if not drawn:
        return away
    return away - sum(share * (1.0 - share) for share in imagined.values()) / (drawn - 1)


def sampling_noise_floor(exact: Mapping[State, float], count: int) -> float:
    """Expected total variation between ``exact`` and ``count`` samples of itself: that of a perfect sampler.

    It is 0 for a ``count`` of 0, which stands for a model that gives probabilities.

    Half the sum of the mean absolute deviations of binomial counts, by De Moivre's formula (Diaconis & Zabell 1991).
    """
    if not count:
        return 0.0
    p = np.minimum(np.array(list(exact.values())), 1.0)
    m = np.floor(count * p)
    deviation = 2.0 * (m + 1.0) * (1.0 - p) * scipy.stats.binom.pmf(m + 1.0, count, p)  # E |X - count p|
    return float(0.5 * deviation.sum() / count)


def missed_modes(exact: Mapping[State, float], imagined: Mapping[State, float]) -> int:
    """Outcomes of at least :data:`MODE` that are imagined less than :data:`MISSED` times as often as they happen."""
    return sum(share >= MODE and imagined.get(key, 0.0) < MISSED * share for key, share in exact.items())


def hallucinated_modes(exact: Mapping[State, float], imagined: Mapping[State, float]) -> int:
    """Macrostates imagined at least :data:`MODE` of the time that the rules make impossible."""
    return sum(share >= MODE and key[0] >= 0 and not exact.get(key) for key, share in imagined.items())
