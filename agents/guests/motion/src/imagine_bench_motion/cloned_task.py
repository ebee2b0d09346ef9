"""The arrow puzzle as a task whose macro-actions a clone carries out. No scene is made and no network loaded here."""

from __future__ import annotations

from dataclasses import replace

from imagine_bench.registry import task

from .entries import ARROW_PUZZLE_CLONED

_PUZZLE = task("arrow_puzzle")
SPEC = replace(
    _PUZZLE,
    id="arrow_puzzle_cloned",
    title="Arrow puzzle, cloned execution",
    description=f"{_PUZZLE.description} A cloned policy at 25 Hz carries the macro-actions out, not the planner.",
    env_id=ARROW_PUZZLE_CLONED.env_id,
    reference=None,
    targets=None,
    executions=("physics",),
)
"""Rules, frames and encoders are those of the arrow puzzle; optimum and chance are those of a perfect execution."""
