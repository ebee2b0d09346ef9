"""The rules against the exact facts that the thesis' puzzle has (chapter 5), counted by enumeration."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome
from imagine_bench.rules import facts, is_random

NAMES = ["arrow_puzzle", "arrow_puzzle_hard", "arrow_puzzle_toward", "arrow_puzzle_clockwise"]
FAMILY = EASY, HARD, TOWARD, CLOCKWISE = tuple(registry.task(name).rules for name in NAMES)
ALL = pytest.mark.parametrize("rules", FAMILY, ids=NAMES)


def test_counts_of_macrostates():
    assert len(EASY.states) == len(set(EASY.states)) == 192
    legal = [state for state in EASY.states if EASY.is_legal(state)]
    assert len(legal) == 72
    assert [sum(map(rules.is_goal, rules.states)) for rules in FAMILY] == [18, 6, 18, 6]
    assert [len(rules.start_states) for rules in FAMILY] == [54, 66, 54, 66]
    assert not any(map(is_random, FAMILY))


@ALL
def test_exactly_two_actions_are_legal_in_every_legal_macrostate(rules):
    for state in filter(rules.is_legal, rules.states):
        assert sum(rules.is_legal(rules.turned(state, action)) for action in range(6)) == 2


@pytest.mark.parametrize(
    ("rules", "chance", "optimal_return", "mean_length"),
    [
        (EASY, 0.04602, 48.222, 2.778),
        (HARD, 0.03766, 47.727, 3.273),
        (TOWARD, 0.04602, 48.222, 2.778),
        (CLOCKWISE, 0.03766, 47.727, 3.273),
    ],
    ids=NAMES,
)
def test_facts_of_the_digest(rules, chance, optimal_return, mean_length):
    known = facts(rules, 10)
    assert known.chance_level == pytest.approx(chance, abs=5e-6)
    assert known.optimum == pytest.approx(1.0, abs=1e-12)
    assert known.optimal_return == pytest.approx(optimal_return, abs=5e-4)
    assert known.mean_plan_length == pytest.approx(mean_length, abs=5e-4)


def test_unknown_actions_are_refused():
    with pytest.raises(InvalidValueError, match="Action 6 does not exist; give an integer from 0 to 5"):
        EASY.outcomes((0, 1, 3, 1), 6)


@dataclass(frozen=True)
class _Gamble:
    """Action 0 wins with probability 1/4 and otherwise stays; action 1 loses."""

    forever: float = 0.0
    total: float = 1.0
    n_actions: int = 2
    states: tuple = ((0,), (1,))
    start_states: tuple = ((0,),)

    def outcomes(self, macrostate, action):
        if action == 1:
            return (Outcome(1.0, (1,), -5.0, terminated=True, success=False),)
        return (
            Outcome(0.25, (1,), 8.0, terminated=True, success=True),
            Outcome(self.total - 0.25, (0,), self.forever, terminated=False, success=False),
        )


def test_the_solver_names_what_is_wrong():
    with pytest.raises(InvalidValueError, match=r"action 0 in macrostate \(0,\) sum to 0.9"):
        facts(_Gamble(total=0.9), 2)
    with pytest.raises(InvalidValueError, match="Horizon 0 is too short"):
        facts(_Gamble(), 0)


@dataclass(frozen=True)
class _Endless(_Gamble):
    def outcomes(self, macrostate, action):
        return (Outcome(1.0, (0,), 1.0, terminated=False, success=False),)


def test_an_endless_return_is_refused():
    with pytest.raises(InvalidValueError, match=r"From macrostate \(\d+,\) the rules allow an endless return"):
        facts(_Endless(), 2)
