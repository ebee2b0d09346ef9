"""Torch's global generator, lent to a library: draws go on where they stopped, and nobody else notices."""

from __future__ import annotations

import pytest
import torch
from imagine_bench_peers.global_rng_scope import GlobalRngScope


def drawn(scope: GlobalRngScope, count: int) -> list[float]:
    with scope.active():
        return torch.rand(count).tolist()


def test_draws_go_on_where_they_stopped_and_nobody_else_notices() -> None:
    apart, at_once = (GlobalRngScope(3, "cpu") for _ in range(2))
    before = torch.get_rng_state()
    parts = drawn(apart, 2)
    with pytest.raises(ZeroDivisionError), GlobalRngScope(0, "cpu").active():
        raise ZeroDivisionError
    parts += drawn(apart, 3)
    assert torch.equal(before, torch.get_rng_state())
    torch.rand(5)
    assert parts == drawn(at_once, 2) + drawn(at_once, 3) and len(set(parts)) == 5
    apart.reset(3)
    assert drawn(apart, 2) == parts[:2] != drawn(GlobalRngScope(4, "cpu"), 2)
