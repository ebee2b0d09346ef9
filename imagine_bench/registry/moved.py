"""Old import paths of modules and of single names keep working, and warn once in each process."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class _MovedModules(MetaPathFinder, Loader):
    """Finds a module by its old path and fills it with the names of the new one."""

    def __init__(self, moved: Mapping[str, str], names: Mapping[str, str]) -> None:
        self._moved = moved
        self._names = names

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, is_package=True) if fullname in self._moved else None

    def exec_module(self, module: ModuleType) -> None:
        new = self._moved[module.__name__]
        _warn(module.__name__, new)
        names = vars(importlib.import_module(new))
        module.__dict__.update({name: value for name, value in names.items() if not name.startswith("__")})
        find_old_names(module, self._names)


def keep_old_paths(moved: Mapping[str, str], names: Mapping[str, str]) -> None:
    """Let Python find modules and names by their old paths; a second call changes nothing.

    Args:
        moved: The new path of each module that moved, by its old one.
        names: The new ``"module:name"`` of each name, by its old one. Its old module is a moved one, or is loaded.
    """
    if any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        return
    sys.meta_path.append(_MovedModules(moved, names))
    for module in {old.partition(":")[0] for old in names} - moved.keys():
        find_old_names(sys.modules[module], names)


def find_old_names(module: ModuleType, names: Mapping[str, str]) -> None:
    """Give a module the names that it had, which ``names`` maps as for :func:`keep_old_paths`."""

    def find(name: str) -> object:
        old = f"{module.__name__}:{name}"
        if old not in names:
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        _warn(old, names[old])
        new, _, attribute = names[old].partition(":")
        found = getattr(importlib.import_module(new), attribute)
        setattr(module, name, found)
        return found

    vars(module)["__getattr__"] = find


def _warn(old: str, new: str) -> None:
    message = f"{old} is now {new}; import it from there. The old path goes in version 1.0."
    warnings.warn(message, DeprecationWarning, stacklevel=3)
