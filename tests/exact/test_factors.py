"""The factor graph against the structure that machines were built with, and the cautious learner against counts."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from machines import Wheels, spec_of
from scipy import stats

from imagine_bench.exact import learner
from imagine_bench.exact.certificate import certificate, certificate_rows
from imagine_bench.exact.factors import factor_graph, machine
from imagine_bench.exact.learner import learn
from imagine_bench.interfaces import Outcome


@pytest.mark.parametrize(
    ("parameters", "facts"),
    [
        ({}, 3 * 2 * 4 + 2 * 4 + 3),
        ({"forbid": False}, 3 * 2 * 4 + 3),
        ({"slip": 0.1, "goal_change": 0.2}, 3 * 2 * 4 + 6 * 3 + 2 * 4 + 3),
        ({"n": 6}, 6 * 2 * 4 + 5 * 4 + 6),
    ],
    ids=str,
)
def test_facts_are_those_that_the_machine_was_built_of(parameters, facts):
    graph = factor_graph(machine(Wheels(**parameters)))
    assert (graph.facts, graph.width, graph.read) == (facts, 2, "next")
    assert all(factor.children == factor.parents for factor in graph.factors)


class _Coupled(Wheels):
    """A turn takes the next wheel along, or neither moves: they are drawn together."""

    def outcomes(self, state, action):
        found = []
        for outcome in super().outcomes(state, action):
            wheel = action // 2
            if outcome.macrostate[:-1] == state[:-1]:
                found.append(outcome)
            else:
                after, next_ = list(outcome.macrostate), (wheel + 1) % self.n
                after[next_] = (after[next_] + 1) % 4
                found.append(self.judge(state, action, tuple(after), outcome.probability))
        return tuple(found)


class _Toll(Wheels):
    """To turn a wheel back costs 2 more, whatever that leads to."""

    def judge(self, state, action, reached, share=1.0):
        found = super().judge(state, action, reached, share)
        return dataclasses.replace(found, reward=found.reward - 2.0 * (action % 2))


@pytest.mark.parametrize(
    ("slip", "scopes"),
    [(0.0, ("wheel 0, action", "action", "wheel 0")), (0.25, ("wheel 0, wheel 0 then", "action", "wheel 0 then"))],
)
def test_a_reward_that_the_choice_decides_is_read_from_it(slip, scopes):
    """One wheel: of six entries and three conditions. If it may slip, the choice alone does not tell where it leads."""
    found = certificate(spec_of(_Toll(n=1, slip=slip), 5))
    classes = ("+48, success", "-3", "+50, success", "-1")
    assert found.outcomes == tuple(zip(classes, (*scopes, "otherwise"), strict=True))
    assert (found.facts, found.width, found.random, found.plan_lengths) == (9, 2, slip > 0, ((1, 2), (2, 1)))
    assert slip or found.optimal_return == pytest.approx((48 + 49 + 50) / 3)


class _Reordered(Wheels):
    """The same outcomes, which half of the macrostates name in another order."""

    def outcomes(self, state, action):
        return super().outcomes(state, action)[:: 1 if sum(state) % 2 else -1]


def test_no_fact_depends_on_the_order_of_outcomes():
    parameters = {"slip": 0.1, "goal_change": 0.2}
    graph, again = (factor_graph(machine(kind(**parameters))) for kind in (Wheels, _Reordered))
    assert again.facts == graph.facts
    assert [(f.action, f.children, f.parents) for f in again.factors] == [
        (f.action, f.children, f.parents) for f in graph.factors
    ]


def test_what_is_drawn_together_is_one_factor():
    graph = factor_graph(machine(_Coupled(slip=0.3, forbid=False)))
    assert {(f.action, f.children, f.parents) for f in graph.factors if f.action < 2} == {
        (0, (0, 1), (0, 1)),
        (1, (0, 1), (0, 1)),
    }
    sure = factor_graph(machine(_Coupled(forbid=False)))
    assert [f.children for f in sure.factors if f.action == 0] == [(0,), (1,)]


@pytest.mark.parametrize("parameters", [{}, {"slip": 0.3}, {"goal_change": 0.3}], ids=str)
def test_a_learner_that_is_done_has_seen_what_it_needs(parameters):
    """A transition shows at most one entry of the dynamics a wheel, so that there is a bound from below."""
    rules = Wheels(**parameters)
    full = machine(rules)
    graph = factor_graph(full)
    runs = [learn(full, graph, 12, np.random.default_rng(seed)) for seed in range(3)]
    assert all(run.done and run.facts <= graph.facts for run in runs)
    assert all(run.episodes <= run.transitions for run in runs)
    assert min(run.transitions for run in runs) >= 24 * 0.7
    again = learn(full, graph, 12, np.random.default_rng(0))
    assert again == runs[0]


def test_the_cost_of_learning_is_a_mean_with_standard_error():
    rules = Wheels(n=2)
    cost, full = certificate(spec_of(rules, 8)).learning_cost, machine(rules)
    runs = [learn(full, factor_graph(full), 8, np.random.default_rng(seed)) for seed in range(cost.learners)]
    needed = [run.transitions for run in runs]
    assert cost.transitions == pytest.approx(np.mean(needed))
    assert cost.standard_error == pytest.approx(stats.sem(needed)) and cost.standard_error > 0.0
    assert cost.episodes == pytest.approx(np.mean([run.episodes for run in runs]))


class _Doors(Wheels):
    """Many starts, from each of which both actions succeed at once."""

    n_actions = 2

    @property
    def start_states(self):
        return [(start, 1) for start in range(1, self.n)]

    def outcomes(self, state, action):
        return (Outcome(1.0, (0, 0), 1.0, terminated=True, success=True),)


@pytest.mark.parametrize(("starts", "learners"), [(900, 10), (1500, 6), (6000, 2)])
def test_many_pairs_have_fewer_learners_behind_their_cost(starts, learners, capsys):
    """20,000 pairs of macrostate and action in all, but two to ten learners; here each is done after one transition."""
    spec = dataclasses.replace(spec_of(Wheels(n=1), 5), rules=_Doors(n=starts + 1))
    cost = certificate(spec).learning_cost
    assert (cost.learners, cost.transitions, cost.episodes, cost.standard_error) == (learners, 1.0, 1.0, 0.0)
    told = "The exact facts of wheels are computed, about 4 s.\n" if starts > 5000 else ""
    assert capsys.readouterr().err == told


class _Lottery(Wheels):
    """Nothing but luck ends an episode."""

    def outcomes(self, state, action):
        return (self.judge(state, action, (0, 0), 1e-7), self.judge(state, action, (1, 0), 1 - 1e-7))


def test_a_learner_that_gives_up_has_no_cost():
    found = certificate(spec_of(_Lottery(n=1), 200))
    assert found.learning_cost is None and 0.0 < found.optimum < 1e-4
    assert "cautious" not in certificate_rows(found)


def test_a_world_without_a_plan_says_so():
    class Hopeless(Wheels):
        def judge(self, state, action, reached, share=1.0):
            return dataclasses.replace(super().judge(state, action, reached, share), success=False)

    found = certificate(spec_of(Hopeless(n=2), 5))
    assert found.learning_cost is None and found.optimum == 0.0
    assert certificate_rows(found)["shortest plans"] == "none; none from 18 starts"


def test_a_learner_looks_no_further_than_its_episode_goes_on(monkeypatch):
    full, left = machine(Wheels(n=2)), []
    choose = learner.CautiousLearner.choose

    def look(self, row, most, rng):
        left.append(most)
        return choose(self, row, most, rng)

    monkeypatch.setattr(learner.CautiousLearner, "choose", look)
    run = learner.learn(full, factor_graph(full), 3, np.random.default_rng(0))
    assert len(left) == run.transitions and left.count(3) == run.episodes
    assert all(later in {now - 1, 3} for now, later in pairwise(left)) and min(left) == 1
