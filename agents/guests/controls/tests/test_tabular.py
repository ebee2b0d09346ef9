"""Agents with a table of counts: values against enumeration and by hand, chance, exploration, episodes, snapshots."""

from __future__ import annotations

from dataclasses import replace

import fake_codes
import numpy as np
import pytest
from fake_codes import ACTIONS, frame, live, starts
from fake_pictures import played
from imagine_bench_controls.tabular.agent import ReadState, read_codes, read_macrostate
from imagine_bench_controls.tabular.count_table import CodeCountTableAgent, CountTableAgent
from imagine_bench_controls.tabular.counts import CountTable
from imagine_bench_controls.tabular.dyna_q import DynaQAgent
from imagine_bench_controls.tabular.own import OwnCountTableAgent
from imagine_bench_controls.tabular.posterior_sampling import PosteriorSamplingAgent
from imagine_bench_controls.tabular.settings import DYNA_Q, HYPERPARAMETERS, OWN, POSTERIOR_SAMPLING
from imagine_bench_factored.perception import CodePerception

from imagine_bench import registry, rules
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation, Transition
from imagine_bench.seeding import SeedTree

PERCEPTION = CodePerception(fake_codes.FakeCodes(), factored=False)  # type: ignore[arg-type]
CODES = read_codes(PERCEPTION)
BLANK = np.zeros((64, 64, 3), dtype=np.uint8)


def at(state: int) -> Observation:
    """The macrostate (state,), in a frame that says nothing."""
    return Observation(frame=BLANK, macrostate=np.array([state]))


def moved(state: int, action: int, reward: float, then: int, *, ended: bool = False, cut: bool = False) -> Transition:
    return Transition(
        observation=at(state), action=action, reward=reward, next_observation=at(then), terminated=ended, truncated=cut
    )


def dyna_q(
    planning: int, step_size: float = 0.5, *, read: ReadState = read_macrostate, seed: int = 0, **controller: float
) -> DynaQAgent:
    own = {f"controller.{name}": value for name, value in controller.items()}
    own |= {"table.planning_steps": planning, "table.step_size": step_size}
    return DynaQAgent(read, ACTIONS, DYNA_Q.resolve("fast", own, "chapter_5"), SeedTree(seed))


def sampler(seed: int = 0) -> PosteriorSamplingAgent:
    settings = POSTERIOR_SAMPLING.resolve("fast", {}, "chapter_5")
    return PosteriorSamplingAgent(read_macrostate, 2, settings, SeedTree(seed))


# The table -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])
def test_a_complete_table_has_the_exact_values(task: str) -> None:
    """Outcomes of chance are counted in proportion to their probabilities, so the counts are the rules."""
    spec = registry.task(task)
    index = {state: i for i, state in enumerate(spec.rules.states)}
    going_on = {i: state for state, i in index.items() if not spec.rules.is_terminal(state)}
    table = CountTable(spec.n_actions)
    for i, state in going_on.items():
        for action in range(spec.n_actions):
            for outcome in spec.rules.outcomes(state, action):
                for _ in range(round(outcome.probability * 360)):
                    table.add(i, action, index[outcome.macrostate], outcome.reward, outcome.terminated)
    exact = rules.optimal_values(rules.tabulate(spec.rules)).max(axis=0)
    found = table.action_values(1.0, untried=0.0)
    np.testing.assert_allclose([found[i].max() for i in going_on], exact[list(going_on)], atol=1e-3)


def test_a_chance_outcome_has_its_mean_value_until_new_counts() -> None:
    table = CountTable(2)
    assert table.action_values(0.5, untried=9.0) == {}
    assert table.add(5, 0, 5, -1.0, False)
    assert not table.add(5, 0, 5, -1.0, False), "a certain transition seen again"
    assert table.largest_reward == 0.0
    outcomes = [(8, 4.0, False), *[(7, 0.0, True)] * 3]
    assert all([table.add(7, 0, *outcome) for outcome in outcomes])
    values = table.action_values(0.5, untried=8.0)
    assert values[8].tolist() == [8.0, 8.0]
    assert values[7].tolist() == pytest.approx([(4.0 + 0.5 * 8.0) / 4, 8.0])
    assert (table.states, table.pairs, table.largest_reward) == (3, 2, 4.0)


@pytest.mark.parametrize("concentration", [0.5, 2.0])
def test_the_posterior_is_the_dirichlet_of_the_counts(concentration: float) -> None:
    """A pair seen to pay 1 thrice and 0 once, where a prior draw pays either: mean and variance by hand."""
    table = CountTable(1)
    for reward in (1.0, 1.0, 1.0, 0.0):
        table.add(0, 0, 0, reward, True)
    rng = np.random.default_rng(0)
    drawn = np.array([table.sampled_values(0.9, concentration, rng)[0][0] for _ in range(2_000)])
    # p + w b with (p, 1 - p - w, w) ~ Dirichlet(3, 1, c), b ~ Bernoulli(1/2): given b, Beta(3 + c b, 1 + c (1 - b))
    total = 4.0 + concentration
    first = {b: (3.0 + concentration * b) / total for b in (0, 1)}
    second = {b: first[b] * (3.0 + concentration * b + 1.0) / (total + 1.0) for b in (0, 1)}
    mean = (first[0] + first[1]) / 2
    assert drawn.mean() == pytest.approx(mean, abs=0.015)
    assert drawn.var() == pytest.approx((second[0] + second[1]) / 2 - mean**2, abs=0.006)


