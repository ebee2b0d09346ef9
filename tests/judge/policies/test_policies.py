"""Policies in a model and in the truth: ranks, lift and exploits are those of brute force and of the rules."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from unittest import mock

import numpy as np
import pytest
from imagine_bench.agents.world_models.limits import Exact
from judged import STILL, Altered, judged_world
from scipy.stats import kendalltau

from imagine_bench import registry
from imagine_bench.arrays import Floats
from imagine_bench.exact.values import NEVER, Model, values_of_planning
from imagine_bench.interfaces import Outcome, State
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge.policies import levels
from imagine_bench.judge.policies.agreement import DenseModel, kendall, pearson, values_of
from imagine_bench.judge.policies.exploit import largest_exploit, upper_bound
from imagine_bench.judge.policies.film import Expected, Film, course
from imagine_bench.judge.policies.levels import SCORES, counted_table, level_scores, without_model
from imagine_bench.judge.policies.policy_set import PolicyWorld, policy_world
from imagine_bench.judge.policies.training import AGENTS, trained
from imagine_bench.judge.scores import policy_scores
from imagine_bench.report.judge import COLUMNS
from imagine_bench.report.levels import LEVELS
from imagine_bench.rules import evaluate, horizon_optimum, states_of_play, tabulate
from imagine_bench.seeding import SeedTree

ARROWS, SLIPS = "arrows:cubes=2", "arrows:cubes=2,slip=0.2"
WORLDS = pytest.mark.parametrize("task", [ARROWS, SLIPS, "pick_place"])


@functools.cache
def world_of(task: str) -> PolicyWorld:
    spec = judged_world(task).spec
    found = policy_world(spec, judged_world(task).one_step.macrostates)
    assert found is not None
    return found


def scores_of(task: str, model: WorldModel) -> tuple[dict[str, float], Film | None]:
    judged = judged_world(task)
    predictions = judged.predictions(model, judged.one_step)
    return policy_scores(world_of(task), judged.one_step, predictions, judged.spec.rules, None, SeedTree(0))


# Ranks -------------------------------------------------------------------------------------------------------------


def test_rank_correlation_is_tau_b_and_r_that_of_standard_scores() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        one, other = rng.integers(0, 5, size=(2, 12)).astype(float)
        assert kendall(one, other) == pytest.approx(kendalltau(one, other).statistic)
        rounded = one + 1e-12 * rng.random(12)
        assert kendall(rounded, other) == pytest.approx(kendall(one, other)), "rounding parts no pair"
        scores = [(row - row.mean()) / row.std() for row in (one, other)]
        assert pearson(one, other) == pytest.approx(np.mean(scores[0] * scores[1]))
    assert all(math.isnan(correlation(np.ones(3), np.arange(3.0))) for correlation in (kendall, pearson))


@WORLDS
def test_policies_of_a_world_are_many_different_and_fixed(task: str) -> None:
    world, again = world_of(task), policy_world(registry.task(task), states_of_play(registry.task(task).rules))
    names, tables = world.policies
    assert again is not None and again.policies.digest == world.policies.digest
    assert 20 <= len(names) == len(set(names)) <= 50 and len(np.unique(tables.round(6), axis=0)) >= 20
    assert tables.min() >= 0.0 and tables.sum(axis=2) == pytest.approx(1.0)
    assert len({world_of(each).policies.digest for each in (ARROWS, SLIPS, "pick_place")}) == 3
    real = dict(zip(names, world.real, strict=True))
    assert real["optimal"] == max(world.real) and real["worst"] < real["uniform"] < real["optimal"]


@WORLDS
def test_values_in_the_truth_are_those_of_the_rules(task: str) -> None:
    """By another way: the sparse tables of the rules."""
    world, spec = world_of(task), judged_world(task).spec
    tables = tabulate(spec.rules)
    rows = [tables.index[state] for state in world.states]
    for table, real in zip(world.policies.tables, world.real, strict=True):
        policy = np.full(tables.reward.shape, 1.0 / spec.n_actions)
        policy[:, rows] = table.T
        assert evaluate(tables, policy, spec.horizon).returns[tables.starts].mean() == pytest.approx(real)


@WORLDS
def test_exact_ranks_as_the_truth_does_and_is_not_exploited(task: str) -> None:
    judged = judged_world(task)
    found, film = scores_of(task, Exact(judged.spec, judged.index))
    for kind in ("", "_ruled"):
        assert (found[f"policy_r{kind}"], found[f"policy_tau{kind}"]) == (pytest.approx(1.0), 1.0)
        for name in ("policy_error", "exploit", "exploit_bound"):
            assert found[name + kind] == pytest.approx(0.0, abs=1e-9)
    assert film is None, "nothing is overrated"


def test_copy_overrates_just_what_enumeration_says() -> None:
    """It believes that each macro-action costs a step and changes nothing; the worst is to break a rule at the end."""
    judged, horizon = judged_world(ARROWS), world_of(ARROWS).horizon
    rules = judged.spec.rules
    found, film = scores_of(ARROWS, STILL)
    costs = {rules.judge(state, action, state).reward for state, action in judged.one_step.pairs}
    assert costs == {-1.0}

    @functools.cache
    def worst(state: State, left: int) -> float:
        def after(o: Outcome) -> float:
            return o.probability * (o.reward + (0.0 if o.terminated or left == 1 else worst(o.macrostate, left - 1)))

        return min(sum(map(after, rules.outcomes(state, action))) for action in range(rules.n_actions))

    gaps = {start: -horizon - worst(start, horizon) for start in rules.start_states}
    assert found["exploit_ruled"] == pytest.approx(np.mean(list(gaps.values()))) == found["exploit_bound_ruled"]
    assert film is not None and gaps[film.start] == max(gaps.values()) > 0.0
    assert film.returns == pytest.approx((-horizon, worst(film.start, horizon)))
    assert [step.outcome.reached for step in film.believed] == [film.start] * horizon
    assert film.real[-1].outcome.over and sum(step.outcome.reward for step in film.real) == film.returns[1]
    world = world_of(ARROWS)
    assert found["policy_error_ruled"] == pytest.approx(np.abs(-horizon - world.real).mean())
    assert math.isnan(found["policy_r_ruled"]) and math.isnan(found["policy_tau_ruled"]), "all are worth the same"
    assert all(math.isnan(found[name]) for name in SCORES), "it predicts no rewards"


def hopeful(found: Imagined, *_: object) -> Imagined:
    return dataclasses.replace(found, rewards=np.asarray(found.rewards) + 1.0)


def test_a_film_shows_the_outcomes_that_a_model_imagines() -> None:
    """Of one that imagines the right macrostates, and expects a reward that is too large by 1."""
    judged = judged_world(ARROWS)
    found, film = scores_of(ARROWS, Altered(judged, hopeful))
    assert film is not None and len(film.real) == world_of(ARROWS).horizon
    expected = [(action, outcome._replace(reward=outcome.reward + 1.0)) for action, outcome in film.real]
    assert list(film.believed) == expected
    assert len({step.outcome.reached for step in film.real} | {film.start}) > 1
    assert film.returns[0] - film.returns[1] == pytest.approx(found["exploit"]) == len(film.real)


def test_a_film_begins_at_a_start_and_shows_the_likeliest_outcomes() -> None:
    """Of two frames that a model reads differently it shows the likeliest of both."""
    judged = judged_world(SLIPS)

    def half_blind(found: Imagined, *_: object) -> Imagined:
        weights = np.array(found.probabilities)
        weights[1::2] = weights[1::2] == weights[1::2].min(axis=1, keepdims=True)  # in each second frame all slip
        return hopeful(dataclasses.replace(found, probabilities=weights))

    _, film = scores_of(SLIPS, Altered(judged, half_blind))
    assert film is not None and {step.outcome.reached for step in film.believed} == {film.start}
    state = film.start
    for action, outcome in film.real:
        likely = next(o for o in judged.spec.rules.outcomes(state, action) if o.probability == 0.8)
        assert outcome == (likely.macrostate, likely.reward, likely.terminated)
        state = outcome.reached
    there = judged_world("pick_place")
    _, film = scores_of(there.spec.id, Altered(there, hopeful))
    assert film is not None and film.start in there.spec.rules.start_states


def test_no_level_lacks_a_score_and_no_score_a_column() -> None:
    assert [level.name for level in LEVELS] == [f"L{number}" for number in range(8)]
    measures = {name for level in LEVELS for name in level.measures}
    assert measures | {f"{name}{kind}" for name in SCORES for kind in ("", "_ruled")} <= COLUMNS.keys()


# Exploits ----------------------------------------------------------------------------------------------------------


def random_model(rng: np.random.Generator, states: int, actions: int) -> DenseModel:
    """Some macro-actions end the episode more often than others."""
    onward = rng.dirichlet(np.full(states + 1, 0.5), size=(states, actions))[..., :-1]
    return DenseModel(onward, rng.normal(size=(states, actions)))


def by_recursion(model: DenseModel, plan: Floats, state: int, left: int) -> float:
    """The return of a plan (H, S), one macro-action after another."""
    if not left:
        return 0.0
    action = int(plan[left - 1, state])
    onward = [p * by_recursion(model, plan, after, left - 1) for after, p in enumerate(model.onward[state, action])]
    return float(model.reward[state, action]) + sum(onward)


@pytest.mark.parametrize(("states", "actions", "horizon"), [(2, 2, 2), (2, 3, 2), (3, 2, 2), (1, 3, 3)])
def test_exploits_lie_between_those_of_every_plan_and_the_bound(states: int, actions: int, horizon: int) -> None:
    """Every deterministic plan, tried; the search finds the best one, and the bound is above it."""
    rng = np.random.default_rng(states)
    starts = rng.dirichlet(np.ones(states))
    for _ in range(3):
        model, truth = (random_model(rng, states, actions) for _ in range(2))
        gaps = []
        for choice in itertools.product(range(actions), repeat=states * horizon):
            plan = np.array(choice).reshape(horizon, states)
            values = [[by_recursion(each, plan, state, horizon) for state in range(states)] for each in (model, truth)]
            gaps.append(float(starts @ (np.array(values[0]) - values[1])))
        policies = np.full((4, states, actions), 1.0 / actions)
        found = largest_exploit(model, truth, starts, policies, horizon, rng)
        bound = float(starts @ upper_bound(model, truth, horizon))
        assert starts @ (found.believed - found.real) == pytest.approx(max(gaps)) and max(gaps) <= bound + 1e-9
        for values, each in ((found.believed, model), (found.real, truth)):
            again = [by_recursion(each, found.plan, state, horizon) for state in range(states)]
            assert values == pytest.approx(again)


def test_the_search_for_exploits_begins_with_the_given_policies() -> None:
    """The overrated way costs one at first; no decision alone leads to it from drawn plans or the model's best one."""
    onward = np.zeros((2, 3, 2))
    onward[0, 1, 1] = 1.0
    model = DenseModel(onward, np.array([[0.0, -1.0, 10.0], [0.0, 5.0, 6.0]]))
    truth = DenseModel(onward, np.array([[0.0, 0.0, 10.0], [0.0, 0.0, 6.0]]))
    starts = np.array([1.0, 0.0])
    luckless = mock.Mock(integers=lambda high, size: np.zeros(size, dtype=np.int64))
    for policy, overrating in (([1, 1], 4.0), ([0, 0], 0.0)):
        found = largest_exploit(model, truth, starts, np.eye(3)[policy][None], 2, luckless)
        assert starts @ (found.believed - found.real) == pytest.approx(overrating)


