"""Rewards that chance changes: their classes, and that exact rewards have none."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import fake_codes
import numpy as np
import pytest
from fake_pictures import agent, played
from imagine_bench_factored.agent import FactoredAgent
from imagine_bench_factored.factors import CodeTransition
from imagine_bench_factored.learned import LearnedPerceptionAgent
from imagine_bench_factored.rewards import EXACT, reward_classes

from imagine_bench.interfaces import AgentState, Observation
from imagine_bench.testing.checks import same_state

RULED = ((-1.0, False), (-1.0, False), (-1.0, False), (-5.0, True), (-5.0, True), (50.0, True))
PICKS = ((0.0, False), (1.0, False), (-5.0, True), (5.0, True))


def rows(
    count: int, *, outcomes: Sequence[tuple[float, bool]] = RULED, codes: int = 12, std: float = 0.0, step: float = 0.0
) -> list[CodeTransition]:
    """Transitions whose code and action decide the outcome; rewards are noisy by a deviation, or by three steps."""
    rng = np.random.default_rng(0)
    drawn = (rng.integers(most, size=count).tolist() for most in (codes, 6))
    found = []
    for code, action in zip(*drawn, strict=True):
        reward, ends = outcomes[(7 * code + 5 * action) % len(outcomes)]
        noise = std * float(rng.standard_normal()) + step * int(rng.integers(-1, 2))
        found.append(CodeTransition((code,), action, ((code + action) % codes,), reward + noise, ends))
    return found


@pytest.mark.parametrize("outcomes", [RULED, PICKS])
def test_exact_rewards_have_no_classes_and_stay_as_they_are(outcomes: Sequence[tuple[float, bool]]) -> None:
    for count in (0, 1, 8, 60, 400):
        given = rows(count, outcomes=outcomes)
        assert reward_classes(given) is EXACT
        assert EXACT.of(given) == given


@pytest.mark.parametrize(("std", "step"), [(0.5, 0.0), (0.0, 0.5), (0.5, 0.5), (1.0, 0.0)])
def test_noisy_rewards_have_the_classes_of_the_rules(std: float, step: float) -> None:
    noisy, exact = rows(200, std=std, step=step), rows(200)
    found = reward_classes(noisy)
    assert found.centers[False] == pytest.approx([-1.0], abs=0.25)
    assert found.centers[True] == pytest.approx([-5.0, 50.0], abs=0.4)
    for center in (*found.centers[False], *found.centers[True]):
        of_class = [row.reward for row, ruled in zip(noisy, exact, strict=True) if abs(ruled.reward - center) < 1.0]
        assert center == pytest.approx(np.mean(of_class)), "each sighting counts"
    new = CodeTransition((99,), 0, (98,), 49.0, True)
    assert found.reward(new) == found.centers[True][1]
    assert found.reward(new._replace(reward=20.0)) == 20.0, "it is like none that was seen"
    assert found.reward(new._replace(terminated=False)) == 49.0


def test_classes_reach_as_far_as_noise_of_the_same_deviation_whatever_its_law() -> None:
    """A transition is seen 55 times. Of Laplace's law the middle half is narrower, and few rewards are far out."""
    exact = rows(4000)
    rng = np.random.default_rng(1)
    reaches = []
    for noise in (rng.normal(0.0, 0.5, 4000), rng.laplace(0.0, 0.5 / np.sqrt(2.0), 4000)):
        noisy = [row._replace(reward=row.reward + more) for row, more in zip(exact, noise.tolist(), strict=True)]
        reaches.append(reward_classes(noisy).reach)
    assert reaches[1] == pytest.approx(reaches[0], rel=0.08)


def test_frequent_transitions_differ_though_rewards_overlap() -> None:
    noisy, exact = (rows(600, outcomes=PICKS, std=std) for std in (0.5, 0.0))
    found = reward_classes(noisy)
    assert found.centers[False] == pytest.approx([0.0, 1.0], abs=0.15)
    assert found.centers[True] == pytest.approx([-5.0, 5.0], abs=0.15)
    ruled = {row[:3]: row.reward for row in exact}
    assert sum(abs(found.reward(row) - ruled[row[:3]]) > 0.3 for row in noisy) < 0.02 * 600