def test_what_was_never_tried_may_be_anything_that_was_seen() -> None:
    table = CountTable(2)
    rng = np.random.default_rng(0)
    assert table.sampled_values(0.9, 0.1, rng) == {}
    table.add(0, 0, 1, 4.0, True)
    table.add(1, 0, 0, -2.0, True)
    untried = np.array([table.sampled_values(0.9, 0.1, rng)[0][1] for _ in range(400)])
    assert set(untried.round(6)) == {4.0, -2.0}
    assert abs(np.mean(untried > 0) - 0.5) < 0.1


# Agents --------------------------------------------------------------------------------------------------------------


def test_directed_exploration_ends_in_greedy_actions() -> None:
    settings = HYPERPARAMETERS.resolve("fast", {}, "chapter_5")
    learner = CodeCountTableAgent(PERCEPTION, ACTIONS, settings, SeedTree(0), directed=True)
    live(learner, range(200), np.random.default_rng(1))
    assert learner.table.pairs == len(starts()) * ACTIONS
    for code in starts():
        seen = Observation(frame=frame(code))
        values = learner.q_values(seen)
        assert values[learner.act(seen, explore=True)] == pytest.approx(values.max())
    assert fake_codes.success(learner) == 1.0


def test_an_action_has_as_many_expected_outcomes_as_were_seen() -> None:
    """Half of the time the second wheel turns on, a quarter back, which ends it or does not."""
    settings = HYPERPARAMETERS.resolve("fast", {}, "chapter_5")
    learner, here = CodeCountTableAgent(PERCEPTION, ACTIONS, settings, SeedTree(0), directed=False), (0, 1, 0)
    for then, reward, ended in (((0, 2, 0), 4.0, False), ((0, 0, 0), -4.0, True), ((0, 0, 0), 0.0, False)) * 3:
        next_observation = Observation(frame=frame(then))
        one = replace(
            fake_codes.transition(here, 2), next_observation=next_observation, reward=reward, terminated=ended
        )
        for _ in range(1 + (reward > 0.0)):
            learner.observe(one, episode=0)
    frames = np.stack([frame((2, 0, 1)), frame(here)])
    told = learner.predict_outcomes(frames, np.random.default_rng(0))
    branches = told.p_continues[:, 2].tolist(), told.macrostates[1, 2].tolist()
    assert branches == ([[0.0, 0.0], [0.5, 0.25]], [[0, 2, 0], [0, 0, 0]]) and told.p_continues.sum() == 0.75
    assert told.reward.tolist() == [[0.0] * 4, [0.0, 0.0, 1.0, 0.0]]


