"""Elimination: causes of one, two and three values against enumerated worlds, tables, plans, success by a few tries."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from imagine_bench_controls.elimination import EliminationAgent, EliminationModel, Outcome
from imagine_bench_controls.tabular.settings import HYPERPARAMETERS

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation, State, Transition
from imagine_bench.seeding import SeedTree

BLANK = np.zeros((64, 64, 3), dtype=np.uint8)
EVERY = list(product(range(3), repeat=3))
USUAL: Outcome = (-1.0, False)
PAID: Outcome = (5.0, True)
CAUSES = {"one value": {1: 2}, "a pair": {0: 1, 2: 0}, "a triple": {0: 1, 1: 1, 2: 2}}


def outcome(state: State, cause: dict[int, int]) -> Outcome:
    return PAID if all(state[coordinate] == value for coordinate, value in cause.items()) else USUAL


def taught(cause: dict[int, int], unseen: State | None = None) -> EliminationModel:
    """A model that saw every macrostate but one reached, from itself and by the action 0."""
    model = EliminationModel()
    for state in EVERY:
        if state != unseen:
            model.add(state, 0, state, outcome(state, cause))
    return model


@pytest.mark.parametrize("cause", CAUSES.values(), ids=CAUSES)
def test_of_every_macrostate_seen_the_outcome_is_right(cause: dict[int, int]) -> None:
    model = taught(cause)
    assert [model.outcome(state) for state in EVERY] == [outcome(state, cause) for state in EVERY]
    assert model.usual == USUAL
    assert model.most == max(2, len(cause))


def test_an_unseen_macrostate_is_told_by_its_pairs() -> None:
    cause = CAUSES["a pair"]
    assert [taught(cause, state).outcome(state) for state in EVERY] == [outcome(state, cause) for state in EVERY]


def test_a_single_value_may_also_need_a_partner() -> None:
    """A macrostate with a value that always paid is unknown: a pair may have been the cause each time."""
    cause = CAUSES["one value"]
    found = {state: taught(cause, state).outcome(state) for state in EVERY}
    assert found == {state: None if state[1] == 2 else USUAL for state in EVERY}


def test_a_pair_stays_a_cause_where_another_outcome_needs_three_values() -> None:
    """Every triple around a forbidden pair is as suspect as the pair; only the pair is asked about."""
    forbidden: Outcome = (-5.0, True)
    unseen = (0, 0, 2)
    model = EliminationModel()
    for state in EVERY:
        if state != unseen:
            model.add(state, 0, state, forbidden if state[:2] == (0, 0) else outcome(state, CAUSES["a triple"]))
    assert model.most == 3, "otherwise nothing is tested"
    assert model.outcome(unseen) == forbidden
    assert model.outcome((1, 1, 2)) == PAID


def test_an_unseen_triple_is_unknown() -> None:
    """Where all three values together decide, no other macrostate tells anything of a triple."""
    model = taught(CAUSES["a triple"], (0, 0, 0))
    assert model.outcome((0, 0, 0)) is None


def test_a_pair_never_seen_is_unknown_and_a_pair_seen_as_usual_is_cleared() -> None:
    model = EliminationModel()
    model.add((0, 0, 0), 0, (0, 0, 1), USUAL)
    model.add((0, 0, 1), 0, (0, 1, 0), USUAL)
    model.add((0, 1, 0), 0, (1, 0, 0), USUAL)
    assert model.outcome((0, 0, 0)) == USUAL, "its three pairs came with the usual outcome"
    assert model.outcome((0, 1, 1)) is None, "the values 1 and 1 never came together"


def test_two_suspects_are_no_cause_until_one_is_cleared() -> None:
    model = EliminationModel()
    for state in [(0, 0, 0), (0, 0, 2), (0, 2, 0), (1, 0, 2), (1, 2, 0), (2, 1, 0), (2, 0, 1), (2, 0, 0), (0, 1, 0)]:
        model.add(state, 0, state, USUAL)
    model.add((0, 0, 0), 1, (1, 1, 1), PAID)
    assert model.outcome((1, 1, 0)) is None, "each of its three pairs may be the cause"
    for state in [(1, 0, 1), (0, 1, 1)]:
        model.add((0, 0, 0), 1, state, USUAL)
    assert model.outcome((1, 1, 0)) == PAID, "only the first two values together are left"


def test_the_most_frequent_next_value_is_expected() -> None:
    model = EliminationModel()
    for after in (1, 2, 2):
        model.add((0,), 3, (after,), USUAL)
    assert model.next_state((0,), 3) == (2,)
    assert model.next_state((0,), 2) is None
    assert model.next_state((1,), 3) is None


def learner(n_actions: int, seed: int = 0) -> EliminationAgent:
    return EliminationAgent(n_actions, HYPERPARAMETERS.resolve("fast", {}, "chapter_5"), SeedTree(seed))


def seen(state: State) -> Observation:
    return Observation(frame=BLANK, macrostate=np.array(state))


def test_the_unknown_is_worth_the_largest_reward_and_nothing_in_tests() -> None:
    agent = learner(2)
    agent.observe(
        Transition(
            observation=seen((0,)),
            action=0,
            reward=5.0,
            next_observation=seen((1,)),
            terminated=True,
            truncated=False,
        ),
        episode=0,
    )
    assert agent.q_values(seen((0,))).tolist() == [5.0, 0.0]
    assert agent.q_values(seen((1,))).tolist() == [0.0, 0.0]
    drawn = {agent.act(seen((0,)), explore=True) for _ in range(20)}
    assert drawn == {0, 1}, "the untried action may bring as much as the best one seen"
    assert agent.act(seen((0,)), explore=False) == 0


def test_it_solves_the_arrow_puzzle_from_every_start_within_150_macro_actions() -> None:
    """Chance solves 4.6 % of episodes."""
    spec = registry.task("arrow_puzzle")
    rules = spec.rules
    agent = learner(spec.n_actions)
    rng = np.random.default_rng(0)
    steps = 0
    while steps < 150:
        state = rules.start_states[int(rng.integers(len(rules.start_states)))]
        for _ in range(spec.horizon):
            action = agent.act(seen(state), explore=True)
            (result,) = rules.outcomes(state, action)
            agent.observe(
                Transition(
                    observation=seen(state),
                    action=action,
                    reward=result.reward,
                    next_observation=seen(result.macrostate),
                    terminated=result.terminated,
                    truncated=False,
                ),
                episode=0,
            )
            steps += 1
            state = result.macrostate
            if result.terminated:
                break
    assert all(solves(agent, start) for start in rules.start_states)


def solves(agent: EliminationAgent, state: State) -> bool:
    spec = registry.task("arrow_puzzle")
    for _ in range(spec.horizon):
        (result,) = spec.rules.outcomes(state, agent.act(seen(state), explore=False))
        state = result.macrostate
        if result.terminated:
            return result.success
    return False


def test_without_a_macrostate_it_says_so() -> None:
    with pytest.raises(InvalidValueError, match="reads the true macrostate, and the observation shows none"):
        learner(2).act(Observation(frame=BLANK), explore=True)
