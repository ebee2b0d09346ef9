"""Success of an agent in the arrow puzzle where frames or rewards have nuisances, and its price; kept row by row.

python nuisances.py noise=1 shadow=1,shift=1 harsh --seeds 400 401 --budgets 60 150 --out nuisances.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.launchers.jobs import launcher
from imagine_bench.store.files import lock
from imagine_bench.store.results import BenchResult

KEY = ("appearance", "agent", "seed")


def measure(appearance: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """One run: at each budget the share of tests that it solves, macro-actions and CPU seconds until then."""
    protocol, encoders = plan(
        options.task, "sample_efficiency", agents=(options.agent,), seeds=(seed,), budgets=tuple(options.budgets),
        execution="kinematic", evaluation_episodes=options.tests, appearance=appearance,
    )  # fmt: skip
    result = bench(protocol, encoders, root=options.runs, launcher=launcher("local", 1))
    assert isinstance(protocol, Protocol) and isinstance(result, BenchResult)
    (run,) = result.of(options.agent)
    environment = dict(result.environment)
    return {
        "appearance": appearance, "agent": options.agent, "seed": seed, "task": options.task, "tests": options.tests,
        "episodes": [row.episodes for row in run.checkpoints],
        "solved": [row.success_rate for row in run.checkpoints],
        "macro_actions": [row.env_steps for row in run.checkpoints],
        "train_cpu_s": [round(row.train_cpu_s, 1) for row in run.checkpoints],
        "commit": environment.get("commit"), "machine": environment.get("machine"),
    }  # fmt: skip


def keep(row: dict[str, Any], out: Path) -> None:
    """Put a row into the file, in place of an earlier one of the same run."""
    with lock(out.with_suffix(".lock"), f"The file {out}", patience_s=60.0):
        rows = json.loads(out.read_text()) if out.is_file() else []
        rows = [each for each in rows if [each[name] for name in KEY] != [row[name] for name in KEY]]
        rows = sorted([*rows, row], key=lambda each: [each[name] for name in KEY])
        out.write_text(json.dumps(rows, indent=1))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("appearances", nargs="+")
    parser.add_argument("--agent", default="factored")
    parser.add_argument("--task", default="arrow_puzzle")
    parser.add_argument("--seeds", nargs="+", type=int, default=[400, 401, 402, 403, 404])
    parser.add_argument("--budgets", nargs="+", type=int, default=[60, 150])
    parser.add_argument("--tests", type=int, default=100)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--out", type=Path, default=Path("nuisances.json"))
    options = parser.parse_args(arguments)
    for seed in options.seeds:
        for appearance in options.appearances:
            row = measure(appearance, seed, options)
            keep(row, options.out)
            print(f"{appearance} seed {seed}: {row['solved']} after {row['episodes']} episodes", flush=True)


if __name__ == "__main__":
    main()
