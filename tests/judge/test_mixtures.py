"""World models that can, and that cannot, hold several outcomes, learned on a coin of three sides."""

from __future__ import annotations

import numpy as np
import torch
from fake_latents import CODES, LATENTS, FakeEncoder, frame
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import ImaginationSettings, Settings, WorldModelSettings
from imagine_bench.agents.replay import RealMemory

from imagine_bench.interfaces import State
from imagine_bench.judge.truth import hallucinated_modes, missed_modes, total_variation
from imagine_bench.seeding import SeedTree

SHARES = (0.5, 0.3, 0.2)
"""What action 0 leads to from state 0: states 1, 2 and 3; action 1 leads on by one, everywhere."""


def learned(components: int) -> Imagination:
    """A world model of the coin on the fake encoder's latents, trained on every transition alike."""
    model = WorldModelSettings(
        dynamics_hidden=(32,), components=components, shared_hidden=(16,), reward_hidden=(), termination_hidden=(),
        dropout=0.0, learning_rate=1e-2, sigma_floor=0.05, batch_size=256,
    )  # fmt: skip
    settings = Settings(model=model, imagination=ImaginationSettings(weight_samples=1))
    device = prepare_torch("cpu")
    imagination = Imagination(LATENTS, 2, settings, filtered=False, seeds=SeedTree(1), device=device)
    rng, real, sigma = np.random.default_rng(0), RealMemory(600, LATENTS, device), torch.full((LATENTS,), 0.05)
    for _ in range(600):
        state, action = int(rng.integers(4)), int(rng.integers(2))
        after = 1 + int(rng.choice(3, p=SHARES)) if (state, action) == (0, 0) else (state + 1) % 5
        real.add((CODES[state], sigma), action, 0.0, (CODES[after], sigma), False)
    draws = torch.Generator().manual_seed(1)
    for batch in real.sample(200 * 256, draws).split(256):
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
    exact: dict[State, float] = {(1 + n,): share for n, share in enumerate(SHARES)}
    mixture, gaussian = learned(6), learned(1)
    one, other = imagined(mixture, 0, 0), imagined(gaussian, 0, 0)
    assert total_variation(exact, one) < 0.15
    assert missed_modes(exact, one) == hallucinated_modes(exact, one) == 0
    assert total_variation(exact, other) > 0.3
    assert missed_modes(exact, other) + hallucinated_modes(exact, other) >= 1
    for model in (mixture, gaussian):  # one fails where several outcomes are possible, not everywhere
        assert total_variation({(3,): 1.0}, imagined(model, 2, 1)) < 0.1
