"""The rules against the exact facts that the thesis' puzzle has (chapter 5), counted by enumeration."""

from __future__ import annotations

import math

import numpy as np
import pytest

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome
from imagine_bench.rules import facts, is_random, states_of_play

NAMES = ["arrow_puzzle", "arrow_puzzle_hard", "arrow_puzzle_toward", "arrow_puzzle_clockwise"]
FAMILY = EASY, HARD, TOWARD, CLOCKWISE = tuple(registry.task(name).rules for name in NAMES)


def test_counts_of_macrostates():
    assert len(EASY.states) == len(set(EASY.states)) == 192
    legal = [state for state in EASY.states if EASY.is_legal(state)]
    assert len(legal) == 72
    assert [sum(map(rules.is_goal, rules.states)) for rules in FAMILY] == [18, 6, 18, 6]
    assert [len(rules.start_states) for rules in FAMILY] == [54, 66, 54, 66]
    assert set(states_of_play(EASY)) == set(EASY.start_states), "no goal is out of reach"
    assert not any(map(is_random, FAMILY))


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
    assert not is_random(rules)
    assert known.chance_level == pytest.approx(chance, abs=5e-6)
    assert known.optimum == pytest.approx(1.0, abs=1e-12)
    assert known.optimal_return == pytest.approx(optimal_return, abs=5e-4)
    assert known.mean_plan_length == pytest.approx(mean_length, abs=5e-4)


class _Endless:
    """From one of two macrostates there is no way out."""

    n_actions, states, start_states = 1, ((0,), (1,)), ((0,),)

    def __init__(self, reward):
        self._reward = reward

    def outcomes(self, macrostate, action):
        ends = macrostate == (0,)
        return (Outcome(1.0, macrostate, 0.0 if ends else self._reward, terminated=ends, success=False),)


def test_the_solver_names_what_is_wrong():
    with pytest.raises(InvalidValueError, match="Horizon 0 is too short"):
        facts(EASY, 0)
    for reward in (1.0, math.inf, math.nan):
        with (
            np.errstate(invalid="ignore"),
            pytest.raises(InvalidValueError, match=r"^From macrostate \(1,\) the rules"),
        ):
            facts(_Endless(reward), 2)
