"""Worlds with one rule changed: the dynamics of a task, but for one thing."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

from imagine_bench.arrays import State
from imagine_bench.rules import Dynamics, Outcome, Rules

SLIP = 0.2  # probability that a macro-action does nothing in the world that slips


def slipping(rules: Rules) -> Dynamics:
    """Every macro-action does nothing with probability :data:`SLIP`."""

    def outcomes(state: State, action: int) -> list[Outcome]:
        moved = [replace(o, probability=(1.0 - SLIP) * o.probability) for o in rules.outcomes(state, action)]
        return [*moved, Outcome(SLIP, state, 0.0, terminated=False, success=False)]

    return outcomes


def coupled(rules: Rules, states: Sequence[State]) -> Dynamics:
    """One macro-action also has the effect of another: the pair that leads elsewhere in most macrostates."""

    def both(state: State, first: int, then: int) -> list[Outcome]:
        found = []
        for one in rules.outcomes(state, first):
            for two in rules.outcomes(one.macrostate, then):
                judged = rules.judge(state, first, two.macrostate)
                found.append(replace(judged, probability=one.probability * two.probability))
        return found

    def elsewhere(pair: tuple[int, int]) -> int:
        count = 0
        for state in states:
            alone = {o.macrostate for action in pair for o in rules.outcomes(state, action)}
            count += {o.macrostate for o in both(state, *pair)}.isdisjoint({state, *alone})
        return count

    one, other = max(itertools.permutations(range(rules.n_actions), 2), key=elsewhere, default=(0, 0))
    return lambda state, action: both(state, one, other) if action == one else rules.outcomes(state, action)
