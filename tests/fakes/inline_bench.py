"""Small benches in this process, without a pool of workers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bench_fakes  # noqa: F401 - registers its agents

from imagine_bench.bench import bench as benches
from imagine_bench.bench.control import run_observed
from imagine_bench.bench.launchers import Failure, Job
from imagine_bench.protocols.control import protocol
from imagine_bench.protocols.runs import OnProgress
from imagine_bench.store.results import BenchResult


class Inline:
    """A launcher that stops, as by Ctrl-C, after so many jobs."""

    def __init__(self, patience: int = 1000) -> None:
        self._left = patience

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        for job in jobs:
            if not self._left:
                raise KeyboardInterrupt
            self._left -= 1
            run_observed(job.spec, job.folder, on_progress)
        return ()


def bench(root: Path, launcher: Inline, **changes: Any) -> BenchResult:
    few = {"agents": ("table", "imaginer"), "seeds": (0, 1), "budgets": (2, 9), "evaluation_episodes": 5}
    kinematic = {"execution": "kinematic", "open_loop_starts": 0, "recorded_episodes": 0}
    wanted = protocol("arrow_puzzle", "smoke", **{**few, **kinematic, **changes})
    result: BenchResult = benches.bench(wanted, {}, root=root, launcher=launcher)
    return result
