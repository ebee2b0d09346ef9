"""Running a suite: a bench for each level, agent and seed, all of them as one piece of work; what is done is only read.

So another agent, seed or experiment costs none of those that are there, and experiments share the runs of a level.
"""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import Encoders
from imagine_bench.running.bench import carry_out, plan
from imagine_bench.running.launchers.jobs import Launcher, processes
from imagine_bench.running.task_types import load_bench
from imagine_bench.statistics import Estimate
from imagine_bench.store.bench_folder import BenchStore, bench_folder
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.suite.experiments import Experiment, Level, Suite
from imagine_bench.suite.score import Scale, auroc, score

Planned = list[tuple[tuple[Protocol, ...], Encoders]]
"""Of each agent its benches of one level, one a seed, and the encoders they need."""


@dataclass(frozen=True, kw_only=True)
class LevelResult:
    """What one agent reached in one level."""

    level: Level
    values: NDArray[np.float64]  #: Success share, or AUROC, of each seed; NaN where there is none. Shape (seeds,).
    scale: Scale | None  #: None where nothing was run
    train_cpu_s: float  #: Mean CPU seconds of training a run; NaN likewise
    benches: tuple[str, ...]  #: Task and folder of the bench of each seed, below the folder of all benches
    environment: dict[str, Any]  #: Of its first session; empty likewise


@dataclass(frozen=True, kw_only=True)
class SuiteResult:
    """What the agents reached, as far as it was run."""

    suite: Suite
    agents: tuple[str, ...]
    levels: dict[tuple[str, str], tuple[LevelResult, ...]]  #: By experiment and agent
    failures: tuple[str, ...] = ()  #: Runs that failed, a sentence each

    def score(self, experiment: Experiment, agent: str) -> Estimate:
        """The agent's score in an experiment; NaN where a level was not run."""
        found = self.levels[experiment.name, agent]
        scales = [each.scale for each in found if each.scale is not None]
        if len(scales) < len(found):
            return Estimate(math.nan, math.nan, math.nan)
        trials = self.suite.evaluation_episodes if experiment.measure == "success" else None
        return score(np.column_stack([each.values for each in found]), scales, trials=trials)


def plan_level(suite: Suite, level: Level, agent: str) -> tuple[tuple[Protocol, ...], Encoders]:
    """The benches of a level and an agent, one a seed; who cannot carry over what it learned has no earlier task.

    An encoder that no one has trained yet is trained now. Raises as :func:`.running.plan`.
    """
    shared: dict[str, Any] = {
        "agents": (agent,), "seeds": suite.seeds, "budgets": (level.episodes,), "execution": suite.execution,
        "evaluation_episodes": suite.evaluation_episodes, "hyperparameters": suite.hyperparameters,
        "open_loop_starts": 0, "recorded_episodes": 0, **level.protocol,
    }  # fmt: skip
    try:
        whole, paths = plan(level.task, "quick", **shared)
    except InvalidValueError:
        if "after" not in shared:
            raise
        alone = {name: value for name, value in shared.items() if name not in ("after", "after_episodes")}
        whole, paths = plan(level.task, "quick", **alone)
    assert isinstance(whole, Protocol), "of a control task"
    return tuple(dataclasses.replace(whole, seeds=(seed,)) for seed in whole.seeds), paths


def _plan_all(suite: Suite, level: Level, agents: Sequence[str]) -> Planned:
    return [plan_level(suite, level, agent) for agent in agents]


def _try_to_plan(suite: Suite, level: Level, agents: Sequence[str]) -> Planned | None:
    """The same, or None where it fails: an error is raised where it is asked for again."""
    try:
        return _plan_all(suite, level, agents)
    except ImagineBenchError:
        return None


def plan_suite(suite: Suite, agents: Sequence[str], workers: int | None) -> dict[tuple[str, str], Planned]:
    """Of every experiment and level what :func:`plan_level` gives each agent; as many encoders are trained at once.

    ``workers`` are processes; None is one a core.

    Raises as :func:`plan_level`.
    """
    every = [(each, level) for each in suite.experiments for level in each.levels]
    found: list[Planned | None] = [None] * len(every)
    if (at_once := processes(workers)) > 1:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        with ProcessPoolExecutor(at_once, mp_context=multiprocessing.get_context("spawn")) as pool:
            found = list(pool.map(_try_to_plan, repeat(suite), [level for _, level in every], repeat(agents)))
    return {
        (each.name, level.name): known or _plan_all(suite, level, agents)
        for (each, level), known in zip(every, found, strict=True)
    }


def run_suite(
    suite: Suite, agents: Sequence[str], *, root: Path, launcher: Launcher, planners: int | None = 1
) -> SuiteResult:
    """Run what is missing of a suite, planned by so many processes; runs that fail cost the others nothing.

    Raises as :func:`.running.bench`, but for runs that fail.
    """
    planned = plan_suite(suite, agents, planners)
    work: dict[str, tuple[ProtocolData, Encoders]] = {
        protocol.hash: (protocol, paths)
        for each in suite.experiments for index, _ in enumerate(agents) for level in each.levels
        for protocols, paths in [planned[each.name, level.name][index]] for protocol in protocols
    }  # fmt: skip
    failures, _ = carry_out(list(work.values()), root=root, launcher=launcher)
    return SuiteResult(
        suite=suite,
        agents=tuple(agents),
        levels={
            (each.name, agent): tuple(
                _read(each, level, planned[each.name, level.name][index][0], root) for level in each.levels
            )
            for each in suite.experiments
            for index, agent in enumerate(agents)
        },
        failures=tuple(
            f"{failure.job.spec.agent} seed {failure.job.spec.seed} in {failure.job.spec.protocol.task}: "
            f"{failure.reason} Log: {failure.job.log}"
            for failure in failures
        ),
    )


def _read(experiment: Experiment, level: Level, protocols: Sequence[Protocol], root: Path) -> LevelResult:
    folders = [bench_folder(root, protocol) for protocol in protocols]
    unfinished = [BenchStore(*pair).missing() for pair in zip(folders, protocols, strict=True)]
    loaded = [] if any(unfinished) else [load_bench(folder) for folder in folders]
    results = [result for result in loaded if isinstance(result, BenchResult)]
    runs = [run for result in results for run in result.runs]
    return LevelResult(
        level=level,
        values=np.array([_value(experiment, run) for run in runs] or [math.nan] * len(protocols)),
        scale=_scale(experiment, results[0]) if results else None,
        train_cpu_s=float(np.mean([run.checkpoints[-1].train_cpu_s for run in runs])) if runs else math.nan,
        benches=tuple(f"{folder.parent.name}/{folder.name}" for folder in folders),
        environment=dict(results[0].environment) if results else {},
    )


def _value(experiment: Experiment, run: RunResult) -> float:
    last = run.checkpoints[-1]
    return last.success_rate if experiment.measure == "success" else auroc(last.open_loop)


def _scale(experiment: Experiment, result: BenchResult) -> Scale:
    if experiment.measure == "auroc":
        return Scale(chance=0.5, optimum=1.0)
    if (found := result.certificate) is None:
        raise ArtefactError(f"{result.folder} has no certificate; remove the folder and run the suite again.")
    return Scale(chance=found.chance_level, optimum=found.optimum)


def with_seeds(suite: Suite, seeds: Sequence[int] | None) -> Suite:
    """The suite with other seeds, in their order, if any are given."""
    return suite if seeds is None else dataclasses.replace(suite, seeds=tuple(sorted(seeds)))
