"""Regression tasks, which are learned from data, as a type of task."""

from __future__ import annotations

from imagine_bench import registry
from imagine_bench.protocols.task_types import TaskType
from imagine_bench.regression.protocol import PRESETS, RegressionProtocol, plan
from imagine_bench.regression.results import RegressionResult, load_run
from imagine_bench.regression.runner import run
from imagine_bench.store.bench_folder import load_bench

REGRESSION = TaskType(
    tasks=registry.regressions,
    learners=registry.regressors,
    draws=False,
    protocol=RegressionProtocol,
    presets=PRESETS,
    plan=plan,
    run=run,
    load_run=load_run,
    load_so_far=load_bench,
    result=RegressionResult,
)
