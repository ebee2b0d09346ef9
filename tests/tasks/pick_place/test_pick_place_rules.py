"""Pick-and-place with a human: the machine of the thesis' table 3.1, and its facts as worked out by hand."""

from __future__ import annotations

import pytest
from imagine_bench.tasks.continuous.instructions import instruction
from imagine_bench.tasks.pick_place.rules import PickPlaceRules
from imagine_bench.tasks.pick_place.spec import HORIZON
from whole_outputs import tabulated

from imagine_bench import registry
from imagine_bench.rules import facts, is_random, optimal_values, states_of_play, tabulate

RULES = PickPlaceRules()
PLAY = states_of_play(RULES)
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


@pytest.mark.parametrize("world", ["pick_place", "pick_place:slip=0.2,fickle=0.4"])
def test_outcomes_of_all_macrostates(world, expected):
    """Each with its probability, reward and end, * for success; and where the objects are if no grip slips.

    One macro-action is asked for in play, the optimal one, and none after an end. A slip keeps the objects, and 0.4 of
    all humans then point elsewhere: 0.2 x 0.4 / 2 = 0.04 at each of two others.
    """
    rules = registry.task(world).rules
    rows = []
    for state in rules.states:
        asked = [rules.is_asked_for(state, action) for action in range(4)]
        assert sum(asked) == (not rules.is_terminal(state)) == asked[rules.optimal_action(state)]
        for action in range(4):
            outcomes = rules.outcomes(state, action)
            assert sum(each.probability for each in outcomes) == pytest.approx(1.0)
            assert len({each.macrostate for each in outcomes} & set(rules.states)) == len(outcomes)
            assert all(rules.judge(state, action, each.macrostate) == each for each in outcomes)
            told = [
                (each.probability, each.macrostate, each.reward, "end" * each.terminated + "*" * each.success)
                for each in outcomes
            ]
            rows.append([state, action, "asked" * asked[action], rules.objects_after(state, action), *told])
        rows[-1].append(instruction(registry.task(world), state))
    expected("outcomes_of_pick_place", tabulated(rows), section=world)


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


@pytest.mark.parametrize("slip", [0.5, 0.99])
def test_grips_that_slip_cost_time_and_no_return(slip):
    """Also where they nearly always slip, so that an episode needs hundreds of macro-actions, and is cut off."""
    spec = registry.task(f"pick_place:slip={slip}")
    assert spec.facts().mean_plan_length == pytest.approx(min(6 / (1 - slip), HORIZON), rel=0.05)
    tables = tabulate(spec.rules)
    assert optimal_values(tables).max(axis=0)[tables.starts] == pytest.approx(8.0, abs=1e-6)
