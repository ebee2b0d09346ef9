"""Rules between symbols, and plans in them. A state is some symbols and, behind them, whatever is remembered."""

from __future__ import annotations

import abc

import numpy as np

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome, Rules, State
from imagine_bench.rules import horizon_optimum, tabulate

_HORIZON = 20
"""Macro-actions that are planned ahead."""


class SymbolRules(Rules):
    """Rules that begin in the states that are asked about; none of their outcomes is called a success."""

    states = None
    start_states: tuple[State, ...] = ()

    def __init__(self, n_actions: int) -> None:
        self._n_actions = n_actions
        self._plan: dict[State, int] = {}

    @property
    def n_actions(self) -> int:
        """Number of macro-actions."""
        return self._n_actions

    @abc.abstractmethod
    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """The outcomes of a macro-action; dynamics hold after an end, too."""

    def start(self, symbols: State) -> State:
        """The state of symbols at the beginning of an episode."""
        return symbols

    def follow(self, state: State, action: int, symbols: State) -> State:
        """The state after a macro-action that led to these symbols."""
        del state, action
        return symbols

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        """The outcome that leads to a state. Raises InvalidValueError: none does."""
        for outcome in self.outcomes(macrostate, action):
            if outcome.macrostate == reached:
                return outcome
        raise InvalidValueError(f"No outcome of action {action} in {macrostate} is {reached}.")

    def is_legal(self, macrostate: State) -> bool:
        """Any state is."""
        return True

    def is_terminal(self, macrostate: State) -> bool:
        """None is: an outcome is an end, not a state."""
        return False

    def optimal_action(self, macrostate: State) -> int:
        """The action of the largest expected return within 20 macro-actions, by value iteration.

        Raises:
            InvalidValueError: An outcome has no reward.
        """
        if macrostate not in self._plan:
            self.start_states = (macrostate,)
            tables = tabulate(self)
            if np.isnan(tables.reward).any():
                raise InvalidValueError("The outcomes have no reward, so there is nothing to plan for.")
            best = horizon_optimum(tables, _HORIZON).actions[-1]
            goes_on = tables.alive.sum(axis=1).reshape(tables.reward.shape)
            inside = (goes_on.any(axis=0) | tables.reward.any(axis=0)).tolist()
            self._plan |= {state: int(best[row]) for state, row in tables.index.items() if inside[row]}
        return self._plan.get(macrostate, 0)
