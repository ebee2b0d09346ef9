"""Sampled futures against exact ones: by hand, and perfect, collapsed, hallucinating and learned samplers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from fake_latents import CODES, LATENTS, FakeEncoder, frame
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.imagination.futures import sample_futures
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings, WorldModelSettings
from imagine_bench.agents.replay import RealMemory
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.capabilities import Follow, SampledFutures
from imagine_bench.interfaces import Frame, Outcome, State, TaskSpec
from imagine_bench.judge import futures
from imagine_bench.seeding import SeedTree

SHARES = (0.5, 0.3, 0.2)
"""What action 0 leads to from state 0: states 1, 2 and 3."""


class Coin:
    """Action 0 asks: 0 -> one of 1, 2, 3, and +1; then action 1 ends in 4 with +5. Whatever else is done ends in 5."""

    n_actions = 2
    states = tuple((state,) for state in range(6))
    start_states = ((0,),)

    def is_terminal(self, macrostate: State) -> bool:
        return macrostate[0] >= 4

    def is_legal(self, macrostate: State) -> bool:
        return macrostate != (5,)

    def optimal_action(self, macrostate: State) -> int:
        return int(macrostate[0] > 0)

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        if action != self.optimal_action(macrostate):
            return (Outcome(1.0, (5,), -5.0, terminated=True, success=False),)
        if action == 1:
            return (Outcome(1.0, (4,), 5.0, terminated=True, success=True),)
        return tuple(Outcome(p, (1 + n,), 1.0, terminated=False, success=False) for n, p in enumerate(SHARES))

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        return next(each for each in self.outcomes(macrostate, action) if each.macrostate == reached)


RULES = Coin()
Twist = Callable[[int, int, np.random.Generator], tuple[int, float, bool]]


def render(macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
    return np.stack([frame(int(state)) for (state,) in macrostates])


SPEC: TaskSpec = dataclasses.replace(
    registry.task("arrow_puzzle"), id="coin", rules=RULES, action_names=("ask", "take"), render_macrostates=render
)


class TableSampler:
    """Samples the rules, or a twist of them, and reads states from the first pixel."""

    def __init__(self, twist: Twist | None = None) -> None:
        self.twist = twist

    def _next(self, state: int, action: int, rng: np.random.Generator) -> tuple[int, float, bool]:
        outcomes = RULES.outcomes((state,), action)
        drawn = outcomes[int(rng.choice(len(outcomes), p=[each.probability for each in outcomes]))]
        return drawn.macrostate[0], drawn.reward, drawn.terminated

    def sample_futures(
        self,
        frames: Frame,
        actions: NDArray[np.int64],
        *,
        follow: Follow,
        samples: int,
        depth: int,
        rng: np.random.Generator,
    ) -> SampledFutures:
        shape = (depth, len(frames), samples)
        states, rewards, ended = np.zeros(shape, np.int64), np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        for row, column in np.ndindex(*shape[1:]):
            state, action, over = int(frames[row, 0, 0, 0]), int(actions[row]), False
            for step in range(depth):
                reward = 0.0
                if not over and action >= 0:
                    state, reward, over = (self.twist or self._next)(state, action, rng)
                    action = int(follow(np.array([[state]]))[0])
                states[step, row, column], rewards[step, row, column], ended[step, row, column] = state, reward, over
        return SampledFutures(macrostates=states[..., None], rewards=rewards, ended=ended)


def measure(sampler: TableSampler, samples: int = 400) -> futures.Futures:
    return futures.imagined_futures(sampler, SPEC, samples=samples, appearance="clean", seeds=SeedTree(0))


def pair(found: futures.Futures, state: int, action: int) -> int:
    (index,) = np.flatnonzero((found.macrostates[:, 0] == state) & (found.actions == action))
    return int(index)


def test_distances_are_those_computed_by_hand() -> None:
    exact, other = {(1,): 0.5, (2,): 0.5}, {(1,): 0.5, (3,): 0.25, (4,): 0.25}
    assert futures.total_variation(exact, exact) == 0.0
    assert futures.total_variation(exact, other) == pytest.approx(0.5)
    assert futures.total_variation(exact, {(9,): 1.0}) == 1.0
    assert futures.missed_modes(exact, other) == 1
    assert futures.hallucinated_modes(exact, other) == 2
    assert futures.missed_modes(exact, {(1,): 0.89, (2,): 0.11}) == 0, "0.11 is just above a fifth of 0.5"
    assert futures.missed_modes(exact, {(1,): 0.91, (2,): 0.09}) == 1
    assert futures.hallucinated_modes(exact, {(1,): 0.48, (2,): 0.48, (3,): 0.04}) == 0, "below the least of a mode"


def test_the_sampling_floor_is_what_samples_of_the_truth_show() -> None:
    exact = {(1,): 0.5, (2,): 0.3, (3,): 0.2}
    rng = np.random.default_rng(0)
    shares = rng.multinomial(50, list(exact.values()), size=20_000) / 50
    distance = 0.5 * np.abs(shares - np.array(list(exact.values()))).sum(axis=1)
    assert futures.sampling_noise_floor(exact, 50) == pytest.approx(distance.mean(), rel=0.01)
    assert futures.sampling_noise_floor({(1,): 1.0}, 50) == 0.0


def test_a_perfect_sampler_shows_the_floor_and_no_fault() -> None:
    found = measure(TableSampler())
    assert found.total_variation.shape == (futures.DEPTH, 8)
    assert int(found.samples) == 400
    assert found.total_variation.max() < 0.08  # floor 0.03 where three outcomes are possible
    ask = pair(found, 0, 0)
    assert found.sampling_noise_floor[:2, ask] == pytest.approx(
        [futures.sampling_noise_floor(dict(enumerate(SHARES)), 400), 0.0]
    )
    assert found.missed.sum() == found.hallucinated.sum() == 0
    assert found.reward_error.max() < 1e-6
    assert found.termination_error.max() < 1e-6
    assert found.survival_probability[:, ask].tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]
    assert found.survival_probability[:, pair(found, 0, 1)].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_a_collapsed_sampler_misses_modes_and_says_how_many() -> None:
    def collapse(state: int, action: int, rng: np.random.Generator) -> tuple[int, float, bool]:
        outcome = RULES.outcomes((state,), action)[0]
        return outcome.macrostate[0], outcome.reward, outcome.terminated

    found = measure(TableSampler(collapse))
    ask = pair(found, 0, 0)
    assert found.total_variation[0, ask] == pytest.approx(0.5)
    assert found.missed[0, ask] == 2
    assert found.missed[1, ask] == 0, "all of them end alike"
    assert found.hallucinated.sum() == 0


def test_a_hallucinating_sampler_is_caught_with_rewards_and_ends() -> None:
    def invent(state: int, action: int, rng: np.random.Generator) -> tuple[int, float, bool]:
        return 0, -1.0, False

    found = measure(TableSampler(invent), samples=8)
    take = pair(found, 1, 1)
    assert found.total_variation[0, take] == 1.0
    assert (found.missed[0, take], found.hallucinated[0, take]) == (1, 1)
    assert found.reward_error[0, take] == pytest.approx(6.0)
    assert found.termination_error[:, take].tolist() == [1.0] * futures.DEPTH


def learned(components: int) -> Imagination:
    """A world model of the coin on the fake encoder's latents, trained on every transition alike."""
    model = WorldModelSettings(
        dynamics_hidden=(64, 64),
        components=components,
        shared_hidden=(32,),
        reward_hidden=(),
        termination_hidden=(),
        dropout=0.0,
        learning_rate=5e-3,
        sigma_floor=0.05,
        batch_size=64,
    )
    settings = Settings(model=model, imagination=ImaginationSettings(weight_samples=1))
    device = prepare_torch("cpu")
    imagination = Imagination(LATENTS, 2, settings, filtered=False, seeds=SeedTree(1), device=device)
    rng, real = np.random.default_rng(0), RealMemory(1000, LATENTS, device)
    for _ in range(1000):
        state, action = int(rng.integers(4)), int(rng.integers(2))
        after, reward, over = TableSampler()._next(state, action, rng)
        sigma = torch.full((LATENTS,), 0.05)
        real.add((CODES[state], sigma), action, reward, (CODES[after], sigma), over)
    for _ in range(20):
        imagination.learn(real)
    return imagination


