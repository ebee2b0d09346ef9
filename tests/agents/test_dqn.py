"""The controller: targets by hand, the schedule, gradients."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from imagine_bench.agents.dqn import Controller, epsilon, td_target
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.replay import Batch
from imagine_bench.agents.snapshot import load_training, training_arrays

from imagine_bench.errors import DivergedError


def test_termination_stops_bootstrapping_truncation_does_not() -> None:
    reward, q_next = torch.tensor([50.0, -1.0]), torch.tensor([[3.0, 7.0], [3.0, 7.0]])
    ended_and_cut_off = torch.tensor([1.0, 0.0])  # a truncated transition is stored with terminated = 0
    assert td_target(reward, ended_and_cut_off, q_next, 0.9).tolist() == pytest.approx([50.0, -1.0 + 0.9 * 7.0])


def test_epsilon_falls_from_maximum_to_minimum() -> None:
    settings = ControllerSettings(epsilon_min=0.001, epsilon_max=0.8, epsilon_decay=0.03)
    assert epsilon(0, settings) == pytest.approx(0.8)
    assert epsilon(100, settings) == pytest.approx(0.001 + 0.799 * math.exp(-3.0))
    assert epsilon(10**6, settings) == pytest.approx(0.001)


def make(discount: float = 0.9) -> Controller:
    settings = ControllerSettings(hidden=(8,), discount=discount)
    return Controller(3, 2, settings, torch.Generator().manual_seed(0))


def batch(reward: float = 1.0) -> Batch:
    generator = torch.Generator().manual_seed(1)
    z, next_z = torch.randn(2, 5, 3, generator=generator)
    terminated = torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0])
    return Batch(z, torch.tensor([0, 1, 1, 0, 1]), torch.full((5,), reward), next_z, terminated)


def weights(module: torch.nn.Module) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


def test_loss_is_the_mean_squared_bellman_error_row_by_row() -> None:
    controller, rows = make(), batch()
    values, following = controller.values(rows.z), controller.values(rows.next_z)
    errors = []
    for i in range(5):
        bootstrap = 0.0 if rows.terminated[i] else 0.9 * following[i].max()
        errors.append((1.0 + bootstrap - values[i, rows.action[i]]) ** 2)
    torch.testing.assert_close(controller.loss(rows).detach(), torch.stack(errors).mean())
    torch.testing.assert_close(controller.errors(rows).square(), torch.stack(errors))
    weight = torch.tensor([1.0, 0.5, 0.0, 0.25, 1.0])
    weighted = controller.loss(replace(rows, weight=weight)).detach()
    torch.testing.assert_close(weighted, (weight * torch.stack(errors)).mean())


def test_no_gradient_flows_through_the_target() -> None:
    controller, rows = make(), batch()
    target = td_target(rows.reward, rows.terminated, controller.values(rows.next_z), 0.9)
    q = controller.network(rows.z).gather(1, rows.action.unsqueeze(1)).squeeze(1)
    weight = next(controller.network.parameters())
    (expected,) = torch.autograd.grad((target - q).square().mean(), weight)
    (given,) = torch.autograd.grad(controller.loss(rows), weight)
    torch.testing.assert_close(given, expected)
    assert expected.abs().max() > 0.0


def test_a_loss_that_is_no_number_leaves_the_weights() -> None:
    controller = make()
    before = weights(controller)
    with pytest.raises(DivergedError, match=r"controller's loss is nan. Lower controller.learning_rate"):
        controller.update(batch(reward=float("nan")))
    assert torch.equal(weights(controller), before)


def test_a_target_network_follows_at_its_rate() -> None:
    settings = ControllerSettings(hidden=(8,), discount=0.9, target_rate=0.25)
    controller, again = (Controller(3, 2, settings, torch.Generator().manual_seed(seed)) for seed in (0, 5))
    before = weights(controller.network)
    assert torch.equal(weights(controller.target), before)
    controller.update(batch())
    after = weights(controller.network)
    torch.testing.assert_close(weights(controller.target), before + 0.25 * (after - before))
    assert (after != before).any()
    plain = make()
    plain.network.load_state_dict(controller.network.state_dict())
    assert controller.loss(batch()) != plain.loss(batch()), "the loss must use the target network's values"
    load_training(again, again.optimiser, training_arrays(controller, controller.optimiser))
    assert controller.update(batch()) == again.update(batch())
    assert torch.equal(weights(controller), weights(again)), "moments and steps are part of a snapshot"
