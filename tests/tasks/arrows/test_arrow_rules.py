"""The rules against the exact facts that the thesis' puzzle has (chapter 5), counted by enumeration."""

from __future__ import annotations

import math

import numpy as np
import pytest

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome
from imagine_bench.rules import facts, is_random

NAMES = ["arrow_puzzle", "arrow_puzzle_hard", "arrow_puzzle_toward", "arrow_puzzle_clockwise"]
FAMILY = EASY, HARD, TOWARD, CLOCKWISE = tuple(registry.task(name).rules for name in NAMES)


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
    n_actions, states, start_states = 1, ((0,),), ((0,),)

    def __init__(self, reward):
        self._reward = reward

    def outcomes(self, macrostate, action):
        return (Outcome(1.0, (0,), self._reward, terminated=False, success=False),)


def test_the_solver_names_what_is_wrong():
    with pytest.raises(InvalidValueError, match="Horizon 0 is too short"):
        facts(EASY, 0)
    for reward in (1.0, math.inf, math.nan):
        with np.errstate(invalid="ignore"), pytest.raises(InvalidValueError, match="rules allow an endless"):
            facts(_Endless(reward), 2)