class LearnedSampler:
    def __init__(self, components: int) -> None:
        self.imagination = learned(components)

    def sample_futures(self, frames: Frame, actions: NDArray[np.int64], **options: object) -> SampledFutures:
        return sample_futures(self.imagination, FakeEncoder(), frames, actions, **options)  # type: ignore[arg-type]


def test_a_mixture_learns_all_outcomes_and_one_gaussian_does_not() -> None:
    mixture, gaussian = (measure(LearnedSampler(components)) for components in (6, 1))  # type: ignore[arg-type]
    ask = pair(mixture, 0, 0)
    assert mixture.total_variation.mean(axis=1).max() < 0.1
    assert mixture.total_variation[0, ask] < 0.15
    assert mixture.missed.sum() == mixture.hallucinated.sum() == 0
    assert gaussian.total_variation[0, ask] > 0.3
    assert gaussian.missed[0, ask] + gaussian.hallucinated[0, ask] >= 1
    certain = pair(gaussian, 2, 1)
    assert gaussian.total_variation[0, certain] < 0.1, "it fails where several outcomes are possible, not everywhere"


def test_sampling_draws_from_its_own_generator_alone() -> None:
    imagination = learned(2)
    before = imagination.arrays()
    options = {"follow": lambda rows: futures.follow_optimum(RULES, rows), "samples": 5, "depth": 3}
    frames, actions = render(np.array([[0], [1]]), "clean", np.random.default_rng(0)), np.array([0, 1])
    drawn = [
        sample_futures(imagination, FakeEncoder(), frames, actions, rng=np.random.default_rng(seed), **options)  # type: ignore[arg-type]
        for seed in (0, 0, 1)
    ]
    assert np.array_equal(drawn[0].rewards, drawn[1].rewards)
    assert not np.array_equal(drawn[0].rewards, drawn[2].rewards)
    after = imagination.arrays()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert actions.tolist() == [0, 1], "the caller's arrays are left alone"


