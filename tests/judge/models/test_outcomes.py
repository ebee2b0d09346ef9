"""Distances of imagined from exact outcomes: by hand, and of world models that can or cannot hold several outcomes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fake_latents import CODES, LATENTS, FakeEncoder, frame
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings, WorldModelSettings
from imagine_bench.agents.replay import RealMemory

from imagine_bench.interfaces import Outcome, State
from imagine_bench.judge.models.outcomes import (
    hallucinated_modes,
    missed_modes,
    sampling_noise_floor,
    total_variation,
)
from imagine_bench.judge.models.truth import advance, expected_reward
from imagine_bench.seeding import SeedTree

SHARES = (0.5, 0.3, 0.2)
"""What action 0 leads to from state 0: states 1, 2 and 3; action 1 leads on by one, everywhere."""


def test_distances_are_those_computed_by_hand() -> None:
    exact, other = {(1,): 0.5, (2,): 0.5}, {(1,): 0.5, (3,): 0.25, (4,): 0.25}
    assert total_variation(exact, exact) == 0.0
    assert total_variation(exact, other) == pytest.approx(0.5)
    assert total_variation(exact, {(9,): 1.0}) == 1.0
    assert missed_modes(exact, other) == 1
    assert hallucinated_modes(exact, other) == 2
    assert missed_modes(exact, {(1,): 0.89, (2,): 0.11}) == 0, "0.11 is just above a fifth of 0.5"
    assert missed_modes(exact, {(1,): 0.91, (2,): 0.09}) == 1
    assert hallucinated_modes(exact, {(1,): 0.48, (2,): 0.48, (3,): 0.04}) == 0, "below the least of a mode"


def test_a_collapsed_distribution_misses_modes() -> None:
    exact = {(1 + n,): share for n, share in enumerate(SHARES)}
    collapsed = {(1,): 1.0}
    assert total_variation(exact, collapsed) == pytest.approx(0.5)
    assert (missed_modes(exact, collapsed), hallucinated_modes(exact, collapsed)) == (2, 0)


def test_the_sampling_floor_is_what_samples_of_the_truth_show() -> None:
    exact = {(1,): 0.5, (2,): 0.3, (3,): 0.2}
    rng = np.random.default_rng(0)
    shares = rng.multinomial(50, list(exact.values()), size=20_000) / 50
    distance = 0.5 * np.abs(shares - np.array(list(exact.values()))).sum(axis=1)
    assert sampling_noise_floor(exact, 50) == pytest.approx(distance.mean(), rel=0.01)
    assert sampling_noise_floor({(1,): 1.0}, 50) == 0.0


class Toss:
    """From state 0, one in four wins and ends; what was won stays, and would pay again."""

    n_actions = 1

    def outcomes(self, state: State, action: int) -> tuple[Outcome, ...]:
        if state == (1,):
            return (Outcome(1.0, (1,), 5.0, terminated=True, success=True),)
        win = Outcome(0.25, (1,), 2.0, terminated=True, success=True)
        return win, Outcome(0.75, (2,), -1.0, terminated=False, success=False)


def test_the_truth_advances_by_hand() -> None:
    """Dynamics go on after the end, and rewards stop."""
    before = {((0,), False): (0.5, 0.0), ((1,), True): (0.5, 0.0)}
    after = advance(Toss(), before, 0)  # type: ignore[arg-type]
    assert set(after) == {((1,), True), ((2,), False)}
    assert after[(1,), True] == pytest.approx((0.625, 0.125 * 2.0 / 0.625))
    assert after[(2,), False] == pytest.approx((0.375, -1.0))
    assert expected_reward(after) == pytest.approx(0.125 * 2.0 - 0.375)


def learned(components: int) -> Imagination:
    """A world model of the coin on the fake encoder's latents, trained on every transition alike."""
    model = WorldModelSettings(
        dynamics_hidden=(64, 64),
        components=components,
        shared_hidden=(32,),
        reward_hidden=(),
        termination_hidden=(),
        dropout=0.0,
        learning_rate=2e-3,
        sigma_floor=0.05,
        batch_size=256,
    )
    settings = Settings(model=model, imagination=ImaginationSettings(weight_samples=1))
    device = prepare_torch("cpu")
    imagination = Imagination(LATENTS, 2, settings, filtered=False, seeds=SeedTree(1), device=device)
    rng, real, sigma = np.random.default_rng(0), RealMemory(1000, LATENTS, device), torch.full((LATENTS,), 0.05)
    for _ in range(1000):
        state, action = int(rng.integers(4)), int(rng.integers(2))
        after = 1 + int(rng.choice(3, p=SHARES)) if (state, action) == (0, 0) else (state + 1) % 5
        real.add((CODES[state], sigma), action, 0.0, (CODES[after], sigma), False)
    draws = torch.Generator().manual_seed(1)
    for batch in real.sample(640 * 256, draws).split(256):
        imagination.model.update(batch, draws)
    return imagination


def imagined(imagination: Imagination, state: int, action: int, samples: int = 400) -> dict[State, float]:
    """The distribution of what follows."""
    generator, encoder = torch.Generator().manual_seed(0), FakeEncoder()
    z = encoder.encode(np.stack([frame(state)]))[0].repeat_interleave(samples, dim=0)
    step = imagination.step(z, torch.full((samples,), action), imagination.draw_weights(generator), generator)
    states, counts = np.unique(encoder.read_macrostate(step.next_z), axis=0, return_counts=True)
    return {tuple(row): count / samples for row, count in zip(states.tolist(), counts.tolist(), strict=True)}


def test_a_mixture_learns_all_outcomes_and_one_gaussian_does_not() -> None:
    exact = {(1 + n,): share for n, share in enumerate(SHARES)}
    mixture, gaussian = learned(6), learned(1)
    one, other = imagined(mixture, 0, 0), imagined(gaussian, 0, 0)
    assert total_variation(exact, one) < 0.15
    assert missed_modes(exact, one) == hallucinated_modes(exact, one) == 0
    assert total_variation(exact, other) > 0.3
    assert missed_modes(exact, other) + hallucinated_modes(exact, other) >= 1
    for model in (mixture, gaussian):  # one fails where several outcomes are possible, not everywhere
        assert total_variation({(3,): 1.0}, imagined(model, 2, 1)) < 0.1
