"""What is asked of every model, and the exact answers, by enumeration: nothing on the truth's side is sampled.

The scene obeys its dynamics also after an episode has ended, and pictures are judged by them to any depth; rewards stop
at the end. Shapes: ``N`` questions, ``K`` frames of history, ``D`` macro-actions asked about.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, Rules, State
from imagine_bench.rules import states_of

Outcomes = dict[tuple[State, bool], tuple[float, float]]
"""By macrostate and whether the episode is over: probability, and the reward expected of the action that led there."""


@dataclass(frozen=True, kw_only=True)
class Questions:
    """Real histories and macro-actions, with the exact truth of each."""

    states: tuple[State, ...]  #: What the last frame shows. Length N.
    frames: Frame  #: Shape (N, K, 64, 64, 3).
    actions: NDArray[np.int64]  #: Those between the frames, then those asked about. Shape (N, K - 1 + D).
    truth: tuple[tuple[Outcomes, ...], ...]  #: By question and depth. N of length D.

    @property
    def depth(self) -> int:
        """Macro-actions asked about, D."""
        return self.actions.shape[1] - self.frames.shape[1] + 1

    @property
    def asked(self) -> NDArray[np.int64]:
        """The macro-actions asked about. Shape (N, D)."""
        return self.actions[:, self.frames.shape[1] - 1 :]


def outcomes_by_depth(rules: Rules, state: State, actions: Sequence[int]) -> tuple[Outcomes, ...]:
    """What may come of macro-actions from a macrostate, after each of them."""
    reached = itertools.accumulate(actions, functools.partial(advance, rules), initial=certainly(state))
    return tuple(reached)[1:]


def certainly(state: State) -> Outcomes:
    """A macrostate in which nothing was done yet."""
    return {(state, False): (1.0, 0.0)}


def advance(rules: Rules, outcomes: Outcomes, action: int) -> Outcomes:
    """What may come of one more macro-action, the same whatever has come before."""
    after: dict[tuple[State, bool], list[float]] = {}
    for (before, over), (weight, _) in outcomes.items():
        for outcome in rules.outcomes(before, int(action)):
            sums = after.setdefault((outcome.macrostate, over or outcome.terminated), [0.0, 0.0])
            sums[0] += weight * outcome.probability
            sums[1] += weight * outcome.probability * (0.0 if over else outcome.reward)
    return {key: (share, earned / share if share else 0.0) for key, (share, earned) in after.items()}


def shares(outcomes: Outcomes) -> dict[State, float]:
    """Probability of each macrostate, whether or not the episode is over."""
    found: dict[State, float] = {}
    for (state, _), (share, _) in outcomes.items():
        found[state] = found.get(state, 0.0) + share
    return found


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
    outcomes = certainly(state)
    for _ in range(depth):
        risks = []
        for action in range(rules.n_actions):
            after = [o for (before, over) in outcomes if not over for o in rules.outcomes(before, action)]
            dead_end = sum(not _goes_on(rules, outcome.macrostate) for outcome in after if not outcome.terminated)
            risks.append((sum(outcome.probability for outcome in after if outcome.terminated), dead_end))
        best = [action for action, risk in enumerate(risks) if risk == min(risks)]
        chosen.append(int(rng.choice(best)))
        outcomes = advance(rules, outcomes, chosen[-1])
    return chosen


def _goes_on(rules: Rules, state: State) -> bool:
    """Whether some macro-action surely does not end the episode there."""
    return any(not any(o.terminated for o in rules.outcomes(state, action)) for action in range(rules.n_actions))
