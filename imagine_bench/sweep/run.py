"""Running a grid: all its benches as one piece of work. Finished runs are only read.

So another agent, seed or experiment costs none of the runs that are there, and experiments share those of a level.
"""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError, RunFailedError
from imagine_bench.interfaces import Rules
from imagine_bench.judge.causes import expected_rightly
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import Encoders, Launcher
from imagine_bench.running.bench import carry_out, plan
from imagine_bench.running.launchers.jobs import processes
from imagine_bench.running.task_types import load_bench, task_type
from imagine_bench.statistics import Estimate, difference
from imagine_bench.store.bench_folder import BenchStore, bench_folder
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.sweep.grid import Experiment, Level, Study, Suite, Variant
from imagine_bench.sweep.score import Scale, auroc, score
from imagine_bench.values import Json

Planned = tuple[ProtocolData, Encoders]
"""A bench, and the encoders that its agents need."""
_FIGURES_ONLY = {"open_loop_starts": 0, "recorded_episodes": 0}
LevelPlan = tuple[tuple[Protocol, ...], Encoders]
"""The benches of a level and an agent, one a seed."""


def run_benches(planned: Iterable[Planned], *, root: Path, launcher: Launcher) -> tuple[str, ...]:
    """Run what is missing of several benches below ``root``; a run that fails costs the others nothing.

    Returns:
        A sentence for each run that failed. Raises as :func:`.bench.bench`, but for runs that fail.
    """
    different = {protocol.hash: (protocol, encoders) for protocol, encoders in planned}
    failures, _ = carry_out(list(different.values()), root=root, launcher=launcher)
    return tuple(
        f"{each.job.spec.agent} seed {each.job.spec.seed} in {each.job.spec.protocol.task}: {each.reason} "
        f"Log: {each.job.log}"
        for each in failures
    )


def _load(root: Path, protocol: ProtocolData) -> BenchResult:
    result = load_bench(bench_folder(root, protocol))
    assert isinstance(result, BenchResult), "of a control task"
    return result


# --- studies -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Line:
    """The results of a variant."""

    variant: Variant
    success: NDArray[np.float64]  #: Success shares. Shape (seeds, budgets).
    #: Share of macro-actions of which the model expects the true outcome, :func:`.judge.causes.expected_rightly`; NaN
    #: for agents without a model. Shape (seeds, budgets).
    imagined_right: NDArray[np.float64]
    train_cpu_s: float  #: Mean CPU seconds of training a run
    #: Against the variant it is compared with, one a budget; None for a variant that is compared with nothing.
    difference: tuple[Estimate, ...] | None
    folder: Path  #: Folder of its bench
    environment: Mapping[str, Json]  #: Command, commit, versions and machine of its first session; JSON-like


def run_study(study: Study, task: str, *, root: Path, launcher: Launcher) -> tuple[Line, ...]:
    """Run what is missing of every variant and compare. Errors are those of :func:`.bench.bench`."""
    if not registry.has_task(task):
        task_type(task)  # knows every name
        raise InvalidValueError(f"{task} is learned from data; a study compares agents that act. Give a control task.")
    planned = {variant.name: plan_variant(study, task, variant) for variant in study.variants}
    failures = run_benches(planned.values(), root=root, launcher=launcher)
    if failures:
        raise RunFailedError("\n".join([f"{len(failures)} runs failed; the same command tries them again.", *failures]))
    results = {name: _load(root, protocol) for name, (protocol, _) in planned.items()}
    return tuple(_line(study, variant, results, registry.task(task).rules) for variant in study.variants)


def _line(study: Study, variant: Variant, results: Mapping[str, BenchResult], rules: Rules) -> Line:
    result = results[variant.name]
    success = result.success_rates(variant.agent)
    against = next((each for each in study.variants if each.name == variant.against), None)
    differences = None
    if against is not None:
        pairs = zip(success.T, results[against.name].success_rates(against.agent).T, strict=True)
        differences = tuple(difference(ours, theirs, trials=study.evaluation_episodes) for ours, theirs in pairs)
    return Line(
        variant=variant,
        success=success,
        imagined_right=imagined_right(rules, result.of(variant.agent)),
        train_cpu_s=float(np.mean([run.checkpoints[-1].train_cpu_s for run in result.runs])),
        difference=differences,
        folder=result.folder,
        environment=result.environment,
    )


def plan_variant(study: Study, task: str, variant: Variant) -> Planned:
    """The bench of a variant. Raises as :func:`.bench.plan`."""
    world = {
        name: tuple(sorted(value.items())) if isinstance(value, Mapping) else value
        for name, value in variant.world.items()
    }
    return plan(
        task,
        study.preset,
        agents=(variant.agent,),
        seeds=study.seeds,
        budgets=study.budgets,
        evaluation_episodes=study.evaluation_episodes,
        overrides=tuple(sorted(variant.settings.items())),
        **{**_FIGURES_ONLY, "execution": study.execution, "appearance": study.appearance, **world},
    )


def imagined_right(rules: Rules, runs: Sequence[RunResult]) -> NDArray[np.float64]:
    """Of each run and budget the share of macro-actions whose true outcome the agent's model expects; NaN without one.

    Shape (runs, budgets).
    """
    rows = []
    for run in runs:
        rows.append([
            math.nan if each.beliefs is None else expected_rightly(rules, each.beliefs) for each in run.checkpoints
        ])  # fmt: skip
    return np.array(rows)


