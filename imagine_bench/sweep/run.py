"""Running a grid: all its benches as one piece of work. Finished runs are only read.

So another agent, seed or experiment costs none of the runs that are there, and experiments share those of a level.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Floats
from imagine_bench.errors import ArtefactError, UnableError
from imagine_bench.interfaces import Rules
from imagine_bench.judge.causes import expected_rightly
from imagine_bench.protocols.data import Encoders, Launcher, ProtocolData, require_different
from imagine_bench.running.bench import carry_out, plan, require_done, task_type
from imagine_bench.running.trained import require_control
from imagine_bench.statistics import Estimate, difference
from imagine_bench.store.bench_folder import BenchStore, as_begun, bench_folder
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult, RunResult
from imagine_bench.sweep.grid import Experiment, Level, Study, Suite, Variant
from imagine_bench.sweep.score import Scale, auroc, score
from imagine_bench.values import Json

Planned = tuple[ProtocolData, Encoders]
"""A bench, and the encoders that its agents need."""
_EARLIER_TASKS = ("after", "after_episodes", "unannounced")
_FIGURES_ONLY = {"open_loop_starts": 0, "recorded_episodes": 0}


# --- studies -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Line:
    """The results of a variant."""

    variant: Variant
    success: Floats  #: Success shares. Shape (seeds, budgets).
    #: Share of macro-actions of which the model expects the true outcome, :func:`.judge.causes.expected_rightly`; NaN
    #: for agents without a model. Shape (seeds, budgets).
    imagined_right: Floats
    train_cpu_s: float  #: Mean CPU seconds of training a run
    #: Against the variant it is compared with, one a budget; None for a variant that is compared with nothing.
    difference: tuple[Estimate, ...] | None
    folder: Path  #: Folder of its bench
    environment: Mapping[str, Json]  #: Command, commit, versions and machine of its first session; JSON-like


def run_study(study: Study, task: str, *, root: Path, launcher: Launcher) -> tuple[Line, ...]:
    """Carry out the missing runs of every variant and compare. Errors are those of :func:`.bench.bench`."""
    task_type(task)  # knows every name
    require_control(task, task)
    planned = {variant.name: _begun(root, [plan_variant(study, task, variant)])[0] for variant in study.variants}
    require_done(*carry_out(list(planned.values()), root=root, launcher=launcher))
    results = {name: load_so_far(bench_folder(root, protocol)) for name, (protocol, _) in planned.items()}
    return tuple(_line(study, variant, results, registry.task(task).rules) for variant in study.variants)


def _line(study: Study, variant: Variant, results: Mapping[str, BenchResult], rules: Rules) -> Line:
    result = results[variant.name]
    (agent,) = result.protocol.agents  # as the protocol spells it
    success = result.success_rates(agent)
    differences = None
    if variant.against is not None:
        base = results[variant.against]
        pairs = zip(success.T, base.success_rates(base.protocol.agents[0]).T, strict=True)
        differences = tuple(difference(ours, theirs, trials=study.evaluation_episodes) for ours, theirs in pairs)
    return Line(
        variant=variant,
        success=success,
        imagined_right=imagined_right(rules, result.of(agent)),
        train_cpu_s=float(np.mean([run.checkpoints[-1].train_cpu_s for run in result.runs])),
        difference=differences,
        folder=result.folder,
        environment=result.environment,
    )


def plan_variant(study: Study, task: str, variant: Variant) -> Planned:
    """The bench of a variant. Raises as :func:`.bench.plan`."""
    return plan(
        task,
        study.preset,
        agents=(variant.agent,),
        seeds=study.seeds,
        budgets=study.budgets,
        evaluation_episodes=study.evaluation_episodes,
        overrides=tuple(sorted(variant.settings.items())),
        **{**_FIGURES_ONLY, "execution": study.execution, "appearance": study.appearance, **variant.world},
    )


def _begun(root: Path, planned: Sequence[Planned]) -> list[Planned]:
    """Benches with their protocols as :func:`.bench_folder.as_begun` gives them."""
    return [(as_begun(root, protocol), encoders) for protocol, encoders in planned]


def imagined_right(rules: Rules, runs: Sequence[RunResult]) -> Floats:
    """Of each run and budget the share of macro-actions whose true outcome the agent's model expects; NaN without one.

    Shape (runs, budgets).
    """
    shares = [
        math.nan if row.beliefs is None else expected_rightly(rules, row.beliefs)
        for run in runs
        for row in run.checkpoints
    ]
    return np.array(shares).reshape(len(runs), -1)


# --- the suite ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class LevelResult:
    """The results of one agent in one level."""

    level: Level
    values: Floats  #: Success share, or AUROC, of each seed; NaN if it was not run. Shape (seeds,).
    benches: tuple[str, ...]  #: Task and folder of the bench of each seed, below the folder of all benches
    scale: Scale | None = None  #: None if nothing was run
    train_cpu_s: float = math.nan  #: Mean CPU seconds of training a run; NaN likewise
    environment: Mapping[str, Json] = field(default_factory=dict)  #: Of its first session; empty likewise


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
            return Estimate(math.nan)
        trials = self.suite.evaluation_episodes if experiment.measure == "success" else None
        return score(np.column_stack([each.values for each in found]), scales, trials=trials)


def plan_level(suite: Suite, level: Level, agent: str) -> list[Planned]:
    """The benches of a level and an agent, one a seed; an agent that cannot transfer has no earlier task.

    A learner that cannot take an unannounced change is refused: without it the level would be another, and easier. An
    encoder that does not exist yet is trained now. Raises as :func:`.bench.plan`.
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
    except UnableError:
        if "after" not in fields or (fields.get("unannounced") and registry.agent_entry(agent).learns):
            raise
        alone = {name: value for name, value in fields.items() if name not in _EARLIER_TASKS}
        whole, encoders = plan(level.task, "quick", **alone)
    return [(dataclasses.replace(whole, seeds=(seed,)), encoders) for seed in whole.seeds]


