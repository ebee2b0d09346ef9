"""Regression tasks, which are learned from data, as a type of task."""

from __future__ import annotations

from pathlib import Path

from imagine_bench import registry
from imagine_bench.protocols.runs import OnProgress, RunSpec
from imagine_bench.protocols.task_types import TaskType
from imagine_bench.regression.protocol import PRESETS, RegressionProtocol, plan
from imagine_bench.regression.results import RegressionResult, RegressionRun, load_run
from imagine_bench.store.bench_folder import load_bench


def run(spec: RunSpec[RegressionProtocol], folder: Path, on_progress: OnProgress) -> RegressionRun:
    """Do a run; see :func:`.runner.run`."""
    from imagine_bench.regression import runner  # noqa: PLC0415 - scipy loads slowly

    return runner.run(spec, folder, on_progress)


REGRESSION = TaskType(
    tasks=registry.REGRESSIONS,
    learners=lambda: registry.REGRESSORS,
    draws=False,
    protocol=RegressionProtocol,
    presets=PRESETS,
    plan=plan,
    run=run,
    load_run=load_run,
    load_so_far=load_bench,
    result=RegressionResult,
)
