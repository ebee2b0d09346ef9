"""The kinds of task, and what each brings to the one machinery.

A *control* task is acted in, by agents that learn from episodes; a *regression* task is learned from data, by
regressors. Launchers, locks, run folders, progress, store and command line are the same for both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, UnknownNameError


@dataclass(frozen=True, kw_only=True)
class TaskType:
    """What a kind of task brings along; all but the tables as ``"module:attr"``.

    Attributes:
        tasks: Its registered tasks.
        learners: Function that gives its agents or regressors, by name.
        draws: Whether its runs need OpenGL.
        protocol: The class of its protocols.
        presets: What each protocol preset changes, by name.
        plan: Function from task, preset and options to a protocol and the encoders it needs, by kind.
        run: Function that carries out a RunSpec in a folder.
        load_run: Function that reads a finished run folder.
        load_so_far: Function that reads a bench folder, as far as it can be reported.
        result: Class of a finished bench.
        write_report: Function that writes a bench's report.
        summary_table: Function that gives its table as text.
    """

    tasks: Mapping[str, Any]
    learners: Callable[[], Mapping[str, Any]]
    draws: bool
    protocol: str
    presets: str
    plan: str
    run: str
    load_run: str
    load_so_far: str
    result: str
    write_report: str
    summary_table: str


TASK_TYPES: dict[str, TaskType] = {
    "control": TaskType(
        tasks=registry.TASKS,
        learners=registry.agents,
        draws=True,
        protocol="imagine_bench.bench.protocol:Protocol",
        presets="imagine_bench.bench.protocol:PRESETS",
        plan="imagine_bench.bench.bench:plan_control",
        run="imagine_bench.bench.runner:run",
        load_run="imagine_bench.store.run_folder:load_run",
        load_so_far="imagine_bench.store.partial:load_so_far",
        result="imagine_bench.store.results:BenchResult",
        write_report="imagine_bench.report:write_report",
        summary_table="imagine_bench.report:summary_table",
    ),
    "regression": TaskType(
        tasks=registry.REGRESSIONS,
        learners=lambda: registry.REGRESSORS,
        draws=False,
        protocol="imagine_bench.regression.protocol:RegressionProtocol",
        presets="imagine_bench.regression.protocol:PRESETS",
        plan="imagine_bench.regression.protocol:plan",
        run="imagine_bench.regression.runner:run",
        load_run="imagine_bench.regression.results:load_run",
        load_so_far="imagine_bench.store.bench_folder:load_bench",
        result="imagine_bench.regression.results:RegressionResult",
        write_report="imagine_bench.regression.report:write_report",
        summary_table="imagine_bench.regression.report:summary_table",
    ),
}


def task_type(task: str) -> TaskType:
    """The kind of a registered task.

    Raises:
        UnknownNameError: No such task; the message lists those of every kind.
    """
    for kind in TASK_TYPES.values():
        if task in kind.tasks:
            return kind
    raise UnknownNameError("task", task, [name for kind in TASK_TYPES.values() for name in kind.tasks])


def require_options(task: str, options: Mapping[str, Any]) -> None:
    """Raise InvalidValueError for an option that protocols of this task's kind do not have."""
    fields = [field.name for field in dataclasses.fields(registry.load(task_type(task).protocol))]
    for name in options:
        if name not in fields:
            raise InvalidValueError(f"{task} takes no --{name.replace('_', '-')}; leave it out.")
