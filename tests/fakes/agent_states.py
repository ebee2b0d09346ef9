"""The gradient updates of a learner, counted."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from imagine_bench.agents.networks.adam import Adam


def count_updates(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """From now on the optimiser of every gradient update, ours or torch's, is added."""
    updates: list[object] = []

    def counted(step: Callable[..., object]) -> Callable[..., object]:
        return lambda optimiser, *args, **named: (updates.append(optimiser), step(optimiser, *args, **named))[1]

    for kind in (Adam, torch.optim.Adam, torch.optim.AdamW):
        if "step" in vars(kind):
            monkeypatch.setattr(kind, "step", counted(kind.step))
    return updates
