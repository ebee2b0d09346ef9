"""Member networks, dropout masks, the max-norm constraint and the flat optimiser."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from imagine_bench.agents.networks.flat_adam import FlatAdam
from imagine_bench.agents.networks.mlp import Masks, MemberMLP, clip_unit_norms, dropout_mask
from torch import nn

from imagine_bench.errors import DivergedError


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def by_autograd(network: MemberMLP, x: torch.Tensor, masks: Masks | None) -> torch.Tensor:
    """What a stack is, in torch's own words."""
    last = len(network.weights) - 1
    for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = torch.baddbmm(bias, x, weight)
        if layer < last:
            x = x.relu()
            if masks is not None:
                x = x * (masks[layer] != 0) / (1.0 - network.dropout)
    return x


def gradients(network: MemberMLP, output: torch.Tensor, x: torch.Tensor) -> list[torch.Tensor]:
    weighted = output * torch.linspace(-1.0, 2.0, output.numel(), dtype=output.dtype).view_as(output)
    return list(torch.autograd.grad(weighted.square().sum(), [x, *network.parameters()]))


@pytest.mark.parametrize("dropout", [0.5, 0.25, 0.125, 0.0625, 0.2, 0.75, 0.9])
def test_masks_drop_the_right_share(dropout: float) -> None:
    mask = dropout_mask((200, 1001), dropout, generator())
    share = (mask == 0).double().mean().item()
    assert abs(share - dropout) < 0.5 / 256 + 0.004
    assert mask.unique().tolist() == [-1, 0], "all bits or none"


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
        hidden = (x[member] @ network.weights[0][member] + network.biases[0][member]).relu()
        alone = hidden * (masks[0][member] != 0) * 2.0 @ network.weights[1][member] + network.biases[1][member]
        torch.testing.assert_close(together[member], alone)


def test_without_masks_a_network_is_deterministic_and_with_them_it_is_not() -> None:
    network = MemberMLP((3, 32, 2), members=1, dropout=0.5, generator=generator())
    x, masks = torch.ones(1, 4, 3), generator(1)
    assert torch.equal(network(x), network(x))
    assert not torch.equal(network(x, network.draw_masks(4, masks)), network(x, network.draw_masks(4, masks)))


@pytest.mark.parametrize("dropout", [0.0, 0.25, 0.5])
@pytest.mark.parametrize(("members", "rows", "hidden"), [(1, 5, (7, 6)), (2, 5, (7,)), (1, 160, (96, 128)), (2, 9, ())])
def test_passes_written_out_are_those_of_autograd(
    members: int, rows: int, hidden: tuple[int, ...], dropout: float
) -> None:
    """Small and large products, which different libraries compute."""
    network = MemberMLP((4, *hidden, 3), members=members, dropout=dropout, generator=generator())
    for bias in network.biases:
        bias.data.normal_(generator=generator(3))
    x = torch.randn(members, rows, 4, generator=generator(1)).requires_grad_()
    masks = network.draw_masks(rows, generator(2))
    assert (masks is None) == (dropout == 0.0)
    ours, theirs = network(x, masks), by_autograd(network, x, masks)
    torch.testing.assert_close(ours, theirs)
    with torch.no_grad():
        torch.testing.assert_close(network(x, masks), theirs)
    for mine, other in zip(gradients(network, ours, x), gradients(network, theirs, x), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4 * float(other.abs().max()))


def test_hidden_layers_in_bfloat16_point_the_same_way() -> None:
    """Eight bits open or close a few of the gates: the gradient turns by less than 6 degrees and keeps its length.

    Another mini-batch turns it by 60 and more.
    """
    network = MemberMLP((24, 256, 256, 5), members=1, dropout=0.5, generator=generator(), hidden_dtype=torch.bfloat16)
    x = torch.randn(1, 512, 24, generator=generator(1)).requires_grad_()
    masks = network.draw_masks(512, generator(2))
    ours, theirs = network(x, masks), by_autograd(network, x, masks)
    assert ours.dtype == torch.float32
    assert not torch.equal(ours, theirs), "these layers must compute in bfloat16"
    for mine, other in zip(gradients(network, ours, x), gradients(network, theirs, x), strict=True):
        cosine = torch.cosine_similarity(mine.reshape(-1).double(), other.reshape(-1).double(), dim=0)
        assert cosine > 0.9945
        assert abs(mine.norm() / other.norm() - 1.0) < 0.01
    with torch.no_grad():
        torch.testing.assert_close(network(x, masks), theirs, msg="predictions are float32")


def test_bfloat16_works_on_a_processor_without_instructions_for_it() -> None:
    """A process whose libraries are told that there is no AVX-512; elsewhere than on x86 that changes nothing."""
    script = (
        "import torch\n"
        "from imagine_bench.agents.networks.products import affine\n"
        "draws = torch.Generator().manual_seed(0)\n"
        "x, weight, bias = (torch.randn(1, n, 64, generator=draws).bfloat16() for n in (512, 64, 1))\n"
        "exact = (x.double() @ weight.double() + bias.double()).relu()\n"
        "assert (affine(x, weight, bias, relu=True) - exact).abs().max() < 0.01 * exact.max()\n"
    )
    limited = {**os.environ, "ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2"}
    done = subprocess.run([sys.executable, "-c", script], env=limited, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_gradients_under_dropout_against_finite_differences() -> None:
    network = MemberMLP((3, 6, 5, 2), members=2, dropout=0.5, generator=generator()).double()
    masks = network.draw_masks(4, generator(1))
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


def test_a_gradient_that_is_no_number_changes_nothing() -> None:
    network = nn.Linear(2, 1)
    adam = FlatAdam([network], learning_rate=0.1, gradient_clip=None)
    before = adam.arrays()
    with pytest.raises(DivergedError, match="Gradients are no longer finite"):
        adam.step(network(torch.tensor([[0.0, float("inf")]])).sum())
    assert all(np.array_equal(before[name], array) for name, array in adam.arrays().items())
