"""Torch's global generator, with a state of its own for a library that draws from no other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


class GlobalRngScope:
    """A state of torch's global generator, which goes on where it stopped each time it is active.

    Args:
        seed: Where it begins.
        device: ``"cpu"``, or ``"cuda"``: then a graphics card's generator is seeded from it.
    """

    def __init__(self, seed: int, device: str) -> None:
        self._device = device
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Begin anew."""
        self.state = torch.Generator().manual_seed(seed).get_state()

    @contextmanager
    def active(self) -> Iterator[None]:
        """Random numbers in this block are drawn from here; the global generator is afterwards as it was."""
        before = torch.get_rng_state()
        torch.set_rng_state(self.state)
        if self._device == "cuda":
            torch.cuda.manual_seed(int(torch.randint(2**62, (), generator=torch.default_generator)))
        try:
            yield
        finally:
            self.state = torch.get_rng_state()
            torch.set_rng_state(before)
