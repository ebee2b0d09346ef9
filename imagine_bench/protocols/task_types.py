"""The types of task, and what each brings to the one machinery.

A *control* task is acted in, by agents that learn from episodes; a *regression* task is learned from data, by
regressors. Launchers, locks, run folders, progress, store and command line are the same for both.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar
from typing import Protocol as Interface

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, SetupError, UnknownNameError
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import OnProgress, RunSpec

P = TypeVar("P", bound=ProtocolData)
Encoders = Mapping[str, Path]
"""The encoder artefacts of a bench, by kind, none where nothing needs one, and its ``"dataset"``, a folder."""


class FinishedRun(Interface):
    """What runs of every type leave."""

    @property
    def recording(self) -> Path | None:
        """Its Rerun recording, or None."""


class Result(Interface):
    """What benches of every type measured: one run an agent and seed, in a folder."""

    @property
    def runs(self) -> Sequence[FinishedRun]:
        """One an agent and seed."""

    @property
    def folder(self) -> Path:
        """Where the bench's files lie."""


@dataclass(frozen=True, kw_only=True)
class TaskType(Generic[P]):
    """What a type of task brings along."""

    tasks: Callable[[], Mapping[str, object]]  #: Gives its tasks, by name
    learners: Callable[[], Mapping[str, object]]  #: Gives its agents or regressors, by name
    draws: bool  #: Whether its runs need OpenGL
    protocol: type[P]  #: The class of its protocols
    presets: Mapping[str, Mapping[str, Any]]  #: What each protocol preset changes, by name
    #: Makes a protocol from a task, a preset and changes to single fields, all checked, and finds its encoders.
    plan: Callable[..., tuple[P, Encoders]]
    run: Callable[[RunSpec[P], Path, OnProgress], object]  #: Carries out a run in a folder
    load_run: Callable[[Path], FinishedRun]  #: Reads a finished run folder
    load_so_far: Callable[[Path], Result]  #: Reads a bench folder, as far as it can be reported
    result: Callable[..., Result]  #: Class of a finished bench


@functools.cache
def task_types() -> dict[str, TaskType[ProtocolData]]:
    """The types by name."""
    return {name: registry.load(target) for name, target in registry.TASK_TYPES.items()}


def task_type(task: str) -> TaskType[ProtocolData]:
    """The type of a task, be it with options or without.

    Raises UnknownNameError, or SetupError: as :func:`.registry.task_entry`.
    """
    for kind in task_types().values():
        if task in kind.tasks() or task.partition(":")[0] in kind.tasks():
            return kind
    for group in (registry.TASK_GROUP, registry.REGRESSION_GROUP):
        if isinstance(error := registry.offers(group).get(task), SetupError):
            raise error
    raise UnknownNameError("task", task, [name for kind in task_types().values() for name in kind.tasks()])


def type_of(protocol: ProtocolData) -> TaskType[ProtocolData]:
    """The type of a protocol's task, be its package here or not."""
    return next(kind for kind in task_types().values() if isinstance(protocol, kind.protocol))


def read_as(data: Mapping[str, Any]) -> ProtocolData:
    """A protocol from what :meth:`.ProtocolData.as_dict` gave; where its task is of a package that is not here, its
    fields say of which type it is. Raises as :func:`task_type` and the protocol.
    """
    try:
        kind = task_type(data["task"])
    except (UnknownNameError, SetupError):
        fields = {name: {field.name for field in dataclasses.fields(k.protocol)} for name, k in task_types().items()}
        if not data.keys() <= fields["control"]:
            raise
        kind = task_types()["control"]
    return kind.protocol.from_dict(dict(data))


def require_options(task: str, options: Mapping[str, Any]) -> None:
    """Raise InvalidValueError for an option that protocols of this task's type do not have."""
    fields = [field.name for field in dataclasses.fields(task_type(task).protocol)]
    for name in options:
        if name not in fields:
            raise InvalidValueError(f"{task} takes no --{name.replace('_', '-')}; leave it out.")
