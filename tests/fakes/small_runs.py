"""Small runs, benches and datasets, made in this process, and the comparison of their results."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bench_fakes  # noqa: F401 - registers its agents
import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.cli.observers import OBSERVERS
from imagine_bench.data.folder import Apart, Dataset, write_dataset
from imagine_bench.interfaces import AgentContext, AgentState
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.protocols.data import Failure, Job, OnProgress, RunSpec
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.running.runner import run
from imagine_bench.seeding import SeedTree
from imagine_bench.store import run_folder
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.store.run_folder import load_newest

QUICK: dict[str, Any] = {"execution": "kinematic", "open_loop_starts": 0, "recorded_episodes": 0}
TWO_EPISODES: dict[str, Any] = {
    "preset": "smoke",
    "seeds": 1,
    "budgets": [1, 2],
    "evaluation_episodes": 2,
    "execution": "kinematic",
    "launcher": "this_process",
}
"""Arguments of a bench by :func:`imagine_bench.bench` with two training episodes, in this process."""


def of_before_digests() -> Protocol:
    """The protocol of :func:`small` as benches of abcb05c have it: without digests of packages."""
    return dataclasses.replace(small(), code=())


def small(task: str = "arrow_puzzle", **changes: Any) -> Protocol:
    few = {"agents": ("table",), "seeds": (0,), "budgets": (4, 9), "evaluation_episodes": 5, **QUICK}
    return protocol(task, "smoke", **{**few, **changes})


def run_observed(spec: RunSpec[Protocol], folder: Path, on_progress: OnProgress) -> RunResult | None:
    """A run in this process, looked at as those of a command are; None if it pauses before its end."""
    run(dataclasses.replace(spec, observers=OBSERVERS), folder, on_progress)
    return run_folder.load_run(folder) if run_folder.is_done(folder) else None


class KilledError(Exception):
    """Ends a run in its midst."""


def do(folder: Path, agent: str = "table", seed: int = 0, every_s: float = 20.0, **changes: Any) -> RunResult:
    return do_by(small(**changes), folder, agent=agent, seed=seed, every_s=every_s)


def do_by(protocol: Protocol, folder: Path, agent: str = "table", seed: int = 0, every_s: float = 20.0) -> RunResult:
    spec = RunSpec(protocol=protocol, agent=agent, seed=seed, checkpoint_every_s=every_s)
    return run_observed(spec, folder, lambda progress: None)


def final_state(folder: Path) -> AgentState:
    snapshot = load_newest(folder / "checkpoints")
    assert snapshot is not None
    return snapshot.agent


def final_arrays(folder: Path) -> dict[str, NDArray[Any]]:
    return dict(final_state(folder).arrays)


def context(seed: int = 0) -> AgentContext:
    return AgentContext(n_actions=6, preprocessing="gray_strips", encoder=None, seeds=SeedTree(seed).child("agent"))


def measured(result: RunResult) -> list[dict[str, Any]]:
    """Every number of every row but the times; a NaN equals itself as text."""
    rows = []
    for row in result.checkpoints:
        values = dataclasses.asdict(row)
        values["diagnostics"] = {k: v for k, v in values["diagnostics"].items() if not k.startswith("time/")}
        rows.append({name: exact(value) for name, value in values.items() if not name.endswith("_cpu_s")})
    return rows


def same_but_for_time(a: RunResult, b: RunResult) -> bool:
    """Beliefs aside, which only a run that is observed keeps."""

    def told(run: RunResult) -> Any:
        rows = [{**row, "beliefs": None} for row in measured(run)]
        return rows, exact([run.training_success, run.training_length])

    both = [exact(vars(run.training)) for run in (a, b) if run.training is not None]  # older runs keep none
    return bool(told(a) == told(b)) and (len(both) < 2 or both[0] == both[1])


def exact(value: Any) -> Any:
    """A value to compare to the bit; the text of an array would round its numbers and leave most of them out."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, dict):
        return {name: exact(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [exact(part) for part in value]
    assert value is None or isinstance(value, int | float | str | np.generic), type(value)
    return repr(value)


def made_bench(wanted: Protocol, root: Path) -> BenchResult:
    """A bench in this process, of agents that need no file."""
    return bench(wanted, {}, root=root, launcher=Inline())


class Inline:
    """A launcher without processes that notes its order of work, and gives up after so many jobs."""

    def __init__(self, patience: int = 1000) -> None:
        self.jobs: list[Job] = []
        self._patience = patience

    @property
    def order(self) -> list[tuple[str, int]]:
        return [(job.spec.agent, job.spec.seed) for job in self.jobs]

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        failures = []
        for job in jobs:
            if len(self.jobs) == self._patience:
                raise KeyboardInterrupt
            self.jobs.append(job)
            try:
                run_observed(job.spec, job.folder, on_progress)
            except RuntimeError as error:
                failures.append(Failure(job=job, reason=str(error)))
        return tuple(failures)


def benched(root: Path, task: str, *agents: str, **changes: Any) -> BenchResult:
    """A small bench, planned as the command does, and run in this process."""
    wanted, paths = plan(task, "smoke", agents=agents, **{**QUICK, **changes})
    return bench(wanted, paths, root=root, launcher=Inline())


FORMATS = ("npz", "lerobot", "minari")


@functools.cache
def collected(policy: str = "mixed", episodes: int = 6, seed: int = 0) -> tuple[Episodes, Apart, dict[str, Any]]:
    spec = registry.task("arrow_puzzle")
    chosen = policy_of(policy, spec, seed)
    return collect(spec, chosen, episodes=episodes, seed=seed, execution="kinematic", appearance="mild")


def written(folder: Path, format: str = "npz", **which: Any) -> Dataset:
    return write_dataset(folder, *collected(**which), format)
