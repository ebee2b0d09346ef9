"""Each failure has one cause: agents made to fail for exactly one known reason are charged exactly that."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.exact.values import true_model
from imagine_bench.interfaces import Outcome, State, TaskSpec
from imagine_bench.interfaces.capabilities import ExpectedOutcomes
from imagine_bench.judge.causes import (
    CAUSES,
    Attribution,
    FailedEpisode,
    drawn_by,
    expected_rightly,
    memory_suffices,
    place,
)
from imagine_bench.rules import fewest_actions, states_of
from imagine_bench.store.results import PolicyTable

SPEC = registry.task("arrow_puzzle")
RULES = SPEC.rules
STATES = states_of(RULES)
ALL = np.array([[*state, action] for state in STATES for action in range(RULES.n_actions)])
EVERY = np.ones(len(STATES), dtype=np.bool_)
NONE = np.zeros((0, 5), dtype=np.int64)
ILLEGAL = {s: next(a for a in range(6) if not RULES.is_legal(RULES.outcomes(s, a)[0].macrostate)) for s in STATES}
OPTIMAL = {s: RULES.optimal_action(s) for s in STATES}
FAR = [s for s in RULES.start_states if fewest_actions(RULES, s) >= 2]


def model_of(spec: TaskSpec, wrong: Callable[[State, int], bool] = lambda state, action: False) -> ExpectedOutcomes:
    """The rules as an agent's model, but for pairs about which it is wrong: there it expects nothing good to follow."""
    states = states_of(spec.rules)
    truth = true_model(spec.rules, states)
    doubted = np.array([[wrong(state, action) for action in range(spec.n_actions)] for state in states])
    return ExpectedOutcomes(
        macrostates=np.array(states)[truth.following],
        p_continues=np.where(doubted[..., None], 0.0, truth.p_continues),
        reward=np.where(doubted, -9.0, truth.reward),
    )


def does(choice: dict[State, int], model: ExpectedOutcomes | None, states: tuple[State, ...] = STATES) -> PolicyTable:
    return PolicyTable(action=np.array([choice[state] for state in states], dtype=np.int16), model=model)


def episode(start: State, actions: list[int], **changes: Any) -> FailedEpisode:
    """The outcomes of macro-actions by the rules, which leave nothing to chance here."""
    states, terminated = [start], False
    for action in actions:
        (outcome,) = RULES.outcomes(states[-1], action)
        states.append(outcome.macrostate)
        terminated = outcome.terminated
    quiet = [False] * len(actions)
    known = {"states": states, "actions": actions, "terminated": terminated, "faults": quiet, "misread": quiet}
    return FailedEpisode(**{**known, "seed": 5, **changes})


def cause(agent: PolicyTable, tried: NDArray[np.int64], happened: FailedEpisode, spec: TaskSpec = SPEC) -> str:
    return Attribution(spec, agent, tried, np.ones(len(agent.action), dtype=np.bool_)).cause(happened)


FAILED = episode(FAR[0], [ILLEGAL[FAR[0]]])


def test_the_best_action_stands_where_an_agent_reads_nothing() -> None:
    """The answers of its model there, from frames that it misreads, is not held against the model."""
    readable = np.array([state != FAR[0] for state in STATES])
    there = model_of(SPEC, lambda state, action: state == FAR[0])
    blind = dataclasses.replace(FAILED, misread=[True])
    plays_well, plays_badly = (Attribution(SPEC, does(each, there), ALL, readable) for each in (OPTIMAL, ILLEGAL))
    assert plays_well.cause(blind) == "misread" and plays_well.cause(FAILED) == "planning", "it read this frame right"
    assert plays_badly.cause(blind) == plays_badly.cause(FAILED) == "planning"


def test_what_was_never_experienced_is_charged_to_experience() -> None:
    """It knows every transition but those that solve a puzzle, and would do all others right."""

    def solving(state: State, action: int) -> bool:
        return any(outcome.success for outcome in RULES.outcomes(state, action))

    tried = np.array([row for row in ALL.tolist() if not solving(tuple(row[:-1]), row[-1])])
    wrong, guessing = (does(dict.fromkeys(STATES, 0), model) for model in (model_of(SPEC, solving), None))
    assert cause(wrong, tried, FAILED) == cause(guessing, tried, FAILED) == "unexperienced"
    assert cause(wrong, ALL, FAILED) == "model", "it was experienced, and the model is wrong all the same"
    assert cause(guessing, ALL, FAILED) == "values"
    assert cause(does(dict.fromkeys(STATES, 0), model_of(SPEC)), NONE, FAILED) == "planning", "the model needs no more"
    odd = np.array([[9, 9, 9, 9, 0]])  # a scene that was no macrostate
    assert cause(does(OPTIMAL, None), odd, FAILED) == "unexperienced"


