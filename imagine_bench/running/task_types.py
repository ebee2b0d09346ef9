"""The types of task: how a task, a protocol or a bench folder finds the one that it is of.

A *control* task is acted in, by agents that learn from episodes; a *regression* task is learned from data, by
regressors. Launchers, locks, run folders, progress, store and command line are the same for both.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError, SetupError, UnknownNameError
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import Result, TaskType
from imagine_bench.store import loading
from imagine_bench.store.bench_folder import is_archive, read_protocol_as, read_protocol_values
from imagine_bench.values import Setting

TASK_TYPES = {
    "control": "imagine_bench.running.control:CONTROL",
    "regression": "imagine_bench.regression.runner:REGRESSION",
}
"""The types of task, each the ``"module:attr"`` of a :class:`.TaskType`."""


@functools.cache
def task_types() -> dict[str, TaskType[ProtocolData]]:
    """Return the types by name."""
    return {name: registry.load(target) for name, target in TASK_TYPES.items()}


def task_type(task: str) -> TaskType[ProtocolData]:
    """Return the type of a task, be it with options or without.

    Raises UnknownNameError, or SetupError: as :func:`.registry.task_entry`.
    """
    for kind in task_types().values():
        if task in kind.tasks() or task.partition(":")[0] in kind.tasks():
            return kind
    for group in (registry.TASK_GROUP, registry.REGRESSION_GROUP):
        if isinstance(error := registry.offers(group).get(task), SetupError):
            raise error
    raise UnknownNameError("task", task, [name for kind in task_types().values() for name in kind.tasks()])


def field_names(kind: TaskType[ProtocolData]) -> set[str]:
    """Return the names of the values that protocols of a type have."""
    return {field.name for field in dataclasses.fields(kind.protocol)}


def type_of(values: Mapping[str, Setting]) -> TaskType[ProtocolData]:
    """Return the type of a protocol by its values, be the package of its task here or not.

    Raises ValueError: no type has protocols of such values.
    """
    for kind in task_types().values():
        if values.keys() <= field_names(kind):
            return kind
    raise ValueError("it has values of no type of task")


def read_protocol(folder: Path) -> ProtocolData:
    """Return the protocol of a bench folder. Raises ArtefactError: it is missing or damaged."""
    return read_protocol_as(folder, bench_type(folder).protocol)


def bench_type(folder: Path) -> TaskType[ProtocolData]:
    """Return the type of a bench folder's task. Raises ArtefactError: it is no bench, or its protocol is damaged."""
    values = read_protocol_values(folder)
    try:
        return type_of(values)
    except ValueError as error:
        raise ArtefactError(f"{folder} is no bench of this version: {error}. It was left untouched.") from error


def load_so_far(folder: Path) -> Result:
    """Read a bench as far as it can be reported, finished or not, or in the form in which it is kept for good.

    Raises:
        ArtefactError: It is no bench, there is nothing to report yet, a file is damaged, or it is kept for good and of
            a regression task, whose tables are files of their own.
    """
    return loading.load_so_far(folder) if is_archive(folder) else bench_type(folder).load_so_far(folder)


def load_bench(folder: Path) -> Result:
    """Read a finished bench. Raises ArtefactError: it is no bench, runs are missing, or a file is damaged."""
    result = load_so_far(folder)
    if result.missing:
        raise ArtefactError(
            f"{folder} lacks {'; '.join(result.missing)}. Run the same bench command again to complete it."
        )
    return result


def require_options(task: str, options: Mapping[str, Setting]) -> None:
    """Raise InvalidValueError for an option that protocols of this task's type do not have."""
    names = field_names(task_type(task))
    for name in options:
        if name not in names:
            raise InvalidValueError(f"{task} takes no --{name.replace('_', '-')}; leave it out.")
