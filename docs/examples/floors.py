"""Transitions until an agent solves 95 % of the solvable episodes, over the cautious learner's, in the suite's worlds.

python floors.py --agent factored --cubes 4 --out floors.json
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import registry
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.launchers.jobs import launcher
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.sweep.grid import GRIDS, SUITE

BUDGETS = (10, 20, 30, 40, 50, 60, 70, 80, 100, 120, 150)
SHARE = 0.95


def worlds(cubes: int) -> Iterator[tuple[str, str]]:
    """Task and appearance of every level with up to so many cubes that tests where it trains, each once."""
    found = set()
    for experiment in GRIDS[SUITE].experiments:
        for level in experiment.levels:
            world = level.task, level.protocol.get("appearance", "clean")
            few = len(registry.task(level.task).macrostate_values) <= cubes + 1
            if experiment.measure == "success" and few and "split" not in level.protocol and world not in found:
                found.add(world)
                yield world


def transitions(run: RunResult, optimum: float) -> float:
    """Those of the first budget from which on every test solves enough; infinite where the last does not."""
    enough = [each.success_rate >= SHARE * optimum for each in run.checkpoints]
    first = len(enough) - next((late for late, good in enumerate(reversed(enough)) if not good), len(enough))
    return run.checkpoints[first].env_steps if first < len(enough) else math.inf


def measure(task: str, appearance: str, agent: str, options: argparse.Namespace) -> dict[str, Any]:
    """One world: of each seed the transitions, and the world's cautious learner and optimum."""
    protocol, encoders = plan(
        task, "sample_efficiency", agents=(agent,), seeds=tuple(options.seeds), budgets=BUDGETS, execution="kinematic",
        evaluation_episodes=options.tests, appearance=appearance,
    )  # fmt: skip
    result = bench(protocol, encoders, root=options.runs, launcher=launcher("local", options.workers))
    assert isinstance(protocol, Protocol) and isinstance(result, BenchResult) and result.certificate
    certificate = result.certificate
    needed = [transitions(run, certificate.optimum) for run in result.of(agent)]
    return {
        "task": task, "appearance": appearance, "optimum": certificate.optimum,
        "floor": certificate.learning_cost and certificate.learning_cost.transitions,
        "transitions": [each if math.isfinite(each) else None for each in needed],
        "train_cpu_s": float(np.mean([run.checkpoints[-1].train_cpu_s for run in result.of(agent)])),
        "environment": dict(result.environment),
    }  # fmt: skip


def over_cautious(row: dict[str, Any]) -> float:
    """Median of the seeds, over the cautious learner; infinite where that is no number."""
    needed = [math.inf if each is None else each for each in row["transitions"]]
    return float(np.median(needed)) / (row["floor"] or math.nan)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", default="factored")
    parser.add_argument("--cubes", type=int, default=4)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--tests", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    rows = []
    for task, appearance in worlds(options.cubes):
        rows.append(measure(task, appearance, options.agent, options))
        print(f"{over_cautious(rows[-1]):8.2f} {task} {appearance}", flush=True)
    print(f"{np.median([over_cautious(row) for row in rows]):8.2f} median of {len(rows)} worlds")
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