def test_a_model_expects_a_share_of_each_macro_action_rightly() -> None:
    """It knows no slips, and of some pairs it expects an end that never comes."""
    spec, never = (registry.task(f"arrows:cubes=2,slip={slip}") for slip in (0.25, 0.0))
    states = states_of(spec.rules)

    def wrong(state: State, action: int) -> bool:
        return sum(state) % 2 == 0 and not any(each.terminated for each in spec.rules.outcomes(state, action))

    pairs = itertools.product([each for each in states if not spec.rules.is_terminal(each)], range(spec.n_actions))
    share = np.mean([wrong(*pair) for pair in pairs])
    held, without = (does(dict.fromkeys(states, 0), model, states) for model in (model_of(never, wrong), None))
    assert expected_rightly(spec.rules, held) == pytest.approx(0.75 * (1.0 - share)) and 0.1 < share < 0.9
    assert math.isnan(expected_rightly(spec.rules, without))


def test_a_start_from_which_no_plan_fits_is_unlucky() -> None:
    start = max(RULES.start_states, key=lambda state: fewest_actions(RULES, state))
    short = dataclasses.replace(SPEC, horizon=fewest_actions(RULES, start) - 1)
    actions = [0, 1] * 5
    failed = episode(start, actions[: short.horizon])
    assert cause(does(OPTIMAL, model_of(SPEC)), ALL, failed, short) == "unlucky"


def test_every_failure_has_exactly_one_cause() -> None:
    """Agents wrong in every way at once: none of their failures is without a cause, or charged where none can be."""
    rng = np.random.default_rng(3)
    counted = dict.fromkeys(CAUSES, 0)
    for number in range(9):
        choice = {state: int(rng.integers(6)) for state in STATES}
        doubt = rng.random(2)
        model = None if number % 3 == 0 else model_of(SPEC, lambda state, action, p=doubt[0]: rng.random() < p)
        found = Attribution(SPEC, does(choice, model), ALL[rng.random(len(ALL)) < doubt[1]], EVERY)
        for start in RULES.start_states:
            actions: list[int] = []
            happened = episode(start, actions)
            while not happened.terminated and len(actions) < SPEC.horizon:
                actions.append(int(rng.integers(6)) if rng.random() < 0.3 else choice[happened.states[-1]])
                happened = episode(start, actions)
            if not RULES.judge(start, 0, happened.states[-1]).success:
                misread = (rng.random(len(actions)) < 0.2).tolist()
                counted[found.cause(dataclasses.replace(happened, misread=misread))] += 1
                assert found.cause(happened) != "misread"
    assert all(counted[name] for name in ("misread", "unexperienced", "model", "planning", "values"))
    assert counted["execution"] == counted["unlucky"] == 0, "the rules leave nothing to chance, and always a way"


def test_a_number_finds_the_outcome_that_it_stands_for() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        shares = rng.dirichlet(np.ones(4))
        outcomes = [Outcome(float(p), (i,), 0.0, terminated=False, success=False) for i, p in enumerate(shares)]
        for outcome in outcomes:
            before, probability = place(outcomes, outcome.macrostate)
            assert drawn_by(before + probability * rng.random(), outcomes) is outcome
        drawn = np.random.default_rng(9).choice(4, p=shares)
        assert drawn_by(np.random.default_rng(9).random(), outcomes) is outcomes[drawn], "as an environment draws"


MEMORY = registry.task("arrows:horizon=5,gesture=first")


def test_a_model_that_expects_the_gesture_to_be_hidden_is_not_wrong() -> None:
    whole = model_of(MEMORY)
    hiding = whole.macrostates.copy()
    hiding[..., -1] = RULES.world.cubes  # the probe's class of a hidden gesture
    found = [
        cause(does(ILLEGAL, dataclasses.replace(whole, macrostates=each)), ALL, FAILED, MEMORY)
        for each in (whole.macrostates, hiding)
    ]
    assert found == ["planning", "planning"]


def test_a_misread_hidden_frame_is_not_blamed_on_memory() -> None:
    start = FAR[0]
    (outcome,) = RULES.outcomes(start, OPTIMAL[start])
    lost = episode(start, [OPTIMAL[start], ILLEGAL[outcome.macrostate]], hidden=[False, True])
    blamed = [
        cause(does(OPTIMAL, model_of(MEMORY)), ALL, dataclasses.replace(lost, misread=[False, wrong]), MEMORY)
        for wrong in (False, True)
    ]
    assert blamed == ["forgotten", "misread"]


def test_memory_suffices_where_the_first_frame_shows_all_that_stays() -> None:
    assert all(map(memory_suffices, map(registry.task, ("arrow_puzzle", "arrows:gesture=first"))))
    for name in ("arrows:gesture=first,goal_change=0.1", "pick_place:gesture=first"):
        assert not memory_suffices(registry.task(name)), name