def test_one_network_imagines_all_macro_actions_of_a_future() -> None:
    """One draw of dropout masks, as in every other rollout: followed by hand, the same rewards are met."""
    model = WorldModelSettings(dynamics_hidden=(32, 32), dropout=0.5)
    settings = Settings(model=model, imagination=ImaginationSettings(weight_samples=1, temperature=0.0))
    imagination = Imagination(LATENTS, 2, settings, filtered=False, seeds=SeedTree(1), device=prepare_torch("cpu"))
    frames, actions = render(np.array([[0]]), "clean", np.random.default_rng(0)), np.array([0])
    found = sample_futures(
        imagination, FakeEncoder(), frames, actions, follow=lambda rows: np.zeros(len(rows), dtype=np.int64), samples=1,
        depth=4, rng=np.random.default_rng(0),
    )  # type: ignore[arg-type]  # fmt: skip
    generator = torch.Generator().manual_seed(int(np.random.default_rng(0).integers(2**63)))
    weights, z, rewards = imagination.draw_weights(generator), FakeEncoder().encode(frames)[0], []
    for _ in range(4):
        step = imagination.step(z, torch.tensor([0]), weights, generator)
        z = step.next_z
        rewards.append(float(step.reward))
    assert not found.ended.any(), "an end would make the comparison shorter"
    assert found.rewards[:, 0, 0].tolist() == rewards


def test_after_an_unknown_or_final_macrostate_nobody_acts() -> None:
    assert futures.follow_optimum(RULES, np.array([[0], [2], [4], [5], [77]])).tolist() == [0, 1, -1, -1, -1]
