"""Whether two snapshots of agents are equal."""

from __future__ import annotations

from typing import Any

import numpy as np

from imagine_bench.interfaces import AgentState


def same(first: AgentState, second: AgentState) -> bool:
    """Equal to the bit, CPU times aside."""

    def untimed(state: AgentState) -> dict[str, Any]:
        meters = {name: value for name, value in state.values["meters"].items() if not name.startswith("time/")}
        return {**state.values, "meters": meters}

    return (
        untimed(first) == untimed(second)
        and first.arrays.keys() == second.arrays.keys()
        and all(np.array_equal(array, second.arrays[name]) for name, array in first.arrays.items())
    )