@pytest.mark.parametrize(("discount", "best"), [(0.5, 10.0), (1.0, 5000.0)])
def test_what_is_untried_is_worth_the_best_return_to_who_explores(discount: float, best: float) -> None:
    settings = HYPERPARAMETERS.resolve("fast", {"controller.discount": discount}, "chapter_5")
    learner = CountTableAgent(read_macrostate, 2, settings, SeedTree(0), directed=True)
    learner.observe(moved(0, 0, 5.0, 1, ended=True), episode=0)
    explored, tested = ([learner.values(at(state), explore=how).tolist() for state in (0, 7)] for how in (True, False))
    assert explored == [[5.0, best], [best, best]] and tested == [[5.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_epsilons_do_not_change_directed_exploration(value: float) -> None:
    """So no bench of such an agent takes one."""
    both = ({}, {f"controller.epsilon_{name}": value for name in ("min", "max", "decay")})
    settings = [HYPERPARAMETERS.resolve("fast", own, "chapter_5") for own in both]
    learners = [CodeCountTableAgent(PERCEPTION, ACTIONS, each, SeedTree(0), directed=True) for each in settings]
    first, second = (live(learner, range(20), np.random.default_rng(1)) for learner in learners)
    assert first == second
    for agent in ("count_table_directed", "count_table_own", "elimination", "posterior_sampling"):
        assert registry.inert_settings(agent) == both[1].keys()
    assert not registry.inert_settings("count_table")


def test_every_transition_is_counted_once_however_often_it_sees_anew() -> None:
    """And a table that was counted anew is planned anew."""
    learner, restored = (OwnCountTableAgent(ACTIONS, OWN.resolve("fast", {}, "chapter_5"), SeedTree(0)) for _ in "ab")
    lived, sights = 0, set()
    for episode in range(8):
        for transition in played(None, np.random.default_rng(episode)):
            learner.observe(transition, episode=episode)
            lived += 1
            assert learner.table.arrays()["count"].sum() == lived
            sights.add(learner.diagnostics()["perception/looked_at"])
    assert len(sights) > 2
    assert sum(learner.perception.begins) == 8, "the first of each episode"
    before = learner.q_values(transition.observation)
    learner._happened = [(reward + 1.0, ended) for reward, ended in learner._happened]
    learner._recount()
    restored.restore(learner.state())
    after = learner.q_values(transition.observation)
    assert before.tolist() != after.tolist() == restored.q_values(transition.observation).tolist()


def test_q_learning_updates_as_by_hand() -> None:
    """Equation 2.16 with alpha 1/2, gamma 0.8; truncation bootstraps, termination does not."""
    learner = dyna_q(0, discount=0.8)
    learner.observe(moved(1, 2, 10.0, 2, cut=True), episode=0)  # 0 + (10 + 0.8 * 0 - 0) / 2 = 5
    learner.observe(moved(0, 3, -1.0, 1, cut=True), episode=0)  # 0 + (-1 + 0.8 * 5 - 0) / 2 = 1.5
    learner.observe(moved(0, 3, -1.0, 1, ended=True), episode=0)  # 1.5 + (-1 - 1.5) / 2 = 0.25
    assert {state: values.tolist() for state, values in learner.q.items()} == {1: [0, 0, 5, 0], 0: [0, 0, 0, 0.25]}
    assert learner.diagnostics()["loss/bellman"] == pytest.approx((10.0**2 + 3.0**2 + 2.5**2) / 3)


def test_one_plan_is_one_update_of_a_pair_that_was_tried() -> None:
    learner = dyna_q(3)
    learner.observe(moved(1, 2, 8.0, 2, ended=True), episode=0)
    assert learner.q[1].tolist() == [0.0, 0.0, 8.0 - 8.0 / 2**4, 0.0], "one real update and three planned"


@pytest.mark.parametrize(("planning", "values"), [(0, [0.0, 0.0, 5.0]), (300, [10.0 * 0.9**2, 9.0, 10.0])])
def test_planning_finds_what_one_walk_alone_does_not(planning: int, values: list[float]) -> None:
    """A chain of three macro-actions; the last one pays 10."""
    learner = dyna_q(planning, discount=0.9)
    for state in range(3):
        learner.observe(moved(state, 0, 10.0 * (state == 2), state + 1, ended=state == 2), episode=0)
    assert [learner.q[state][0] for state in range(3)] == pytest.approx(values)


def test_what_chance_decides_is_planned_by_its_mean() -> None:
    """One of four tests paid 8: planning goes to the mean 2, not to the last test's 0 nor to 8."""
    learner = dyna_q(400, 0.01)
    for reward in (8.0, 0.0, 0.0, 0.0):
        learner.observe(moved(0, 1, reward, 1, ended=True), episode=0)
    assert learner.q[0][1] == pytest.approx(2.0, abs=0.75)


@pytest.mark.parametrize(("epsilon", "best"), [(0.0, [1.0, 0.0, 1.0, 0.0]), (0.6, [0.0, 0.0, 1.0, 0.0])])
def test_exploration_draws_among_equals_and_only_those(epsilon: float, best: list[float]) -> None:
    learner = dyna_q(0, epsilon_min=epsilon, epsilon_max=epsilon)
    learner.q[0] = np.array(best)
    taken = np.bincount([learner.act(at(0), explore=True) for _ in range(2000)], minlength=4) / 2000
    share = (1 - epsilon) / sum(best) * np.array(best) + epsilon / 4
    np.testing.assert_allclose(taken, share, atol=0.05)
    assert learner.act(at(0), explore=False) == np.argmax(best)


def test_each_reading_sees_its_own_state_alone() -> None:
    shown = Observation(frame=frame((2, 1, 0)), macrostate=np.array([3, 1]))
    assert read_macrostate(shown) == 3 + 64 * 1
    assert CODES(shown) == CODES(Observation(frame=shown.frame)) == np.ravel_multi_index((2, 1, 0), (3, 3, 2))
    with pytest.raises(InvalidValueError, match=r"reads the true state, of at most 10 .* was shown none"):
        read_macrostate(Observation(frame=shown.frame))


def test_a_restored_table_plans_anew() -> None:
    """What it planned before is of other counts."""
    learner, other = sampler(), sampler()
    learner.observe(moved(0, 1, 5.0, 1, ended=True), episode=0)
    other.observe(moved(0, 0, 7.0, 1, ended=True), episode=0)
    assert [each.act(at(0), explore=False) for each in (learner, other)] == [1, 0]
    other.restore(learner.state())
    assert other.act(at(0), explore=False) == 1


def test_posterior_sampling_keeps_one_model_for_an_episode() -> None:
    learner = sampler()
    learner.observe(moved(0, 0, 1.0, 1, cut=True), episode=0)
    first = learner.values(at(0), explore=True)
    learner.observe(moved(0, 1, 5.0, 1), episode=1)
    assert np.array_equal(learner.values(at(0), explore=True), first), "news wait for the next episode"
    learner.observe(moved(1, 1, 0.0, 0, cut=True), episode=1)
    assert not np.array_equal(learner.values(at(0), explore=True), first)
