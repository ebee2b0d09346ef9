"""Pick-and-place with a human: the machine of the thesis' table 3.1, and its facts as worked out by hand."""

from __future__ import annotations

import pytest
from imagine_bench.tasks.pick_place.rules import (
    HAND_OVER,
    HANDED_OVER,
    OPEN_PALM,
    PICKED,
    WITHDRAWN,
    PickPlaceRules,
)
from imagine_bench.tasks.pick_place.spec import HORIZON

from imagine_bench.rules import facts, is_random, optimal_values, tabulate

RULES = PickPlaceRules()
PLAY = [state for state in RULES.states if not RULES.is_terminal(state)]
TABLE_3_1 = [
    (0, 0, 0, 0), (0, 0, 0, 1), (0, 0, 0, 2),
    (1, 0, 0, 1), (1, 0, 0, 2), (1, 0, 0, 3),
    (0, 1, 0, 0), (0, 1, 0, 2), (0, 1, 0, 3),
    (0, 0, 1, 0), (0, 0, 1, 1), (0, 0, 1, 3),
]  # fmt: skip


def test_play_is_table_3_1_in_its_order():
    assert list(RULES.states[:12]) == TABLE_3_1 == PLAY
    assert len(set(RULES.states)) == len(RULES.states) == 19
    assert RULES.start_states == tuple(TABLE_3_1[:3])
    assert is_random(RULES)


def test_one_action_is_asked_for_in_play_and_none_after_an_end():
    for state in RULES.states:
        right = [action for action in range(4) if RULES.is_asked_for(state, action)]
        assert len(right) == (0 if RULES.is_terminal(state) else 1)
        for action in set(range(4)) - set(right):
            (outcome,) = RULES.outcomes(state, action)
            assert (outcome.reward, outcome.terminated, outcome.success) == (-5.0, True, False)


def test_the_human_keeps_pointing_while_an_object_is_put_back():
    (outcome,) = RULES.outcomes((1, 0, 0, 2), 0)
    assert (outcome.macrostate, outcome.reward, outcome.terminated) == ((0, 0, 0, 2), 0.0, False)


def test_a_handover_ends_well_only_into_an_open_palm():
    (good,) = RULES.outcomes((0, 0, 1, OPEN_PALM), HAND_OVER)
    assert (good.macrostate, good.reward, good.success) == ((0, 0, HANDED_OVER, OPEN_PALM), 5.0, True)
    (early,) = RULES.outcomes((0, 0, 1, 0), HAND_OVER)
    assert (early.macrostate, early.reward, early.success) == ((0, 0, PICKED, WITHDRAWN), -5.0, False)
    assert RULES.objects_after((0, 0, PICKED, WITHDRAWN), HAND_OVER) == (0, 0, PICKED), "into no hand that is gone"


def test_a_fault_counts_as_a_wrong_action():
    missed = RULES.judge((0, 0, 0, 1), 1, (0, 0, 0, WITHDRAWN))
    assert (missed.reward, missed.terminated, missed.success) == (-5.0, True, False)


def test_facts_are_those_worked_out_by_hand():
    """Optimal: V = 1 + 5/3 + 2/3 V = 8, in 6 actions. Random: S = 1/4 (1/3 1/4 + 2/3 1/4 S) = 1/46."""
    found = facts(RULES, HORIZON)
    assert found.optimum == pytest.approx(1 - (2 / 3) ** (HORIZON // 2), abs=1e-12)
    assert found.optimum > 0.9999
    assert found.chance_level == pytest.approx(1 / 46, abs=1e-9)
    assert found.optimal_return == pytest.approx(8.0, abs=1e-2)
    assert found.mean_plan_length == pytest.approx(6.0, abs=1e-2)
    tables = tabulate(RULES)
    assert optimal_values(tables).max(axis=0)[tables.starts] == pytest.approx([8.0] * 3)


def test_the_optimal_policy_does_what_is_asked_for():
    for state in PLAY:
        assert RULES.is_asked_for(state, RULES.optimal_action(state))
