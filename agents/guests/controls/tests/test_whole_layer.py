"""The max-norm of a whole layer: its bound holds after an update, and it is tighter than that of each unit."""

from __future__ import annotations

from dataclasses import replace

import torch
from imagine_bench.agents.imagination.settings import HYPERPARAMETERS
from imagine_bench.agents.imagination.world_model import EnvironmentModel
from imagine_bench.agents.replay import Batch
from imagine_bench_controls.whole_layer import WholeLayerModel, limit_layer_norm

LIMIT = 0.5


def test_a_norm_limit_keeps_directions_and_small_members() -> None:
    weights = torch.stack([0.3 * torch.eye(2), 3.0 * torch.eye(2)])
    limit_layer_norm(weights, LIMIT)
    assert torch.equal(weights[0], 0.3 * torch.eye(2))
    torch.testing.assert_close(weights[1], LIMIT / 2**0.5 * torch.eye(2))  # two equal weights


def test_every_layer_is_within_the_limit_after_an_update() -> None:
    settings = HYPERPARAMETERS.resolve("published", {"model.max_norm": LIMIT}, "chapter_5").model
    settings = replace(settings, dynamics_hidden=(32, 32), reward_hidden=(32,), termination_hidden=(32,))
    draws = torch.Generator().manual_seed(0)
    batch = Batch(
        z=torch.randn(16, 4, generator=draws),
        action=torch.randint(3, (16,), generator=draws),
        reward=torch.randn(16, generator=draws),
        next_z=torch.randn(16, 4, generator=draws),
        terminated=torch.zeros(16),
    )
    norms = {}
    for kind in (EnvironmentModel, WholeLayerModel):
        model = kind(4, 3, settings, torch.Generator().manual_seed(1))
        model.update(batch, torch.Generator().manual_seed(2))
        norms[kind] = [float(layer.detach().norm()) for network in model.networks for layer in network.weights]
    assert all(norm <= LIMIT * 1.0001 for norm in norms[WholeLayerModel])
    assert any(norm > 2 * LIMIT for norm in norms[EnvironmentModel])
