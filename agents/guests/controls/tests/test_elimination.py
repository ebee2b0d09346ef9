"""Elimination: causes of one, two and three values against enumerated worlds, tables, plans, success by a few tries."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
import pytest
from imagine_bench_controls.elimination import EliminationAgent, EliminationModel, Outcome
from imagine_bench_controls.tabular.settings import HYPERPARAMETERS

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation, State, Transition
from imagine_bench.seeding import SeedTree
from imagine_bench.testing.checks import checked_agent

BLANK = np.zeros((64, 64, 3), dtype=np.uint8)
EVERY = list(product(range(3), repeat=3))
USUAL: Outcome = (-1.0, False)
PAID: Outcome = (5.0, True)
VALUE = {1: 2}
PAIR = {0: 1, 2: 0}
TRIPLE = {0: 1, 1: 1, 2: 2}


def outcome(state: State, cause: dict[int, int]) -> Outcome:
    return PAID if all(state[coordinate] == value for coordinate, value in cause.items()) else USUAL


def model_of(outcomes: Mapping[State, Outcome]) -> EliminationModel:
    """A model that saw each of these macrostates reached, from itself."""
    model = EliminationModel()
    for state, brought in outcomes.items():
        model.add(state, 0, state, brought)
    return model


def taught(cause: dict[int, int], unseen: State | None = None) -> EliminationModel:
    return model_of({state: outcome(state, cause) for state in EVERY if state != unseen})


@pytest.mark.parametrize("cause", [VALUE, PAIR, TRIPLE], ids=["one value", "a pair", "a triple"])
def test_of_every_macrostate_seen_the_outcome_is_right(cause: dict[int, int]) -> None:
    model = taught(cause)
    assert [model.outcome(state) for state in EVERY] == [outcome(state, cause) for state in EVERY]
    assert model.usual == USUAL
    assert model.most == max(2, len(cause))


def test_an_unseen_macrostate_is_told_as_far_as_others_decide_it() -> None:
    for state in EVERY:
        assert taught(PAIR, state).outcome(state) == outcome(state, PAIR)
        wanted = None if state[1] == 2 else USUAL
        assert taught(VALUE, state).outcome(state) == wanted, "a value that always paid may need a partner each time"
    assert taught(TRIPLE, (0, 0, 0)).outcome((0, 0, 0)) is None, "no other tells anything of a triple"


def test_a_pair_stays_a_cause_beside_one_of_three_values() -> None:
    """Every triple around a forbidden pair is as suspect as the pair; only the pair is asked about."""
    forbidden: Outcome = (-5.0, True)
    unseen = (0, 0, 2)
    model = model_of({s: forbidden if s[:2] == (0, 0) else outcome(s, TRIPLE) for s in EVERY if s != unseen})
    assert model.most == 3, "otherwise nothing is tested"
    assert model.outcome(unseen) == forbidden
    assert model.outcome((1, 1, 2)) == PAID


def test_two_suspects_are_no_cause_until_one_is_cleared() -> None:
    model = model_of(dict.fromkeys([(0, 0, 1), (0, 1, 0), (1, 0, 0)], USUAL))
    assert model.outcome((0, 0, 0)) == USUAL, "its three pairs came with the usual outcome"
    assert model.outcome((0, 1, 1)) is None, "the values 1 and 1 never came together"
    usual = [(0, 0, 0), (0, 0, 2), (0, 2, 0), (1, 0, 2), (1, 2, 0), (2, 1, 0), (2, 0, 1), (2, 0, 0), (0, 1, 0)]
    paid = {(1, 1, 1): PAID}
    model = model_of(dict.fromkeys(usual, USUAL) | paid)
    assert model.outcome((1, 1, 0)) is None, "each of its three pairs may be the cause"
    model = model_of(dict.fromkeys([*usual, (1, 0, 1), (0, 1, 1)], USUAL) | paid)
    assert model.outcome((1, 1, 0)) == PAID, "only the first two values together are left"


def test_the_most_frequent_next_value_is_expected() -> None:
    model = EliminationModel()
    for after in (1, 2, 2):
        model.add((0,), 3, (after,), USUAL)
    assert model.next_state((0,), 3) == (2,)
    assert model.next_state((0,), 2) is None
    assert model.next_state((1,), 3) is None


def learner() -> EliminationAgent:
    return EliminationAgent(2, HYPERPARAMETERS.resolve("fast", {}, "chapter_5"), SeedTree(0))


def seen(state: State) -> Observation:
    return Observation(frame=BLANK, macrostate=np.array(state))


def test_the_unknown_is_worth_the_largest_reward_and_nothing_in_tests() -> None:
    agent = learner()
    here = seen((0,))
    then = seen((1,))
    paid = Transition(observation=here, action=0, reward=5.0, next_observation=then, terminated=True, truncated=False)
    agent.observe(paid, episode=0)
    assert agent.q_values(here).tolist() == [5.0, 0.0]
    assert agent.q_values(then).tolist() == [0.0, 0.0]
    drawn = {agent.act(here, explore=True) for _ in range(20)}
    assert drawn == {0, 1}, "the untried action may bring as much as the best one seen"
    assert agent.act(here, explore=False) == 0
    before = Transition(
        observation=seen((2,)), action=1, reward=-1.0, next_observation=here, terminated=False, truncated=False
    )
    agent.observe(before, episode=1)
    discount = agent.settings.controller.discount
    assert discount < 1.0 and agent.q_values(seen((2,))).tolist() == pytest.approx([0.0, 5.0 * discount - 1.0])


def test_it_solves_every_start_within_150_macro_actions() -> None:
    """Chance solves 4.6 % of episodes."""
    one = checked_agent("elimination", "arrow_puzzle")
    agent = one.make()
    one.train(agent, range(60))
    assert agent.diagnostics()["real_transitions"] <= 150
    for start in one.spec.rules.start_states:
        state = start
        for _ in range(one.spec.horizon):
            (result,) = one.spec.rules.outcomes(state, agent.act(seen(state), explore=False))
            state = result.macrostate
            if result.terminated:
                break
        assert result.success


def test_without_a_macrostate_it_says_so() -> None:
    with pytest.raises(InvalidValueError, match="reads the true macrostate, and the observation shows none"):
        learner().act(Observation(frame=BLANK), explore=True)
