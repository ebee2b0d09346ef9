"""Cells of the tables on the experience that a task needs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from kept import certificate_of, facts


def task_of(where: str) -> str:
    """The task of a kept bench, which begins with it."""
    return where.partition("-")[0]


def needed_by_any(where: str) -> str:
    """The lower bound of any learner, in macro-actions."""
    return f"{certificate_of(task_of(where)).lower_bound}"


def needed_by_cautious(where: str, what: str) -> str:
    """The mean transitions or episodes of the cautious learner."""
    cost = certificate_of(task_of(where)).learning_cost
    assert cost is not None
    return f"{getattr(cost, what):.0f}"


def worlds_learned(what: str) -> str:
    """How far ``factored`` came in the worlds of the benchmark suite, of five seeds each."""
    rows = facts("floors/floors.json")
    every = [run for row in rows for run in row["transitions"]]
    never = [all(run is None for run in row["transitions"]) for row in rows]
    ratios = []
    for row in rows:
        needed = [math.inf if run is None else run for run in row["transitions"]]
        ratios.append(np.median(needed) / row["floor"] if row["floor"] else math.nan)
    columns = {
        "runs that never": f"{sum(run is None for run in every)} of {len(every)}",
        "worlds in no run": f"{sum(never)}",
        "median": f"{np.median(ratios):.2f}",
    }
    return columns[what]


def _behind(nuisance: str) -> list[dict[str, Any]]:
    """The kept runs of ``factored`` behind nuisances joined by ``+``; of another agent after ``AGENT behind``."""
    agent, _, appearance = nuisance.rpartition(" behind ")
    wanted = (agent or "factored", appearance.replace("+", ","))
    runs = [run for run in facts("nuisances/nuisances.json") if (run["agent"], run["appearance"]) == wanted]
    if not runs:
        raise ValueError(f"No run of {wanted[0]} behind {wanted[1]} is kept.")
    return runs


def behind(column: str, episodes: str, nuisance: str) -> str:
    """A column of the runs behind nuisances after so many episodes: mean [lowest, highest seed]; shares in %."""
    runs = _behind(nuisance)
    values = np.array([run[column][run["episodes"].index(int(episodes))] for run in runs])
    if column == "solved":
        values = 100 * values
    return f"{values.mean():,.0f} [{values.min():,.0f}, {values.max():,.0f}]"


def behind_seeds(nuisance: str) -> str:
    """How many seeds were run behind a nuisance."""
    return str(len(_behind(nuisance)))
