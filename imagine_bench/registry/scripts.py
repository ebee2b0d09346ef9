"""The registry lines of a script or a notebook, for the processes that carry out its runs and do not import it."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from imagine_bench.registry.builtin import AGENTS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS

_TABLES: Sequence[dict[str, Any]] = (AGENTS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS)
_HERE = "__main__:"
Registered = Sequence[dict[str, Any]]


def registered() -> Registered:
    """All that is registered in this process, with the name of the script's module for ``__main__``."""
    script = f"{_script()}:"
    return [{name: _loadable(entry, script) for name, entry in table.items()} for table in _TABLES]


def register(there: Registered) -> None:
    """Add the registry lines of another process to those of this process."""
    for table, entries in zip(_TABLES, there, strict=True):
        table.update(entries)


def importable(target: str) -> str:
    """A ``"module:attr"``, with the name of the script's module for ``__main__``."""
    found: str = _loadable(target, f"{_script()}:")
    return found


def _loadable(entry: Any, script: str) -> Any:
    """An entry, with the name of the script's module for ``__main__``."""
    if isinstance(entry, str):
        return script + entry.removeprefix(_HERE) if entry.startswith(_HERE) else entry
    targets = {key: value for key, value in vars(entry).items() if str(value).startswith(_HERE)}
    return dataclasses.replace(entry, **{key: _loadable(value, script) for key, value in targets.items()})


def _script() -> str:
    """The name by which another process can import the script that this process runs; of a notebook ``__main__``."""
    main = sys.modules["__main__"]
    if main.__spec__ is not None:  # of python -m
        return main.__spec__.name
    path = Path(getattr(main, "__file__", None) or "")
    return path.stem if path.is_file() else "__main__"


@contextmanager
def script_left_out() -> Iterator[None]:
    """Processes that are spawned meanwhile do not import the script that this process runs."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
