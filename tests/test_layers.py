"""Member networks, dropout masks, the max-norm constraint and the flat optimiser."""

from __future__ import annotations

import pytest
import torch
from imagine_bench.agents.flat_adam import FlatAdam
from imagine_bench.agents.layers import MemberMLP, clip_unit_norms, dropout_mask
from torch import nn


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("dropout", [0.5, 0.25, 0.125, 0.0625, 0.2])
def test_masks_drop_the_right_share_and_keep_the_mean(dropout: float) -> None:
    mask = dropout_mask((200, 1001), dropout, generator())
    share = (mask == 0.0).double().mean().item()
    assert abs(share - dropout) < 0.5 / 256 + 0.004
    assert abs(mask.double().mean().item() - 1.0) < 0.006
    assert len(mask.unique()) == 2


def test_neighbouring_units_are_dropped_independently() -> None:
    dropped = (dropout_mask((4000, 64), 0.5, generator()) == 0.0).double()
    correlation = torch.corrcoef(dropped.T) - torch.eye(64)
    assert correlation.abs().max() < 5.0 / 4000**0.5


def test_masks_come_from_the_generator_alone() -> None:
    torch.manual_seed(1)
    first = dropout_mask((3, 70), 0.5, generator(7))
    before = torch.get_rng_state()
    torch.manual_seed(2)
    assert torch.equal(first, dropout_mask((3, 70), 0.5, generator(7)))
    torch.manual_seed(1)
    assert torch.equal(before, torch.get_rng_state()), "the global generator was used"
    assert not torch.equal(first, dropout_mask((3, 70), 0.5, generator(8)))


def test_members_are_independent_networks() -> None:
    network = MemberMLP((3, 5, 2), members=2, dropout=0.5, generator=generator())
    x = torch.randn(2, 4, 3, generator=generator(1))
    masks = network.draw_masks(4, generator(2))
    assert masks is not None
    together = network(x, masks)
    for member in range(2):
        hidden = (x[member] @ network.weights[0][member] + network.biases[0][member]).relu() * masks[0][member]
        alone = hidden @ network.weights[1][member] + network.biases[1][member]
        torch.testing.assert_close(together[member], alone)


def test_without_masks_a_network_is_deterministic_and_with_them_it_is_not() -> None:
    network = MemberMLP((3, 32, 2), members=1, dropout=0.5, generator=generator())
    x, masks = torch.ones(1, 4, 3), generator(1)
    assert torch.equal(network(x), network(x))
    assert not torch.equal(network(x, network.draw_masks(4, masks)), network(x, network.draw_masks(4, masks)))


def test_gradients_under_dropout_against_finite_differences() -> None:
    network = MemberMLP((3, 6, 5, 2), members=2, dropout=0.5, generator=generator()).double()
    masks = tuple(mask.double() for mask in network.draw_masks(4, generator(1)) or ())
    x = torch.randn(2, 4, 3, dtype=torch.float64, generator=generator(2), requires_grad=True)
    assert torch.autograd.gradcheck(lambda value: network(value, masks), (x,))
    weight = network.weights[1]

    def loss(value: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(network, {"weights.1": value}, (x.detach(), masks)).square().sum()

    assert torch.autograd.gradcheck(loss, (weight.detach().clone().requires_grad_(),))


def test_max_norm_limits_each_unit_and_leaves_the_others() -> None:
    network = MemberMLP((4, 3, 2), members=1, dropout=0.0, generator=generator())
    with torch.no_grad():
        network.weights[0][0, :, 1] = 10.0
    before = network.weights[0].detach().clone()
    clip_unit_norms([network], 3.0)
    norms = network.weights[0][0].norm(dim=0)
    torch.testing.assert_close(norms[1], torch.tensor(3.0))
    torch.testing.assert_close(network.weights[0][0, :, 1] / 1.5, torch.ones(4))  # the direction stays
    assert torch.equal(network.weights[0][0, :, [0, 2]], before[0, :, [0, 2]])


@pytest.mark.parametrize("clip", [None, 0.05])
def test_flat_adam_is_adam_with_the_gradient_of_each_module_clipped_by_itself(clip: float | None) -> None:
    def networks() -> list[nn.Sequential]:
        torch.manual_seed(3)
        return [nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1)) for _ in range(2)]

    def loss(modules: list[nn.Sequential], scale: float) -> torch.Tensor:
        return sum((module(torch.ones(2, 3)) - 2.0).square().mean() * scale**i for i, module in enumerate(modules))

    ours, theirs = networks(), networks()
    flat = FlatAdam(ours, learning_rate=0.01, gradient_clip=clip)
    plain = torch.optim.Adam([p for module in theirs for p in module.parameters()], lr=0.01)
    for _ in range(20):
        flat.step(loss(ours, 100.0))
        plain.zero_grad()
        loss(theirs, 100.0).backward()
        for module in theirs:
            if clip is not None:
                nn.utils.clip_grad_norm_(module.parameters(), clip)
        plain.step()
    for mine, other in zip(ours, theirs, strict=True):
        for a, b in zip(mine.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