def test_the_largest_exploit_is_that_from_the_starts() -> None:
    """The first policy is overrated most where no start leads to, by 10 a macro-action; from the start, by 2 in all."""
    onward = np.zeros((3, 2, 3))
    onward[0, 0, 1] = onward[0, 1, 0] = onward[2, :, 2] = 1.0
    model = DenseModel(onward, np.array([[0.0, 1.0], [0.0, 5.0], [10.0, 0.0]]))
    truth = DenseModel(onward, np.zeros((3, 2)))
    luckless = mock.Mock(integers=lambda high, size: np.ones(size, dtype=np.int64))
    policies = np.eye(2)[[[1, 0, 0], [0, 1, 1]]]
    found = largest_exploit(model, truth, np.array([1.0, 0.0, 0.0]), policies, 2, luckless)
    assert (found.believed - found.real)[0] == 5.0


@pytest.mark.parametrize(("reached", "over", "steps"), [((1,), False, 3), ((1,), True, 1), ((7,), False, 1)])
def test_a_course_ends_with_the_episode_the_plan_or_the_known_world(reached: State, over: bool, steps: int) -> None:
    plan = np.zeros((3, 2), dtype=np.int64)
    assert len(course((0,), plan, [(0,), (1,)], lambda state, action: Expected(reached, 0.0, over))) == steps


