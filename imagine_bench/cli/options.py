"""Options and helpers that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from imagine_bench import registry
from imagine_bench.cli.observers import Observed
from imagine_bench.errors import InvalidValueError
from imagine_bench.protocols.runs import Launcher
from imagine_bench.running.launchers.jobs import launcher
from imagine_bench.running.task_types import task_type
from imagine_bench.store.bench_folder import require_either

T = TypeVar("T")
Repeated = tyro.conf.UseAppendAction[tuple[tuple[T, ...], ...]]
"""An option that takes one or more values, and may be given several times."""
PRESETS_OWN = "(default: the preset's)"


def shown(metavar: str, hint: str = PRESETS_OWN) -> object:
    """How the help shows an option that takes a value."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint)


def listed(kind: str, hint: str = PRESETS_OWN) -> object:
    """How the help shows an option that takes one or more values of a kind."""
    return shown(f"{kind} [{kind} ...]", hint)


TaskWord = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
"""A task as the first word; ``--task TASK`` is the same."""
MaybeTaskWord = Annotated[str | None, tyro.conf.Positional, shown("[TASK]", "(default: none)")]
"""The same for commands that may have none."""
FolderOrTask = Annotated[Path | None, tyro.conf.Positional, shown("[PATH|TASK]", "(default: the newest)")]
"""A path as the first word, or a task."""
OfTask = Annotated[str | None, shown("STR", "(default: any)")]
MaybeInt = Annotated[int | None, shown("INT")]
MaybeEncoder = Annotated[str | None, shown("NAME|FILE", "(default: the run's, if bundled)")]


@dataclass(frozen=True, kw_only=True)
class Launch:
    """Options of where runs are carried out."""

    workers: Annotated[int | None, shown("INT", "(default: one a core)")] = None
    """Processes at a time."""
    launcher: str = "local"
    """Where runs are carried out: local, ray (the cluster at RAY_ADDRESS, else one started here) or slurm."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def chosen(self) -> Launcher:
        """The launcher. Raises UnknownNameError, InvalidValueError: no such one, or no worker."""
        return Observed(launcher(self.launcher, self.workers))


def require_values(name: str, values: Sequence[object] | None) -> None:
    """Raise InvalidValueError for an option that takes a list and was given without a value."""
    if values is not None and (not values or "" in values):
        raise InvalidValueError(f"--{name} has no value; give at least one behind it, or leave it out.")


def added_up(name: str, each: Sequence[Sequence[T]]) -> tuple[T, ...]:
    """All values of an option that may be given several times, or InvalidValueError if it has none."""
    for values in each:
        require_values(name, values)
    return tuple(value for values in each for value in values)


def path_or_task(word: Path | None, task: str | None) -> tuple[Path | None, str | None]:
    """A command's first word as a path or as a task, whichever it names, and the task of ``--task``.

    Raises:
        UnknownNameError: No such task.
        InvalidValueError: A path and a task are given.
    """
    is_task = (
        word is not None and not word.exists() and (registry.has_task(str(word)) or str(word) in registry.regressions())
    )
    if is_task and task is None:
        return None, str(word)
    require_either(word, task)
    if task is not None:
        task_type(task)  # knows every name
    return word, task


def only(task: str | None) -> tuple[str, ...]:
    """A task's canonical name by itself, or nothing for any task."""
    return () if task is None else (registry.task_name(task),)
