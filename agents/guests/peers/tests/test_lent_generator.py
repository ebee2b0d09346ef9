"""Torch's global generator, lent to a library: draws go on where they stopped, and nobody else notices."""

from __future__ import annotations

import pytest
import torch
from imagine_bench_peers.lent_generator import LentGenerator


def drawn(lent: LentGenerator, count: int) -> list[float]:
    with lent.lent():
        return torch.rand(count).tolist()


def test_draws_go_on_where_they_stopped() -> None:
    apart = LentGenerator(3, "cpu")
    at_once = LentGenerator(3, "cpu")
    before = torch.get_rng_state()
    parts = drawn(apart, 2)
    torch.rand(5)
    parts += drawn(apart, 3)
    torch.set_rng_state(before)
    assert parts == drawn(at_once, 2) + drawn(at_once, 3) and len(set(parts)) == 5
    assert torch.equal(before, torch.get_rng_state())
    apart.reset(3)
    assert drawn(apart, 2) == parts[:2] != drawn(LentGenerator(4, "cpu"), 2)


def test_it_is_given_back_after_an_error() -> None:
    before = torch.get_rng_state()
    with pytest.raises(ZeroDivisionError), LentGenerator(0, "cpu").lent():
        raise ZeroDivisionError
    assert torch.equal(before, torch.get_rng_state())
