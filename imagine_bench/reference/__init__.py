"""The results of the thesis, as data: one JSON file a task, every figure with its table or section.

The files keep the thesis' own units (percent, metres); the functions give shares, as the bench does, and raise
UnknownNameError for a task that the thesis does not have.
"""

from __future__ import annotations

import json
import math
from importlib import resources
from typing import Any

from imagine_bench.errors import require_known

NAMES = ("arrow_puzzle", "arrow_puzzle_hard", "pick_place", "robot_ik")
"""The parts of the thesis with results; a TaskSpec names one of these as its ``reference``."""


def load(name: str) -> dict[str, Any]:
    """Everything the thesis reports on one task, as in its JSON file.

    Raises:
        UnknownNameError: The thesis has no such task.
    """
    require_known("thesis reference", name, NAMES)
    return dict(json.loads(resources.files(__name__).joinpath(f"{name}.json").read_text(encoding="utf-8")))


def success(task_reference: str, agent: str) -> dict[int, tuple[float, float]]:
    """Success shares of one agent (tables 5.1 and 5.3, section 3.2.3): real episodes to (mean, standard deviation).

    Shares lie in [0, 1]; a standard deviation that the thesis does not give is NaN. An agent that it did not test gives
    an empty dict.
    """
    rows = load(task_reference).get("success", {}).get("agents", {}).get(agent, {})
    return {int(n): (mean / 100.0, math.nan if std is None else std / 100.0) for n, (mean, std) in rows.items()}


def success_source(task_reference: str) -> str:
    """Where in the thesis :func:`success` stands, and of which episodes; empty where it gives no success."""
    return str(load(task_reference).get("success", {}).get("source", ""))


def gain(task_reference: str, agent: str) -> dict[int, float]:
    """Gains over DQN in tables 5.2 and 5.4: real episodes to (P_aug - P_base) / P_base."""
    rows = load(task_reference).get("gain", {}).get("agents", {}).get(agent, {})
    return {int(episodes): percent / 100.0 for episodes, percent in rows.items()}