# --- the suite ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class LevelResult:
    """The results of one agent in one level."""

    level: Level
    values: NDArray[np.float64]  #: Success share, or AUROC, of each seed; NaN if it was not run. Shape (seeds,).
    scale: Scale | None  #: None if nothing was run
    train_cpu_s: float  #: Mean CPU seconds of training a run; NaN likewise
    benches: tuple[str, ...]  #: Task and folder of the bench of each seed, below the folder of all benches
    environment: Mapping[str, Json]  #: Of its first session; empty likewise


@dataclass(frozen=True, kw_only=True)
class SuiteResult:
    """The results of the agents, as far as the suite was run."""

    suite: Suite
    agents: tuple[str, ...]
    levels: dict[tuple[str, str], tuple[LevelResult, ...]]  #: By experiment and agent
    failures: tuple[str, ...] = ()  #: Runs that failed, a sentence each

    def score(self, experiment: Experiment, agent: str) -> Estimate:
        """The agent's score in an experiment; NaN if a level was not run."""
        found = self.levels[experiment.name, agent]
        scales = [each.scale for each in found if each.scale is not None]
        if len(scales) < len(found):
            return Estimate(math.nan, math.nan, math.nan)
        trials = self.suite.evaluation_episodes if experiment.measure == "success" else None
        return score(np.column_stack([each.values for each in found]), scales, trials=trials)


def plan_level(suite: Suite, level: Level, agent: str) -> LevelPlan:
    """The benches of a level and an agent; an agent that cannot transfer has no earlier task.

    An encoder that does not exist yet is trained now. Raises as :func:`.bench.plan`.
    """
    fields: dict[str, Any] = {
        "agents": (agent,),
        "seeds": suite.seeds,
        "budgets": (level.episodes,),
        "execution": suite.execution,
        "evaluation_episodes": suite.evaluation_episodes,
        "hyperparameters": suite.hyperparameters,
        **_FIGURES_ONLY,
        **level.protocol,
    }
    try:
        whole, encoders = plan(level.task, "quick", **fields)
    except InvalidValueError:
        if fields.pop("after", None) is None:
            raise
        fields.pop("after_episodes", None)
        whole, encoders = plan(level.task, "quick", **fields)
    assert isinstance(whole, Protocol), "of a control task"
    return tuple(dataclasses.replace(whole, seeds=(seed,)) for seed in whole.seeds), encoders


def _try_to_plan(job: tuple[Suite, Level, str]) -> LevelPlan | None:
    """The plan of a level; None if it fails, for not every error can be sent between processes."""
    try:
        return plan_level(*job)
    except ImagineBenchError:
        return None


def plan_suite(suite: Suite, agents: Sequence[str], workers: int | None) -> dict[tuple[str, str, str], LevelPlan]:
    """The plans by experiment, level and agent, made by so many processes; None is one a core.

    Raises as :func:`plan_level`.
    """
    jobs = {
        (each.name, level.name, agent): (suite, level, agent)
        for each in suite.experiments for level in each.levels for agent in agents
    }  # fmt: skip
    found: dict[tuple[str, str, str], LevelPlan | None] = dict.fromkeys(jobs)
    if processes(workers) > 1:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        with ProcessPoolExecutor(processes(workers), mp_context=multiprocessing.get_context("spawn")) as pool:
            found = dict(zip(jobs, pool.map(_try_to_plan, jobs.values(), chunksize=len(agents)), strict=True))
    return {key: found[key] or plan_level(*job) for key, job in jobs.items()}


def run_suite(
    suite: Suite, agents: Sequence[str], *, root: Path, launcher: Launcher, planners: int | None = 1
) -> SuiteResult:
    """Run what is missing of a suite, planned by so many processes. Raises as :func:`run_benches`."""
    plans = plan_suite(suite, agents, planners)
    benches = [(protocol, encoders) for protocols, encoders in plans.values() for protocol in protocols]
    failures = run_benches(benches, root=root, launcher=launcher)
    levels = {}
    for each in suite.experiments:
        for agent in agents:
            protocols = [plans[each.name, level.name, agent][0] for level in each.levels]
            pairs = zip(each.levels, protocols, strict=True)
            levels[each.name, agent] = tuple(_level_result(each, *pair, root) for pair in pairs)
    return SuiteResult(suite=suite, agents=tuple(agents), levels=levels, failures=failures)


def _level_result(experiment: Experiment, level: Level, protocols: Sequence[Protocol], root: Path) -> LevelResult:
    folders = [bench_folder(root, protocol) for protocol in protocols]
    benches = tuple(f"{folder.parent.name}/{folder.name}" for folder in folders)
    if any(BenchStore(*pair).missing() for pair in zip(folders, protocols, strict=True)):
        nothing = np.full(len(protocols), math.nan)
        return LevelResult(
            level=level, values=nothing, scale=None, train_cpu_s=math.nan, benches=benches, environment={}
        )
    results = [_load(root, protocol) for protocol in protocols]
    last = [run.checkpoints[-1] for result in results for run in result.runs]
    by_success = experiment.measure == "success"
    return LevelResult(
        level=level,
        values=np.array([each.success_rate if by_success else auroc(each.open_loop) for each in last]),
        scale=_scale(results[0]) if by_success else Scale(chance=0.5, optimum=1.0),
        train_cpu_s=float(np.mean([each.train_cpu_s for each in last])),
        benches=benches,
        environment=results[0].environment,
    )


def _scale(result: BenchResult) -> Scale:
    if result.certificate is None:
        raise ArtefactError(f"{result.folder} has no certificate; remove the folder and run the suite again.")
    return Scale(chance=result.certificate.chance_level, optimum=result.certificate.optimum)
