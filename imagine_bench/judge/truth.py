"""The exact answers, by enumeration: nothing on the truth's side is sampled.

The scene obeys its dynamics also after an episode has ended, and images are judged by them to any depth; rewards stop
at the end.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Iterable, Mapping
from typing import TypeVar

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.interfaces import Rules, State
from imagine_bench.rules import Outcomes, advance, states_of

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


def transitions(rules: Rules, rng: np.random.Generator, most: int) -> list[tuple[State, int]]:
    """Every macro-action in every macrostate that an episode can be in; where there are too many, in ``most`` drawn."""
    alive = [state for state in states_of(rules) if not rules.is_terminal(state)]
    if len(alive) > most:
        alive = [alive[index] for index in np.sort(rng.choice(len(alive), most, replace=False))]
    return list(itertools.product(alive, range(rules.n_actions)))


def lasting_actions(rules: Rules, state: State, depth: int, rng: np.random.Generator) -> list[int]:
    """Random macro-actions after which the episode is least likely to be over, one after another."""
    chosen: list[int] = []
    outcomes: Outcomes = {(state, False): (1.0, 0.0)}
    for _ in range(depth):
        risks = [_risk(rules, outcomes, action) for action in range(rules.n_actions)]
        best = [action for action, risk in enumerate(risks) if risk == min(risks)]
        chosen.append(int(rng.choice(best)))
        outcomes = advance(rules, outcomes, chosen[-1])
    return chosen


def _risk(rules: Rules, outcomes: Outcomes, action: int) -> tuple[float, int]:
    """How likely an action ends an episode, and in how many macrostates every action would, right after it."""
    after = [outcome for (before, over) in outcomes if not over for outcome in rules.outcomes(before, action)]
    ended = sum(outcome.probability for outcome in after if outcome.terminated)
    dead_ends = sum(not _can_last(rules, outcome.macrostate) for outcome in after if not outcome.terminated)
    return ended, dead_ends


def _can_last(rules: Rules, state: State) -> bool:
    """Whether some macro-action surely does not end the episode there."""
    return any(not any(o.terminated for o in rules.outcomes(state, action)) for action in range(rules.n_actions))


def total_variation(exact: Mapping[State, float], imagined: Mapping[State, float]) -> float:
    """Half the sum of absolute differences of two distributions: 0 for equal ones, 1 for those that share nothing."""
    return 0.5 * sum(abs(exact.get(key, 0.0) - imagined.get(key, 0.0)) for key in {*exact, *imagined})


def sampling_noise_floor(exact: Mapping[State, float], count: int) -> float:
    """Expected total variation between ``exact`` and ``count`` samples of itself: what a perfect model would show.

    Half the sum of the mean absolute deviations of binomial counts, by De Moivre's formula (Diaconis & Zabell 1991).
    """
    p = np.minimum(np.array(list(exact.values())), 1.0)
    m = np.floor(count * p)
    deviation = 2.0 * (m + 1.0) * (1.0 - p) * scipy.stats.binom.pmf(m + 1.0, count, p)  # E |X - count p|
    return float(0.5 * deviation.sum() / count)


def missed_modes(exact: Mapping[State, float], imagined: Mapping[State, float]) -> int:
    """Outcomes of at least :data:`MODE` that are imagined less than :data:`MISSED` times as often as they happen."""
    return sum(share >= MODE and imagined.get(key, 0.0) < MISSED * share for key, share in exact.items())


def hallucinated_modes(exact: Mapping[State, float], imagined: Mapping[State, float]) -> int:
    """Outcomes imagined at least :data:`MODE` of the time that the rules make impossible."""
    return sum(share >= MODE and exact.get(key, 0.0) == 0.0 for key, share in imagined.items())