def run_suite(suite: Suite, agents: Sequence[str], *, root: Path, launcher: Launcher) -> SuiteResult:
    """Carry out the missing runs of a suite. A run that fails costs the others nothing. Raises as
    :func:`plan_level`.
    """
    require_different("agents", tuple(agents))
    plans = {
        (each.name, agent): [_begun(root, plan_level(suite, level, agent)) for level in each.levels]
        for each, agent in itertools.product(suite.experiments, agents)
    }
    planned = [bench for levels in plans.values() for level in levels for bench in level]
    failures, _ = carry_out(planned, root=root, launcher=launcher)
    results = {}
    for each, agent in itertools.product(suite.experiments, agents):
        pairs = zip(each.levels, plans[each.name, agent], strict=True)
        results[each.name, agent] = tuple(_level_result(each, level, planned, root) for level, planned in pairs)
    return SuiteResult(suite=suite, agents=tuple(agents), levels=results, failures=tuple(map(str, failures)))


def _level_result(experiment: Experiment, level: Level, planned: Sequence[Planned], root: Path) -> LevelResult:
    stores = [BenchStore(bench_folder(root, protocol), protocol) for protocol, _ in planned]
    benches = tuple(f"{store.folder.parent.name}/{store.folder.name}" for store in stores)
    if any(store.missing() for store in stores):
        return LevelResult(level=level, values=np.full(len(stores), math.nan), benches=benches)
    results = [load_so_far(store.folder) for store in stores]
    last = [run.checkpoints[-1] for result in results for run in result.runs]
    values = [auroc(each.open_loop) for each in last]
    scale = Scale(chance=0.5, optimum=1.0)
    if experiment.measure == "success":
        values = [each.success_rate for each in last]
        exact = results[0].certificate
        if exact is None:
            raise ArtefactError(f"{results[0].folder} has no certificate; remove the folder and run the suite again.")
        scale = Scale(chance=exact.chance_level, optimum=exact.optimum)
    return LevelResult(
        level=level,
        values=np.array(values),
        benches=benches,
        scale=scale,
        train_cpu_s=float(np.mean([each.train_cpu_s for each in last])),
        environment=results[0].environment,
    )
