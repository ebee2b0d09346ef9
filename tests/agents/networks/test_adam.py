"""The suite's Adam against torch's own."""

from __future__ import annotations

import torch
from imagine_bench.agents.networks.adam import Adam
from torch import nn


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
