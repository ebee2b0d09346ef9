"""Member networks, dropout masks, the max-norm constraint; the suite's Adam against torch's own."""

from __future__ import annotations

import pytest
import torch
from imagine_bench.agents.networks.adam import Adam
from imagine_bench.agents.networks.mlp import (
    MemberMLP,
    clip_gradient_norm,
    clip_unit_norms,
    dropout_mask,
    mlp,
)
from torch import nn


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("dropout", [0.5, 0.0625, 0.2, 0.9])
def test_masks_drop_the_right_share(dropout: float) -> None:
    mask = dropout_mask((200, 1001), dropout, generator())
    share = (mask == 0).double().mean().item()
    assert abs(share - dropout) < 0.5 / 256 + 0.004
    kept = 1.0 / (1.0 - round(256 * dropout) / 256)
    assert mask.unique().tolist() == pytest.approx([0.0, kept])
    assert mask.double().mean().item() == pytest.approx(1.0, abs=0.02), "the mean of a unit stays"


def test_neighbouring_units_are_dropped_independently() -> None:
    dropped = (dropout_mask((4000, 64), 0.5, generator()) == 0.0).double()
    correlation = torch.corrcoef(dropped.T) - torch.eye(64)
    assert correlation.abs().max() < 5.0 / 4000**0.5


def test_members_are_independent_networks() -> None:
    network = MemberMLP((3, 5, 2), members=2, dropout=0.5, generator=generator())
    x = torch.randn(2, 4, 3, generator=generator(1))
    masks = network.draw_masks(4, generator(2))
    assert masks is not None
    together = network(x, masks)
    for member in range(2):
        hidden = (x[member] @ network.weights[0][member] + network.biases[0][member]).relu()
        alone = hidden * masks[0][member] @ network.weights[1][member] + network.biases[1][member]
        torch.testing.assert_close(together[member], alone)


def test_max_norm_limits_each_unit_and_leaves_the_others() -> None:
    network = MemberMLP((4, 3, 2), members=1, dropout=0.0, generator=generator())
    with torch.no_grad():
        network.weights[0][0, :, 1] = 10.0
    before = network.weights[0].detach().clone()
    clip_unit_norms(network, 3.0)
    norms = network.weights[0][0].norm(dim=0)
    torch.testing.assert_close(norms[1], torch.tensor(3.0))
    torch.testing.assert_close(network.weights[0][0, :, 1] / 1.5, torch.ones(4))  # the direction stays
    assert torch.equal(network.weights[0][0, :, [0, 2]], before[0, :, [0, 2]])


def test_a_single_network_begins_glorot_uniform() -> None:
    before = torch.get_rng_state()
    network, again = mlp((200, 100, 2), generator(3)), mlp((200, 100, 2), generator(3))
    assert torch.equal(before, torch.get_rng_state()), "the global generator was used"
    for one, other in zip(network.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    bound = (6.0 / 300.0) ** 0.5
    assert 0.98 * bound < network[0].weight.abs().max() <= bound
    assert not network[0].bias.any()


def weights() -> list[nn.Parameter]:
    draws = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(size, generator=draws)) for size in (3, 4, 5)]


def test_steps_are_torchs_own_to_the_bit() -> None:
    """Two groups of other decay, a rate that changes, a weight without a gradient."""
    draws = torch.Generator().manual_seed(1)
    own, theirs = weights(), weights()
    adam = Adam([(own[:1], 0.02), (own[1:], 0.0)], 0.01)
    torchs = torch.optim.Adam([{"params": theirs[:1], "weight_decay": 0.02}, {"params": theirs[1:]}], 0.01, fused=True)
    for rate in (0.01, 0.1):
        adam.learning_rate = rate
        for group in torchs.param_groups:
            group["lr"] = rate
        for mine, other in zip(own[:2], theirs[:2], strict=True):
            mine.grad = torch.randn(mine.shape, generator=draws)
            other.grad = mine.grad.clone()
        adam.step()
        torchs.step()
        assert all(torch.equal(*pair) for pair in zip(own, theirs, strict=True))
    assert torch.equal(own[2], weights()[2])
    adam.zero_grad()
    assert all(weight.grad is None for weight in own)


@pytest.mark.parametrize("hidden", [(), (7,), (7, 5)])
def test_gradients_of_a_dense_network_are_those_of_autograd(hidden: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    network = mlp((4, *hidden, 3), generator)
    x, slope = torch.randn(6, 4, generator=generator), torch.randn(6, 3, generator=generator)
    expected = torch.autograd.grad(network(x), [*network.parameters()], slope)
    values = network.outputs(x)
    assert torch.equal(values[0], x) and torch.equal(values[-1], network(x).detach())
    network.backpropagate(values, slope)
    for weight, gradient in zip(network.parameters(), expected, strict=True):
        torch.testing.assert_close(weight.grad, gradient)
        assert gradient.abs().max() > 0.0


@pytest.mark.parametrize("limit", [0.5, 1e6])
def test_gradients_are_clipped_to_a_common_norm(limit: float) -> None:
    """As torch does it, to the bit; a large limit changes nothing."""
    generator = torch.Generator().manual_seed(0)
    both = [[*mlp((4, 5, 3), generator).parameters()] for _ in range(2)]
    for mine, its in zip(*both, strict=True):
        mine.grad = torch.randn(mine.shape, generator=generator)
        its.grad = mine.grad.clone()
    before = torch.cat([weight.grad.flatten() for weight in both[0]]).norm().item()
    clip_gradient_norm(both[0], limit)
    torch.nn.utils.clip_grad_norm_(both[1], limit)
    assert all(torch.equal(mine.grad, its.grad) for mine, its in zip(*both, strict=True))
    after = torch.cat([weight.grad.flatten() for weight in both[0]]).norm().item()
    assert after == pytest.approx(min(before, limit), rel=1e-5)
