"""The knowledge that factored:given keeps from one task to the next of the same world, and forgets; its queries."""

from __future__ import annotations

import copy
import itertools
import math
from unittest import mock

import fake_codes
import numpy as np
import pytest
from fake_codes import ACTIONS, agent, frame, live
from imagine_bench_factored import agent as own
from imagine_bench_factored.agent import FactoredAgent
from imagine_bench_factored.dynamics import Dynamics
from imagine_bench_factored.factors import CodeTransition
from imagine_bench_factored.outcomes import OutcomeModel
from imagine_bench_factored.settings import OutcomeSettings
from numpy.typing import NDArray

from imagine_bench.interfaces import Observation
from imagine_bench.interfaces.capabilities import Label, QueryingAgent, TransferLearner


def dynamics_of(learner: FactoredAgent) -> list[np.ndarray]:
    return [part.evidence for part in learner.model.dynamics.factors]


@pytest.fixture(scope="module")
def experienced() -> FactoredAgent:
    """Has learned the first task; tests change copies of it."""
    learner = agent(3)
    live(learner, range(40), np.random.default_rng(3))
    return learner


def test_the_dynamics_stay_and_the_outcomes_begin_anew(experienced: FactoredAgent) -> None:
    learner = copy.deepcopy(experienced)
    assert isinstance(learner, TransferLearner)
    assert learner.diagnostics()["real_transitions"] == len(learner.replay)
    assert learner.model.outcomes.starts
    learner.reset_for_new_task()
    assert not learner.model.outcomes.starts, "another task may end where this one began"
    known = Dynamics(learner.perception.sizes, ACTIONS, learner.settings.dynamics)
    for row in learner.replay:
        known.add(np.array(row.code), row.action, np.array(row.following))
    for mine, all_of_it in zip(dynamics_of(learner), known.factors, strict=True):
        assert np.array_equal(mine, all_of_it.evidence)
    assert learner.model.outcomes.causes is None
    assert not learner.q_values(Observation(frame=frame((0, 1, 0)))).any(), "nothing is known of the new task"
    assert learner.diagnostics()["real_transitions"] == 0


def test_rewards_of_a_task_are_classed_as_often_as_those_of_the_first() -> None:
    """Each time of all its transitions, of nothing earlier, which have become a fifth more."""
    learner = agent(3)
    with mock.patch.object(own, "reward_classes", side_effect=own.reward_classes) as classed:
        for seed in (3, 4):
            begin = len(learner.replay)
            live(learner, range(20), np.random.default_rng(seed))
            wanted = [1]
            while (more := math.ceil(1.2 * wanted[-1])) <= len(learner.replay) - begin:
                wanted.append(more)
            assert [len(call.args[0]) for call in classed.call_args_list] == wanted and len(wanted) > 8
            learner.reset_for_new_task()
            classed.reset_mock()


def test_an_earlier_outcome_is_believed_by_its_tested_causes() -> None:
    """Two walls of three still hurt, so the third is believed to; goals that failed speak against the third."""
    learner = OutcomeModel((4, 4), 1, OutcomeSettings(transfer_weight=0.5))

    def add(reward: float, *codes: tuple[int, int]) -> None:
        for code in codes:
            learner.add(CodeTransition((3, 3), 0, code, reward, reward != -1.0))

    def expected() -> list[float]:
        learner.fit()
        codes = np.array([(2, 3), (3, 2)])
        probability, _ = learner.predict(np.array([(3, 3)] * 2), np.zeros(2, dtype=np.int64), codes)
        return [float(row @ (learner.rewards == good)) for row, good in zip(probability, (-5.0, 5.0), strict=True)]

    def strengths() -> NDArray[np.float64]:
        """Of the third wall and the third goal as causes."""
        assert learner.causes is not None
        numbers = learner.conjunctions.next.numbers(np.array([(2, 3), (3, 2)]))[:, -1]
        pairs = zip((-5.0, 5.0), numbers, strict=True)
        return np.array([learner.causes.strength[learner.outcomes.index((end, True)), cause] for end, cause in pairs])

    for _ in range(5):
        add(-5.0, (0, 3), (1, 3), (2, 3))
        add(5.0, (3, 0), (3, 1), (3, 2))
        add(-1.0, (3, 3), *itertools.product(range(3), repeat=2))
    assert min(expected()) > 0.9
    earlier = strengths()
    learner.reset_for_new_task()
    add(-1.0, (3, 3))
    assert expected() and strengths() == pytest.approx(0.5 * earlier)
    add(-5.0, (0, 3), (1, 3))
    add(-1.0, (3, 0), (3, 1))
    wall, goal = expected()
    assert wall > 0.65 and goal < 0.35
    held = np.array([2.0, 0.0])  # of two tests; pseudo_causes more are worth transfer_weight
    assert strengths() == pytest.approx((2.0 * 0.5 + held) / (2.0 + 2.0) * earlier)


