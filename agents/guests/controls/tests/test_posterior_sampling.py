"""Posterior sampling: the posterior by hand, its limits, deep exploration of a chain, episodes, snapshots."""

from __future__ import annotations

from typing import Any

import fake_codes
import numpy as np
import pytest
from imagine_bench_controls.tabular.agent import ReadState, read_codes, read_macrostate
from imagine_bench_controls.tabular.counts import CountTable
from imagine_bench_controls.tabular.posterior_sampling import PosteriorSamplingAgent
from imagine_bench_controls.tabular.settings import POSTERIOR_SAMPLING
from imagine_bench_factored.perception import CodePerception

from imagine_bench.interfaces import Observation, Transition
from imagine_bench.seeding import SeedTree

CODES = read_codes(CodePerception(fake_codes.FakeCodes(), factored=False))  # type: ignore[arg-type]
BLANK = np.zeros((64, 64, 3), dtype=np.uint8)


def agent(
    *, read: ReadState = CODES, actions: int = fake_codes.ACTIONS, seed: int = 0, **overrides: Any
) -> PosteriorSamplingAgent:
    settings = POSTERIOR_SAMPLING.resolve("fast", overrides, "chapter_5")
    return PosteriorSamplingAgent(read, actions, settings, SeedTree(seed))


def at(state: int) -> Observation:
    return Observation(frame=BLANK, macrostate=np.array([state]))


def moved(state: int, action: int, reward: float, then: int, *, truncated: bool = False) -> Transition:
    return Transition(
        observation=at(state), action=action, reward=reward, next_observation=at(then), terminated=False,
        truncated=truncated,
    )  # fmt: skip


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
    assert (untried == pytest.approx(4.0)) is False and abs(np.mean(untried > 0) - 0.5) < 0.1


def test_it_follows_one_model_to_the_end_of_an_episode() -> None:
    learner = agent(read=read_macrostate, actions=2)
    learner.observe(moved(0, 0, 1.0, 1, truncated=True), episode=0)
    first = learner.values(at(0), explore=True)
    learner.observe(moved(0, 1, 5.0, 1), episode=1)
    assert np.array_equal(learner.values(at(0), explore=True), first), "news wait for the next episode"
    learner.observe(moved(1, 1, 0.0, 0, truncated=True), episode=1)
    assert not np.array_equal(learner.values(at(0), explore=True), first)


def test_it_explores_deeply() -> None:
    """A chain that pays at its far end alone; once it is known that something pays, whatever is untried may."""
    length = 12
    episodes = 60

    def reached(seed: int, *, by_chance: bool) -> int:
        learner = agent(read=read_macrostate, actions=2, seed=seed)
        rng = np.random.default_rng(seed)
        found = 0
        learner.observe(moved(50, 0, 100.0, 51, truncated=True), episode=0)
        for episode in range(episodes):
            state = 0
            for step in range(length):
                action = int(rng.integers(2)) if by_chance else learner.act(at(state), explore=True)
                then = state + 1 if action == state % 2 else 0
                reward = 100.0 if then == length - 1 else -1.0
                learner.observe(moved(state, action, reward, then, truncated=step == length - 1), episode=episode)
                found = found + (then == length - 1)
                state = then
        return found

    assert np.mean([reached(seed, by_chance=False) for seed in range(2)]) > 10
    assert np.mean([reached(seed, by_chance=True) for seed in range(2)]) < 1