@pytest.mark.parametrize(("apart", "noisy"), [(0.5, True), (55.0, False)])
def test_rewards_that_differ_in_a_third_of_all_sightings_are_noisy_if_by_little(apart: float, *, noisy: bool) -> None:
    """If by much, something that is not seen decides about the outcome, and each reward is one of its own."""
    given = rows(200, codes=3)
    times: Counter[tuple[object, ...]] = Counter()
    for place, row in enumerate(given):
        given[place] = row._replace(reward=row.reward - apart * (times[row[:3]] // 3 % 2))
        times[row[:3]] += 1
    assert (reward_classes(given) is not EXACT) == noisy
    if noisy:
        assert reward_classes(given).centers[True] == pytest.approx([-5.0, 50.0], abs=0.3)


@pytest.mark.parametrize(
    ("cost", "noisy"),
    [("chance", True), ("much", False), ("action", False), ("next", False), ("both", False), ("few", False)],
)
def test_small_differences_that_nothing_explains_are_noise_before_anything_came_twice(
    cost: str, *, noisy: bool
) -> None:
    """Rewards that an action, a value or two values explain are exact, and so are those that differ by much."""
    rng = np.random.default_rng(0)
    given = []
    for number in range(12 if cost == "few" else 40):
        code = (number, *rng.integers(4, size=2).tolist())  # the first value never comes again
        action = int(rng.integers(3))
        after = (number, (code[1] + 1) % 4, int(rng.integers(4)))
        step = {"action": action, "next": after[2], "both": (code[1] + after[2]) % 3}.get(cost, int(rng.integers(3)))
        outcome = RULED[int(rng.integers(len(RULED)))]
        reward = outcome[0] + (60.0 if cost == "much" else 0.5) * (step - 1)
        given.append(CodeTransition(code, action, after, reward, outcome[1]))
    assert len({row[:3] for row in given}) == len(given)
    found = reward_classes([row for row in given if row.reward < 20.0] if cost != "much" else given)
    assert (found is not EXACT) == noisy
    if noisy:
        assert found.centers[False] == pytest.approx([-1.0], abs=0.3)
        assert found.centers[True] == pytest.approx([-5.0], abs=0.3)


def test_a_few_rewards_make_no_class_of_their_own() -> None:
    found = reward_classes(rows(30, std=0.5))
    assert len(found.centers[False]) == 1 and len(found.centers[True]) <= 3


def live(learner: LearnedPerceptionAgent, episodes: range) -> None:
    for episode in episodes:
        noise = np.random.default_rng((9, episode))
        for transition in played(learner, np.random.default_rng((0, episode)), explore=True):
            noisy = transition.reward + 0.2 * float(noise.standard_normal())
            learner.observe(replace(transition, reward=noisy), episode=episode)


def live_drawn(learner: FactoredAgent, episode: int, *, noisy: bool) -> None:
    """One episode of drawn macro-actions, whose rewards are exact or have a standard deviation of 0.5."""
    rng = np.random.default_rng((0, episode))
    learner.begin_episode()
    for row in fake_codes.drawn(rng):
        exact = fake_codes.transition(row.code, row.action)
        noise = 0.5 * float(rng.standard_normal()) if noisy else 0.0
        learner.observe(replace(exact, reward=exact.reward + noise), episode=episode)


@pytest.mark.parametrize("begins", [0, 4])
def test_rewards_that_more_data_shows_to_be_exact_are_learned_as_they_are(begins: int) -> None:
    """Rewards of a task's first three episodes differ by chance, all later ones are exact, so no class stays.

    So many episodes of another task were before. An agent that begins anew with all that was replayed has the same
    values.
    """
    learner = fake_codes.agent()
    for episode in range(begins):
        live_drawn(learner, 100 + episode, noisy=False)
    learner.reset_for_new_task()
    had_classes = False
    episode = 0
    while not had_classes or learner.rewards is not EXACT:
        assert episode < 30, "the rewards must have had classes, and then none"
        live_drawn(learner, episode, noisy=episode < 3)
        had_classes |= learner.rewards is not EXACT
        episode += 1
    state = learner.state()
    assert state.arrays["replay/class_reward"].tolist() == [row.reward for row in learner.replay]
    anew = fake_codes.agent()
    anew.restore(state)
    seen = [Observation(frame=fake_codes.frame(code)) for code in fake_codes.starts()]
    assert [learner.q_values(each).tolist() for each in seen] == [anew.q_values(each).tolist() for each in seen]


@pytest.mark.parametrize("begins", [0, 4])
def test_a_resumed_run_classes_rewards_by_the_same_transitions(begins: int) -> None:
    """A restored agent knows which transitions of the present task had been classed.

    The task begins after so many episodes with exact rewards.
    """
    learner = fake_codes.agent()
    resumptions = 0
    for episode in range(begins + 20):
        if episode == begins:
            learner.reset_for_new_task()
        state = learner.state()
        resumes = learner.rewards is not EXACT and learner.classed < len(learner.replay)
        live_drawn(learner, episode, noisy=episode >= begins)
        if resumes:
            resumed = fake_codes.agent()
            resumed.restore(state)
            live_drawn(resumed, episode, noisy=episode >= begins)
            assert same_state(learner.state(), resumed.state())
            resumptions += 1
    assert resumptions > 5


def test_a_state_with_one_column_of_what_is_clear_is_taken_up() -> None:
    """As agents kept it for some hours of 2026-11-30: both codes of a transition were clear, or neither."""
    learner, begins = fake_codes.agent(), []
    for episode in range(5):
        learner.begin_episode()
        for step, row in enumerate(fake_codes.drawn(np.random.default_rng(episode))):
            learner.observe(fake_codes.transition(row.code, row.action), episode=episode)
            begins.append(step == 0)
    state = learner.state()
    arrays = dict(state.arrays)
    arrays["replay/is_clear"] = np.arange(len(learner.replay)) % 2 == 0
    del arrays["replay/code_is_clear"], arrays["replay/following_is_clear"]
    resumed = fake_codes.agent()
    resumed.restore(replace(state, arrays=arrays))
    known = [(row.code_is_clear, row.following_is_clear) for row in resumed.replay]
    assert len(known) > 1 and [row.is_first for row in resumed.replay] == begins
    assert known == [(place % 2 == 0,) * 2 for place in range(len(known))]


@pytest.mark.slow
def test_it_learns_from_noisy_rewards_and_resumes_to_the_same_bits() -> None:
    learner = agent()
    live(learner, range(12))
    state = learner.state()
    twin = agent()
    twin.restore(AgentState(arrays=dict(state.arrays), values=dict(state.values)))
    for each in (learner, twin):
        live(each, range(12, 16))
    assert same_state(learner.state(), twin.state())
    assert learner.rewards is not EXACT
    assert len(learner.model.outcomes.outcomes) < 0.2 * len(learner.replay), "not one outcome for each reward"