# --- queries -----------------------------------------------------------------------------------------------------

CODE = (0, 1, 1)
SEEN = Observation(frame=frame(CODE))


def ask(learner: FactoredAgent, queries: int) -> list[list[int]]:
    """Let it query, and label truly; the macro-actions asked about."""
    asked = []
    while len(asked) < queries and (actions := learner.query(SEEN)) is not None:
        asked.append(actions.tolist())
        here = CODE
        for action in asked[-1]:
            here, *outcome = fake_codes.step(here, action)
        learner.learn_label(SEEN, actions, Label(*outcome))
    return asked


@pytest.fixture
def curious() -> FactoredAgent:
    """After twelve episodes, the expected outcome of the last one included."""
    learner = agent()
    live(learner, range(12), np.random.default_rng(0))
    learner.learn()
    return learner


def test_it_queries_what_is_uncertain_and_learns_no_dynamics(curious: FactoredAgent) -> None:
    assert isinstance(curious, QueryingAgent)
    assert agent().query(SEEN) is None, "nothing is known, so nothing can be imagined"

    def unknown() -> float:
        rollout = curious.imagine(SEEN.frame, actions=np.array([0]), depth=1, rng=np.random.default_rng(0))
        return float(rollout.epistemic[0])

    known, real, before = copy.deepcopy(dynamics_of(curious)), len(curious.replay), unknown()
    asked = ask(curious, 200)
    assert 0 < len(asked) < 200
    assert max(map(len, asked)) > 1, "states that are not one action away can be asked about too"
    assert all(np.array_equal(*pair) for pair in zip(known, dynamics_of(curious), strict=True))
    counted = curious.diagnostics()
    assert (counted["real_transitions"], counted["oracle/labels"]) == (real, len(asked))
    assert unknown() <= before


def test_what_has_no_label_teaches_nothing_and_is_not_asked_again(curious: FactoredAgent) -> None:
    values = curious.q_values(SEEN)
    for _ in range(5):
        actions = curious.query(SEEN)
        assert actions is not None
        curious.learn_label(SEEN, actions, None)
    unlabelled = curious.replay[-5:]
    assert len({row[:2] for row in unlabelled}) == 5 and not any(row.has_reward for row in unlabelled)
    assert curious.diagnostics()["oracle/labels"] == 0
    assert np.array_equal(curious.q_values(SEEN), values)


def test_of_equally_uncertain_questions_the_shortest_is_asked(experienced: FactoredAgent) -> None:
    learner = copy.deepcopy(experienced)
    learner.learn()
    fewest: dict[tuple[int, ...], int] = {}
    for length in (1, 2):
        for actions in itertools.product(range(ACTIONS), repeat=length):
            here = CODE
            for action in actions:
                here, *_ = fake_codes.step(here, action)
            fewest.setdefault(here, length)
    for goal, length in fewest.items():  # whatever leads to the goal is as uncertain as anything else that does
        learner.model.untested = lambda codes, following, goal=goal: 0.9 * (following == goal).all(axis=2)
        actions = learner.query(SEEN)
        assert actions is not None and len(actions) == length
    assert sorted(fewest.values()) == [1] * ACTIONS + [2] * 5


def test_queries_lead_where_the_dynamics_do(experienced: FactoredAgent) -> None:
    learner = copy.deepcopy(experienced)
    learner.learn()
    learner.learn_label(SEEN, np.array([0, 2, 1]), Label(-1.0, False))
    assert learner.replay[-1][:3] == ((1, 2, 1), 1, (0, 2, 1))
