"""Objects by ``"module:attr"``, and the errors of other packages whose code cannot be loaded.

Processes that carry out the runs of a script or a notebook do not import it: they are handed its registry lines.
"""

from __future__ import annotations

import dataclasses
import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

from imagine_bench.errors import EXTRAS, ImagineBenchError, SetupError, lacking, plain
from imagine_bench.registry.builtin import AGENTS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS
from imagine_bench.registry.by_value import CodeByValue

Registered = Sequence[dict[str, Any]]
_TABLES: Registered = (AGENTS, REGRESSIONS, REGRESSORS, TASKS, WORLD_MODELS)
_HERE = "__main__:"
_LOADING: ContextVar[str] = ContextVar("_LOADING", default="")


def load(target: str | CodeByValue) -> Any:
    """The object that ``"module:attr"`` names, the module that ``"module"`` names, or one that was sent by value.

    Raises:
        SetupError: It needs an extra of this package that is not installed.
        ImportError: Its import ends Python, as ``sys.exit`` does.
        AttributeError: The module has no such object; the message says where a folder is taken for the module.
    """
    if isinstance(target, CodeByValue):
        with _importing(target.name):
            return target.load()
    module, _, attribute = target.partition(":")
    with _importing(module):
        found = importlib.import_module(module)
    try:
        return attrgetter(attribute)(found) if attribute else found
    except AttributeError as error:
        raise AttributeError(f"module {module} has no attribute {attribute!r}{_hidden(found)}") from error


@contextmanager
def _importing(module: str) -> Iterator[None]:
    """The block imports a module. Errors as of :func:`load`; a command that begins meanwhile is refused."""
    before = _LOADING.set(module)
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        raise lacking(error.name) from error
    except (Exception, KeyboardInterrupt):
        raise
    except BaseException as error:  # such as SystemExit, which nobody above would take for a failure
        raise ImportError(f"it ends Python when it is imported: {error!r}") from error
    finally:
        _LOADING.reset(before)


def _hidden(module: ModuleType) -> str:
    """A hint for an error about a module that is only a folder, without code, or about a worker's ``__main__``."""
    if module.__name__ == "__main__":
        return ": worker processes cannot import a notebook or standard input; write the code to a file and name that"
    if getattr(module, "__file__", None) is not None:
        return ""
    folder = next(iter(module.__path__))
    return f", as the folder {folder} hides it: start Python in another folder, or rename or move that one"


def refuse_while_loading() -> None:
    """Raise SetupError if :func:`load` imports a module at the moment, whose import begins a command."""
    module = _LOADING.get()
    if module:
        raise SetupError(
            f"{module} runs a command when it is imported, and worker processes import it. Write the line "
            "'if __name__ == \"__main__\":' above the call."
        )


def fault(error: BaseException) -> str:
    """Type and message of an error in the code of another package, on one line."""
    return f"{type(error).__name__}: {plain(error)}".partition("\n")[0]


@contextmanager
def guests_faults(what: str, target: str) -> Iterator[None]:
    """Whatever code of another package does wrong is one sentence; of this suite's own a traceback says more."""
    try:
        yield
    except ImagineBenchError:
        raise
    except (Exception, SystemExit) as error:
        if target.startswith("imagine_bench."):
            raise
        why = fault(error)
        remedy = "mend or uninstall its package" if ":" in target else "mend it, and register it again"
        raise SetupError(f"{what} ({target}) cannot be used ({why}); {remedy}.") from error


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
