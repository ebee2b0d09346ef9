"""Options and helpers that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from imagine_bench.errors import InvalidValueError
from imagine_bench.registry import task_name
from imagine_bench.running.task_types import task_type
from imagine_bench.store.bench_folder import require_either

PRESETS_OWN = "(default: the preset's)"


def shown(metavar: str, hint: str = PRESETS_OWN) -> Any:
    """How an option is shown that takes a value."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint)


def listed(kind: str, hint: str = PRESETS_OWN) -> Any:
    """How an option is shown that takes one or more values of a kind."""
    return shown(f"{kind} [{kind} ...]", hint)


NEWEST, ANY = shown("[PATH]", "(default: the newest)"), shown("STR", "(default: any)")


def require_values(name: str, values: Sequence[object] | None) -> None:
    """Raise InvalidValueError for an option that takes a list and was given without a value."""
    if values is not None and (not values or "" in values):
        raise InvalidValueError(f"--{name} has no value; give at least one behind it, or leave it out.")


def added_up(name: str, each: Sequence[Sequence[Any]]) -> tuple[Any, ...]:
    """All values of an option that may be given several times, or InvalidValueError where it has none."""
    for values in each:
        require_values(name, values)
    return tuple(value for values in each for value in values)


def only(task: str | None, given: Path | None) -> tuple[str, ...]:
    """A task by itself, or none for any. Raises UnknownNameError, or InvalidValueError where a path is given too."""
    require_either(given, task)
    if task is None:
        return ()
    task_type(task)  # knows every name
    return (task_name(task),)
