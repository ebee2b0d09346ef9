"""What the rules of every world share: slips and a changing goal on top of a task's own outcomes, and a best policy."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome, Rules, State
from imagine_bench.rules import optimal_policy, tabulate

from .parameters import WorldParameters


class WorldRules(Rules):
    """The macrostate machine of a world with parameters; a task says what its macro-actions do without them."""

    world: WorldParameters

    def slipped(self, macrostate: State) -> Outcome:
        """The outcome of a macro-action that leaves all as it is, for the fingers open too early."""
        return self.judge(macrostate, 0, macrostate)

    @abc.abstractmethod
    def asked_otherwise(self, outcome: Outcome) -> Sequence[Outcome]:
        """What an outcome becomes where the human says something else instead, each equally likely."""

    def varied(self, macrostate: State, outcomes: tuple[Outcome, ...]) -> tuple[Outcome, ...]:
        """Outcomes of a macro-action as they are with slips and a changing goal; equal ones are one."""
        slip = self.world.slip
        change = self.world.goal_change
        if slip:
            kept = [replace(each, probability=(1.0 - slip) * each.probability) for each in outcomes]
            outcomes = (*kept, replace(self.slipped(macrostate), probability=slip))
        if not change:
            return outcomes
        chances: dict[Outcome, float] = {}
        for outcome in outcomes:
            others = () if outcome.terminated else self.asked_otherwise(outcome)
            share = change if others else 0.0
            for each, chance in ((outcome, 1.0 - share), *((other, share / len(others)) for other in others)):
                key = replace(each, probability=1.0)
                chances[key] = chances.get(key, 0.0) + outcome.probability * chance
        return tuple(replace(each, probability=chance) for each, chance in chances.items() if chance)

    def require_action(self, action: int) -> None:
        """Check a macro-action. Raises InvalidValueError: there is no such one."""
        if not 0 <= action < self.n_actions:
            raise InvalidValueError(f"Action {action} does not exist; give an integer from 0 to {self.n_actions - 1}.")

    @cached_property
    def _policy(self) -> dict[State, int]:
        tables = tabulate(self)
        return dict(zip(tables.index, optimal_policy(tables).tolist(), strict=True))

    def optimal_action(self, macrostate: State) -> int:
        """The action with the largest expected return (the lowest index among equals)."""
        return self._policy[tuple(int(value) for value in macrostate)]
