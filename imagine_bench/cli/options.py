"""Options and helpers that several commands share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, is_dataclass
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Annotated, TypeVar

import tyro

from imagine_bench import registry
from imagine_bench.cli.observers import Observed
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import DEVICES, EXECUTIONS
from imagine_bench.protocols.data import Launcher
from imagine_bench.running.bench import task_type
from imagine_bench.running.launchers.jobs import LAUNCHERS, launcher
from imagine_bench.store.bench_folder import require_either

T = TypeVar("T")
Repeated = tyro.conf.UseAppendAction[tuple[tuple[T, ...], ...]]
"""An option that takes one or more values, and may be given several times."""


def shown(metavar: str) -> object:
    """How the help shows an option that may be left out; its description says the effect."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="(optional)")


def one_of(*choices: str) -> object:
    """How the help shows an option with few possible values."""
    return tyro.conf.arg(metavar=f"{{{','.join(choices)}}}")


TaskWord = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
"""A task as the first word; ``--task TASK`` is the same."""
MaybeTaskWord = Annotated[str | None, tyro.conf.Positional, shown("[TASK]")]
"""The same for commands that may have none."""
FolderOrTask = Annotated[Path | None, tyro.conf.Positional, shown("[PATH|TASK]")]
"""A path as the first word, or a task."""
Word = Annotated[str | None, shown("STR")]
Words = Annotated[tuple[str, ...] | None, shown("STR [STR ...]")]
ManyWords = Annotated[Repeated[str], shown("STR [STR ...]")]
Number = Annotated[float | None, shown("FLOAT")]
Count = Annotated[int | None, shown("INT")]
Counts = Annotated[tuple[int, ...] | None, shown("INT [INT ...]")]
File = Annotated[Path | None, shown("PATH")]
ExecutionWord = Annotated[str | None, shown(f"{{{','.join(EXECUTIONS)}}}")]
DeviceWord = Annotated[str, one_of(*DEVICES)]
EncoderWord = Annotated[str | None, shown("NAME|FILE")]
"""Options that may be left out."""


def demonstrations() -> ModuleType:
    """The plug-in's module that collects, describes, verifies and records demonstrations of continuous control.

    Raises:
        SetupError: The plug-in is not installed; the message says how to install it.
    """
    registry.require_guest(registry.MOTION, "A dataset of continuous control")
    module: ModuleType = registry.load("imagine_bench_motion.control.datasets")
    return module


@dataclass(frozen=True, kw_only=True)
class Launch:
    """Options of where runs are carried out."""

    workers: Count = None
    """Processes at a time; one a core by default."""
    launcher: Annotated[str, one_of(*LAUNCHERS)] = "local"
    """Where runs are carried out: in processes of this machine, on a Ray cluster (that at RAY_ADDRESS, else one started
    here), on a Slurm cluster, or one after another in this process (for a debugger)."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def chosen(self) -> Launcher:
        """The launcher. Raises UnknownNameError, InvalidValueError: no such one, or no worker."""
        return Observed(launcher(self.launcher, self.workers))


@dataclass(frozen=True, kw_only=True)
class OfBench:
    """Options of the bench that is meant."""

    folder: FolderOrTask = None
    """The bench's folder, or a task whose newest bench is taken."""
    task: Word = None
    """Task whose newest bench is taken; without it and a folder, the newest of all."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def meant(self, *, writes: bool = False) -> tuple[Path | None, str | None]:
        """The path that was given, and the task, by its canonical name; a first word that is a task is that.

        ``writes`` says whether something is written into the folder of all benches.

        Raises:
            UnknownNameError: No such task.
            InvalidValueError: A path and a task are given, or a path and a folder of all benches that is not needed.
        """
        word = self.folder
        task = self.task
        name = str(word)
        is_task = registry.has_task(name) or name in registry.regressions()
        if word is not None and task is None and not word.exists() and is_task:
            word = None
            task = name
        require_either(word, task)
        if word is not None and self.out != OfBench.out and not writes:
            raise InvalidValueError(f"{word} is given, so none is looked for in --out {self.out}; leave one out.")
        if task is not None:
            task_type(task)  # knows every name
            task = registry.task_name(task)
        return word, task


def require_values(command: object) -> None:
    """Raise InvalidValueError for an option of a command that takes a list and was given without a value."""
    for name, value in vars(command).items():
        if is_dataclass(value):
            require_values(value)
        elif isinstance(value, tuple) and value != getattr(type(command), name):
            each = value if value and isinstance(value[0], tuple) else (value,)
            if any(not values or "" in values for values in each):
                raise InvalidValueError(f"--{name} has no value; give at least one behind it, or leave it out.")


def require_with(with_option: str, command: object, *names: str) -> None:
    """Raise InvalidValueError for options of a command that were given without the option that they go with."""
    for name in names:
        if getattr(command, name) != getattr(type(command), name):
            option = name.replace("_", "-")
            raise InvalidValueError(f"--{option} goes with {with_option}; leave it out, or give {with_option} too.")


def added_up(each: Iterable[Iterable[T]]) -> tuple[T, ...]:
    """All values of an option that may be given several times."""
    return tuple(chain.from_iterable(each))