# Lift --------------------------------------------------------------------------------------------------------------


def test_planning_in_the_truth_earns_what_is_possible() -> None:
    world = world_of(ARROWS)
    tables = tabulate(judged_world(ARROWS).spec.rules)
    best_return = world.starts @ values_of_planning(world.truth, world.truth, world.horizon)
    assert best_return == pytest.approx(horizon_optimum(tables, world.horizon).returns[tables.starts].mean())


def test_a_table_holds_shares_of_outcomes_and_mean_rewards() -> None:
    """Of the first transitions of two episodes, across which none leads; one pair was tried twice, others NEVER.

    One frame shows no known macrostate: what follows it is not counted.
    """
    world = world_of(ARROWS)
    (one, other), width = world.states[:2], len(world.states)
    episodes = Episodes(
        lengths=np.array([3, 2]),
        frames=np.zeros((7, 64, 64, 3), dtype=np.uint8),
        action_masks=np.ones((7, world.truth.reward.shape[1]), dtype=np.int8),
        actions=np.array([2, 3, 1, 2, 3]),
        rewards=np.array([1.0, 9.0, 5.0, 4.0, 7.0]),
        terminated=np.arange(5) == 2,
        truncated=np.arange(5) == 4,
        success=np.zeros(2, dtype=bool),
    )
    unknown = (-1,) * len(one)
    table = counted_table(episodes, np.array([one, unknown, other, other, one, one, other]), 4, world)
    tried = {pair: table.reward[pair] for pair in zip(*np.nonzero(table.reward > NEVER), strict=True)}
    assert tried == {(0, 2): 2.5, (1, 1): 5.0} and table.reward.shape == world.truth.reward.shape
    assert table.following[0, 2].tolist() == list(range(width + 1))
    assert table.p_continues[0, 2, [0, -1]].tolist() == [0.5, 0.5] and table.p_continues.sum() == 1.0, "no end goes on"


