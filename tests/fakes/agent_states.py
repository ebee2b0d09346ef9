"""Whether two snapshots of agents are equal, and whether an agent that takes one up goes on as the other does."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from imagine_bench.agents.networks.adam import Adam

from imagine_bench.interfaces import AgentState


def same(first: AgentState, second: AgentState) -> bool:
    """Equal to the bit, CPU times aside."""

    def untimed(state: AgentState) -> str:
        meters = {name: value for name, value in state.values["meters"].items() if not name.startswith("time/")}
        return repr(sorted({**state.values, "meters": meters}.items()))  # in which a NaN equals itself

    return (
        untimed(first) == untimed(second)
        and first.arrays.keys() == second.arrays.keys()
        and all(array.tobytes() == second.arrays[name].tobytes() for name, array in first.arrays.items())
    )


def count_updates(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """From now on the optimiser of every gradient update, ours or torch's, is added."""
    updates: list[object] = []

    def counted(step: Callable[..., object]) -> Callable[..., object]:
        return lambda optimiser, *args, **named: (updates.append(optimiser), step(optimiser, *args, **named))[1]

    for kind in (Adam, torch.optim.Adam, torch.optim.AdamW):
        if "step" in vars(kind):
            monkeypatch.setattr(kind, "step", counted(kind.step))
    return updates
