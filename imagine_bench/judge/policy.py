"""Where a policy leads by the rules, from every start: no episode is sampled.

A test says how often an agent succeeds. This says from which starts it does not, and how: a termination that is no
success, or out of time, and then whether it would have come to a success, to another termination, or to none at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imagine_bench.interfaces import Floats, TaskSpec
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


def optimal_length(spec: TaskSpec) -> Floats:
    """Expected macro-actions of an optimal agent within the horizon, from each start. Shape (S,)."""
    tables = tabulate(spec.rules)
    best = greedy(optimal_policy(tables), spec.n_actions)
    return evaluate(tables, best, spec.horizon).length[tables.starts]


def terminations(spec: TaskSpec, policy: Floats) -> Terminations:
    """Follow a policy from every start, by the rules: probabilities (A, S), macrostates as :func:`.rules.states_of`."""
    tables = tabulate(spec.rules)
    within = evaluate(tables, policy, spec.horizon)
    patient = evaluate(tables, policy, max(spec.horizon, _PATIENCE))
    return Terminations(
        success=within.success[tables.starts],
        failure=within.failure[tables.starts],
        late_success=(patient.success - within.success)[tables.starts],
        late_failure=(patient.failure - within.failure)[tables.starts],
        length=within.length[tables.starts],
    )