@WORLDS
def test_agents_that_train_in_the_truth_are_as_good_as_its_best_plan(task: str) -> None:
    world = world_of(task)
    best = world.real[world.policies.names.index("optimal")]
    for episodes in ((world.starts, world.horizon), None):
        policies = trained(world.truth, np.random.default_rng(0), episodes)
        returns = values_of(world.dense_truth, policies, world.horizon) @ world.starts
        assert len(returns) == AGENTS and returns.mean() == pytest.approx(best, abs=0.1)


def test_imagined_episodes_begin_anew_at_the_horizon() -> None:
    """Three macrostates that nothing leaves, and no end: only new episodes let agents learn of all."""
    endless = Model(np.tile(np.arange(3)[:, None, None], (1, 2, 1)), np.ones((3, 2, 1)), np.tile([0.0, 1.0], (3, 1)))
    assert trained(endless, np.random.default_rng(0), (np.full(3, 1.0 / 3.0), 4))[..., 1].all()


def test_an_agent_on_data_tries_nothing_else() -> None:
    world = world_of(ARROWS)
    tried = np.random.default_rng(0).random(world.truth.reward.shape) < 0.4
    assert not tried.any(axis=1).all(), "somewhere nothing was tried"
    table = world.truth._replace(reward=np.where(tried, world.truth.reward, NEVER))
    chosen = trained(table, np.random.default_rng(0)) > 0
    assert not (chosen & ~tried)[:, tried.any(axis=1)].any()
    with_all = trained(world.truth, np.random.default_rng(0)) > 0
    assert (with_all & ~tried)[:, tried.any(axis=1)].any(), "where all was tried it chooses such macro-actions"


def test_training_in_a_wrong_model_earns_less_than_on_the_data() -> None:
    world = world_of(ARROWS)
    wrong = world.truth._replace(reward=-world.truth.reward)
    without = without_model(world, world.truth, np.random.default_rng(1))
    assert level_scores(world, wrong, without, np.random.default_rng(0))[0]["lift_trained"] < -20.0


def test_agents_train_once_on_the_data_of_a_model(monkeypatch: pytest.MonkeyPatch) -> None:
    judged, world = judged_world(ARROWS), world_of(ARROWS)
    trains_in = []

    def counted(model: Model, rng: np.random.Generator, episodes: tuple[Floats, int] | None = None) -> Floats:
        trains_in.append("data" if episodes is None else "model")
        return trained(model, rng, episodes)

    monkeypatch.setattr(levels, "trained", counted)
    predictions = judged.predictions(Exact(judged.spec, judged.index), judged.one_step)
    found, _ = policy_scores(world, judged.one_step, predictions, judged.spec.rules, world.truth, SeedTree(0))
    assert sorted(trains_in) == ["data", "model", "model"], "in the model by its own rewards, and by the rules'"
    assert abs(found["lift_trained"]) < 0.1 and abs(found["lift_trained_ruled"]) < 0.1
