"""The controller: targets by hand, the schedule, gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from imagine_bench.agents.dqn import Controller, epsilon
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.replay import Batch
from imagine_bench.agents.snapshot import load_training, training_arrays

from imagine_bench.errors import DivergedError


def test_epsilon_falls_from_maximum_to_minimum() -> None:
    settings = ControllerSettings(epsilon_min=0.001, epsilon_max=0.8, epsilon_decay=0.03)
    assert epsilon(0, settings) == pytest.approx(0.8)
    assert epsilon(100, settings) == pytest.approx(0.001 + 0.799 * math.exp(-3.0))
    assert epsilon(10**6, settings) == pytest.approx(0.001)


def make(seed: int = 0, target_rate: float = 1.0) -> Controller:
    settings = ControllerSettings(hidden=(8,), discount=0.9, target_rate=target_rate)
    return Controller(3, 2, settings, torch.Generator().manual_seed(seed))


def batch(reward: float = 1.0) -> Batch:
    """Of two rows that ended; a truncated transition is stored with terminated = 0."""
    z, next_z = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(1))
    terminated = torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0])
    return Batch(z, torch.tensor([0, 1, 1, 0, 1]), torch.full((5,), reward), next_z, terminated)


def weights(module: torch.nn.Module) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


def test_loss_is_the_mean_squared_bellman_error_row_by_row() -> None:
    """And no gradient flows through the targets."""
    controller, rows = make(), batch()
    following = controller.values(rows.next_z)
    bootstrap = [0.0 if ended else 0.9 * q.max() for ended, q in zip(rows.terminated, following, strict=True)]
    target = 1.0 + torch.tensor(bootstrap)
    q = controller.network(rows.z)[torch.arange(5), rows.action]
    errors = (target - q).square()
    torch.testing.assert_close(controller.loss(rows), errors.mean())
    torch.testing.assert_close(controller.errors(rows).square(), errors.detach())
    weight = torch.tensor([1.0, 0.5, 0.0, 0.25, 1.0])
    torch.testing.assert_close(controller.loss(replace(rows, weight=weight)), (weight * errors).mean())
    first = next(controller.network.parameters())
    given, expected = (torch.autograd.grad(loss, first)[0] for loss in (controller.loss(rows), errors.mean()))
    torch.testing.assert_close(given, expected)
    assert expected.abs().max() > 0.0


@pytest.mark.parametrize("target_rate", [1.0, 0.25])
@pytest.mark.parametrize("weight", [None, torch.tensor([1.0, 0.5, 0.0, 0.25, 1.0])])
def test_an_update_moves_against_the_gradient_of_the_loss(target_rate: float, weight: torch.Tensor | None) -> None:
    """Adam's first step is the learning rate times the sign of the gradient, which is autograd's."""
    controller, rows = make(0, target_rate), replace(batch(), weight=weight)
    before = weights(controller.network)
    loss = controller.loss(rows)
    expected = torch.autograd.grad(loss, [*controller.network.parameters()])
    assert controller.update(rows) == loss.item()
    found = [each.grad for each in controller.network.parameters()]
    for given, slope in zip(found, expected, strict=True):
        torch.testing.assert_close(given, slope, rtol=1e-6, atol=1e-7)
    moved = weights(controller.network) - before
    slopes = torch.cat([slope.flatten() for slope in expected])
    torch.testing.assert_close(moved, -1e-3 * slopes / (slopes.abs() + 1e-8), rtol=1e-3, atol=1e-6)
    assert (slopes != 0.0).any()


def test_another_network_is_differentiated_as_it_is() -> None:
    """Its layers need not be ReLU layers, whose gradients the controller knows."""
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2))
    settings = ControllerSettings(hidden=(8,), discount=0.9)
    controller = Controller(3, 2, settings, torch.Generator(), network)
    rows = batch()
    expected = torch.autograd.grad(controller.loss(rows), [*network.parameters()])
    controller.update(rows)
    for weight, slope in zip(network.parameters(), expected, strict=True):
        assert torch.equal(weight.grad, slope)


def test_a_loss_that_is_no_number_leaves_the_weights() -> None:
    controller = make()
    before = weights(controller)
    with pytest.raises(DivergedError, match=r"controller's loss is nan. Lower controller.learning_rate"):
        controller.update(batch(reward=float("nan")))
    assert torch.equal(weights(controller), before)


def test_a_target_network_follows_at_its_rate() -> None:
    controller, again, plain = make(0, 0.25), make(5, 0.25), make()
    before = weights(controller.network)
    assert torch.equal(weights(controller.target), before)
    controller.update(batch())
    after = weights(controller.network)
    torch.testing.assert_close(weights(controller.target), before + 0.25 * (after - before))
    assert (after != before).any()
    plain.network.load_state_dict(controller.network.state_dict())
    assert controller.loss(batch()) != plain.loss(batch()), "the loss must use the target network's values"
    load_training(again, again.optimiser, training_arrays(controller, controller.optimiser))
    assert controller.update(batch()) == again.update(batch())
    assert torch.equal(weights(controller), weights(again)), "moments and steps are part of a snapshot"
