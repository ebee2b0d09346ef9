"""Where a policy leads by the rules, from every start: no episode is sampled.

A test says how often an agent succeeds. This says from which starts it does not, and how: a termination that is no
success, or out of time, and then whether it would have come to a success, to another termination, or to none at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imagine_bench.interfaces import Floats, State, TaskSpec
from imagine_bench.rules import evaluate, greedy, optimal_policy, tabulate

_PATIENCE = 1_000  # macro-actions after which a termination is taken for one that never comes


@dataclass(frozen=True, kw_only=True)
class Terminations:
    """How episodes of one agent terminate by the rules, from each of the S start macrostates. Each of shape (S,)."""

    success: Floats  # probability of a success within the horizon
    failure: Floats  # probability of another termination within the horizon
    late_success: Floats  # probability of a success after the horizon, if episodes went on there
    late_failure: Floats  # probability of another termination after it
    length: Floats  # expected macro-actions within the horizon

    @property
    def endless(self) -> Floats:
        """Probability of what remains: no termination at all."""
        ended = self.success + self.failure + self.late_success + self.late_failure
        return np.maximum(0.0, 1.0 - ended)  # but for rounding


def optimal_length(spec: TaskSpec, starts: Sequence[State]) -> Floats:
    """Expected macro-actions of an optimal agent within the horizon, from each start. Shape (S,)."""
    tables = tabulate(spec.rules)
    best = greedy(optimal_policy(tables), spec.n_actions)
    return evaluate(tables, best, spec.horizon).length[[tables.index[start] for start in starts]]


def terminations(spec: TaskSpec, policy: Floats, starts: Sequence[State]) -> Terminations:
    """Follow a policy from S starts by the rules; its probabilities are (A, X), of the X macrostates of the rules."""
    tables = tabulate(spec.rules)
    within, patient = (evaluate(tables, policy, most) for most in (spec.horizon, max(spec.horizon, _PATIENCE)))
    rows = [tables.index[start] for start in starts]
    return Terminations(
        success=within.success[rows],
        failure=within.failure[rows],
        late_success=(patient.success - within.success)[rows],
        late_failure=(patient.failure - within.failure)[rows],
        length=within.length[rows],
    )
