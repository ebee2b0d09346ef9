"""Worlds with one rule changed: the dynamics of a task, but for one thing."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
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


def one_change_each(rules: Rules, states: Sequence[State], goals: Mapping[str, State]) -> dict[str, Dynamics]:
    """Worlds that differ from the rules in one thing, by name; ``goals`` are macrostates that become the goal."""
    best = max(o.reward for state in states for action in range(rules.n_actions) for o in rules.outcomes(state, action))

    def changed(change: Callable[[Outcome], Outcome]) -> Dynamics:
        return lambda state, action: [change(outcome) for outcome in rules.outcomes(state, action)]

    def goal_at(goal: State) -> Dynamics:
        def change(o: Outcome) -> Outcome:
            if o.macrostate == goal:
                return replace(o, reward=best, terminated=True, success=True)
            return replace(o, reward=0.0, terminated=False, success=False) if o.success else o

        return changed(change)

    last = rules.n_actions - 1
    return {
        "failures cost nothing": changed(lambda o: replace(o, reward=0.0) if _fails(o) else o),
        "failures pay": changed(lambda o: replace(o, reward=best) if _fails(o) else o),
        "failures end nothing": changed(lambda o: replace(o, terminated=False) if _fails(o) else o),
        "steps cost nothing": changed(lambda o: o if o.terminated else replace(o, reward=0.0)),
        "successes pay nothing": changed(lambda o: replace(o, reward=0.0) if o.success else o),
        "successes cost": changed(lambda o: replace(o, reward=-o.reward) if o.success else o),
        "macro-actions are reversed": lambda state, action: rules.outcomes(state, last - action),
        "macro-actions are shifted": lambda state, action: rules.outcomes(state, (action + 1) % rules.n_actions),
        "macro-actions slip": slipping(rules),
        "one macro-action has another's effect, too": coupled(rules, states),
        **{f"the goal is {name}": goal_at(goal) for name, goal in goals.items()},
    }


def _fails(outcome: Outcome) -> bool:
    return outcome.terminated and not outcome.success
