"""Tables by reachability, the optimum within a horizon and shortest plans, against solvers written plainly here."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from machines import Wheels

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome
from imagine_bench.rules import (
    evaluate,
    facts,
    fewest_actions,
    horizon_optimum,
    optimal_policy,
    shortest_plans,
    states_of,
    tabulate,
)

TASKS = ["arrow_puzzle", "arrow_puzzle_hard", "pick_place"]


class _Unlisted:
    """The same rules without their list of macrostates."""

    states = None

    def __init__(self, rules):
        self.n_actions, self.start_states, self.outcomes = rules.n_actions, rules.start_states, rules.outcomes


@pytest.mark.parametrize("name", TASKS)
def test_reached_macrostates_stand_in_for_listed_ones(name):
    spec = registry.task(name)
    bare = _Unlisted(spec.rules)
    assert facts(bare, spec.horizon) == facts(spec.rules, spec.horizon)
    assert set(states_of(bare)) <= set(states_of(spec.rules))
    listed, reached = tabulate(spec.rules), tabulate(bare)
    best = dict(zip(listed.index, optimal_policy(listed).tolist(), strict=True))
    for state, action in zip(reached.index, optimal_policy(reached).tolist(), strict=True):
        assert spec.rules.is_terminal(state) or action == best[state]


def _plainly(rules, horizon):
    """The largest success probability from each start, by recursion over outcomes."""

    @cache
    def best(state, left):
        if left == 0:
            return 0.0
        return max(
            sum(o.probability * (o.success if o.terminated else best(o.macrostate, left - 1)) for o in outcomes)
            for outcomes in (rules.outcomes(state, action) for action in range(rules.n_actions))
        )

    return [best(state, horizon) for state in rules.start_states]


@pytest.mark.parametrize(
    "parameters", [{}, {"slip": 0.3}, {"goal_change": 0.4}, {"slip": 0.2, "goal_change": 0.1, "n": 2}], ids=str
)
@pytest.mark.parametrize("horizon", [1, 2, 6])
def test_the_horizon_optimum_is_that_of_plain_recursion(parameters, horizon):
    rules = Wheels(**parameters)
    tables = tabulate(rules)
    found = horizon_optimum(tables, horizon)
    np.testing.assert_allclose(found.success[tables.starts], _plainly(rules, horizon), atol=1e-12)


def test_a_policy_is_worth_what_plain_recursion_says():
    """Success, failure, return and length."""
    rules, horizon = Wheels(n=2, slip=0.2, goal_change=0.1), 4
    tables = tabulate(rules)
    policy = np.random.default_rng(0).dirichlet(np.ones(rules.n_actions), len(tables.index)).T

    @cache
    def values(state, left):
        found = np.zeros(4)
        for action in range(rules.n_actions) if left else ():
            for o in rules.outcomes(state, action):
                after = (o.success, not o.success, 0, 0) if o.terminated else values(o.macrostate, left - 1)
                share = policy[action, tables.index[state]] * o.probability
                found += share * np.add((0, 0, o.reward, 1), after)
        return found

    found = evaluate(tables, policy, horizon)
    columns = np.stack([found.success, found.failure, found.returns, found.length], axis=1)
    np.testing.assert_allclose(columns[tables.starts], [values(start, horizon) for start in rules.start_states])


def test_shortest_plans_are_those_of_a_search():
    for rules in (Wheels(), Wheels(slip=0.5), Wheels(n=2, goal_change=0.5), registry.task("arrow_puzzle_hard").rules):
        tables = tabulate(rules)
        lengths = shortest_plans(tables)[tables.starts]
        assert lengths.tolist() == [fewest_actions(rules, start) for start in rules.start_states]


class _Stuck(Wheels):
    def judge(self, state, action, reached, share=1.0):
        return Outcome(share, reached, 0.0, terminated=False, success=False)


def test_no_plan_is_said_and_a_missing_macrostate_is_named():
    tables = tabulate(_Stuck(n=1))
    assert shortest_plans(tables).tolist() == [-1] * 4

    class Short(_Unlisted):
        states = ((1, 0), (2, 0))

    with pytest.raises(InvalidValueError, match=r"Action 1 in macrostate \(1, 0\) leads to \(0, 0\); list it, too."):
        tabulate(Short(Wheels(n=1)))


@pytest.mark.slow
def test_25_000_macrostates_take_seconds():
    """24,576 macrostates and 12 actions: 10 CPU s and 500 MB are allowed."""
    import resource
    import time

    rules, start_s = Wheels(n=6, forbid=False), time.process_time()
    known = facts(rules, 20)
    assert time.process_time() - start_s < 10.0 and known.optimum == 1.0
    assert len(states_of(rules)) == 24_576
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 1_000_000  # of the whole session of tests, kB
