"""Regression tasks, which are learned from data, as a type of task."""

from __future__ import annotations

from imagine_bench import registry
from imagine_bench.protocols.runs import TaskType
from imagine_bench.regression.protocol import PRESETS, RegressionProtocol, plan
from imagine_bench.regression.results import load_result
from imagine_bench.regression.runner import run

REGRESSION = TaskType(
    tasks=registry.regressions,
    learners=registry.regressors,
    draws=False,
    protocol=RegressionProtocol,
    presets=PRESETS,
    plan=plan,
    run=run,
    load_so_far=load_result,
)
