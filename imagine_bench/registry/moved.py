"""Old import paths of modules and of single names keep working, and warn once in each process."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from imagine_bench.registry.builtin import guests


class _OldPaths(MetaPathFinder, Loader):
    """Finds modules by their old paths and fills them with the names of the new ones."""

    def __init__(self, moved: Mapping[str, str]) -> None:
        self.moved = moved

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, is_package=True) if fullname in self.moved else None

    def exec_module(self, module: ModuleType) -> None:
        names = vars(self.new(module.__name__))
        module.__dict__.update({name: value for name, value in names.items() if not name.startswith("__")})
        self.find_names(module)

    def find_names(self, module: ModuleType) -> None:
        """Give a module the single names that it had."""

        def find(name: str) -> object:
            old = f"{module.__name__}:{name}"
            if old not in self.moved:
                raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
            found = getattr(self.new(old), self.moved[old].partition(":")[2])
            setattr(module, name, found)
            return found

        vars(module)["__getattr__"] = find

    def new(self, old: str) -> ModuleType:
        """The module in which it lies now, after a warning.

        Raises ModuleNotFoundError: it is in a guest package that is not installed; the message says how to install it.
        """
        message = f"{old} is now {self.moved[old]}; import it from there. The old path goes in version 1.0."
        warnings.warn(message, DeprecationWarning, stacklevel=3)
        try:
            return importlib.import_module(self.moved[old].partition(":")[0])
        except ModuleNotFoundError as error:
            for guest in guests():
                if error.name == guest.module:
                    lacks = f"{old} is now in the package {guest.package}, which is not installed."
                    raise ModuleNotFoundError(f"{lacks} Install it with: {guest.install}", name=error.name) from error
            raise


class _Package(ModuleType):
    """A package whose functions are loaded when they are first used.

    They stay when a module is imported by an old path of the same name.
    """

    LAZY: Mapping[str, str]  #: the ``"module:name"`` of each, which the package itself says

    def __getattr__(self, name: str) -> object:
        if name not in self.LAZY:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        module, _, function = self.LAZY[name].partition(":")
        found = getattr(importlib.import_module(module), function)
        setattr(self, name, found)
        return found

    def __setattr__(self, name: str, value: object) -> None:
        if not (isinstance(value, ModuleType) and name in self.LAZY):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*vars(self), *self.LAZY})


def keep_old_paths(package: str, moved: Mapping[str, str]) -> None:
    """Let Python find modules of a package, and names in them, by their old paths; a second call changes nothing.

    Args:
        package: The package's name.
        moved: The new path of each module that moved, by its old one, and the new ``"module:name"`` of each name, by
            its old one, whose module is a moved one or is loaded.
    """
    if any(isinstance(finder, _OldPaths) for finder in sys.meta_path):
        return
    paths = _OldPaths(moved)
    sys.meta_path.insert(0, paths)  # a folder that is left of a module that moved is none
    sys.modules[package].__class__ = _Package
    for module in {old.partition(":")[0] for old in moved} & sys.modules.keys():
        paths.find_names(sys.modules[module])
