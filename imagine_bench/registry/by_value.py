"""A class or function of a script or a notebook as bytes, for processes that cannot import it, and its digest.

Code of ``__main__``, of a function's inside and of a module that a new process would not find travels by value, with
the constants and helper functions that it names. Code of any other module is imported there by its name.
"""

from __future__ import annotations

import builtins
import copyreg
import dis
import functools
import hashlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.machinery import PathFinder
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import cloudpickle
import numpy as np

from imagine_bench.errors import InvalidValueError, SetupError, brief, plain

_ADDRESS = re.compile(r" at 0x[0-9a-f]+", re.IGNORECASE)
_INSTALLED = ("site-packages", "dist-packages")
_NO_CODE = {
    "__module__",
    "__dict__",
    "__weakref__",
    "__doc__",
    "__slotnames__",
    "_abc_impl",
    "__annotations__",
    # since 3.13
    "__firstlineno__",
    "__static_attributes__",
    "__annotate_func__",
    "__annotations_cache__",
}
"""Attributes of a class that Python itself adds, or that change nothing that it does."""
_Cached = functools._lru_cache_wrapper
"""A function that remembers its results."""
_ATTRIBUTES: Mapping[type, tuple[str, ...]] = {
    CodeType: ("co_code", "co_consts", "co_names", "co_varnames", "co_freevars"),
    MethodType: ("__func__", "__self__"),
    ModuleType: ("__name__",),
    classmethod: ("__func__",),
    functools.cached_property: ("func",),
    functools.partial: ("func", "args", "keywords"),
    property: ("fget", "fset", "fdel"),
    staticmethod: ("__func__",),
    _Cached: ("__wrapped__",),
}
"""The attributes that decide about an object of one of Python's own types."""


@dataclass(frozen=True, repr=False)
class CodeByValue:
    """A class or function that any process can load."""

    name: str  #: its qualified name
    pickled: bytes = field(compare=False)  #: the bytes of :mod:`cloudpickle`, each time others
    digest: str  #: twelve hex digits, see :func:`code_digest`
    module: str = field(default="", compare=False)  #: its module where that is of an installed package
    home: str = field(default="", compare=False)  #: its module, whichever that is

    @classmethod
    def of(cls, target: Callable[..., Any]) -> CodeByValue:
        """Take up a class or function as it is now.

        Raises:
            InvalidValueError: It cannot be called, or an object that it names cannot be sent to another process.
        """
        if not callable(target):
            raise InvalidValueError(f"An agent is made by a class or a function; {brief(target)} is neither.")
        name = getattr(target, "__qualname__", type(target).__qualname__)
        try:
            with _unfindable_by_value():
                pickled = cloudpickle.dumps(target)
            digest = code_digest(target)
        except Exception as error:  # whatever the pickling of somebody's object raises
            why = plain(error).partition("\n")[0]
            raise InvalidValueError(
                f"{name} cannot be sent to worker processes ({type(error).__name__}: {why}). Let it make such objects "
                "itself, in its constructor, and keep them out of variables around it."
            ) from error
        module = str(getattr(target, "__module__", ""))
        return cls(name, pickled, digest, module if _is_of_package(module) else "", module)

    def __str__(self) -> str:
        return f"the code of {self.name}"

    def load(self) -> Any:
        """The class or function.

        Raises:
            SetupError: Its module has been changed since it was taken up.
        """
        target = cloudpickle.loads(self.pickled)
        module = sys.modules.get(target.__module__)
        is_imported = module is not None and module.__name__ != "__main__" and hasattr(module, self.name)
        if is_imported and code_digest(target) != self.digest:
            raise SetupError(
                f"The code of {self.name} in {target.__module__} was changed after this session had imported it. Start "
                "Python anew, or restart the notebook's kernel."
            )
        return target


def code_digest(target: object) -> str:
    """Twelve hex digits of the behaviour of a class or function: its bytecode, constants, bases and helpers.

    Comments, blank lines and docstrings of classes do not count, nor does the code of installed packages. Another
    minor version of Python has another bytecode.
    """
    return hashlib.sha256("\n".join(_described(target, {})).encode()).hexdigest()[:12]


@contextmanager
def _unfindable_by_value() -> Iterator[None]:
    """Let cloudpickle send by value the code of modules that a new process would not find."""
    theirs = {"__main__", *cloudpickle.list_registry_pickle_by_value()}
    modules = [
        module
        for name, module in list(sys.modules.items())
        if getattr(module, "__name__", "") == name and name not in theirs and not _is_installed(name)
        if PathFinder.find_spec(name.partition(".")[0]) is None
    ]
    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    copyreg.pickle(_Cached, _cached_by_value)
    try:
        yield
    finally:
        copyreg.dispatch_table.pop(_Cached, None)
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)


def _cached_by_value(function: _Cached[object]) -> str | tuple[Callable[..., _Cached[object]], tuple[object, ...]]:
    """A function with a cache as pickles have it: by its name, or where a new process would not find it by that, as its
    code and an empty cache.
    """
    name = getattr(function, "__qualname__", "")
    is_sent = function.__module__ in {"__main__", *cloudpickle.list_registry_pickle_by_value()}
    if not is_sent and getattr(sys.modules.get(function.__module__), name, None) is function:
        return name
    return functools.lru_cache(**function.cache_parameters()), (function.__wrapped__,)


def _described(value: object, seen: dict[int, tuple[int, object]]) -> Iterator[str]:
    """A value as lines of text that are the same in every process; ``seen`` are the objects so far, each with its place
    among them.
    """
    if value is None or isinstance(value, int | float | complex | str | bytes):
        yield repr(value)
        return
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        yield f"array {value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        return
    if isinstance(value, set | frozenset):
        yield from sorted("\n".join(_described(item, dict(seen))) for item in value)
        return
    if id(value) in seen:
        yield f"object {seen[id(value)][0]}"
        return
    seen[id(value)] = (len(seen), value)  # which keeps it, and so its id
    yield type(value).__qualname__
    for part in _parts(value):
        yield from _described(part, seen)
    if isinstance(value, tuple | list | Mapping):  # equal ones may be one object in one process and two in another
        del seen[id(value)]


def _parts(value: object) -> Iterator[object]:
    """The parts of an object, in an order that does not depend on the process."""
    attributes = next((names for kind, names in _ATTRIBUTES.items() if isinstance(value, kind)), ())
    if attributes:
        yield from (getattr(value, name) for name in attributes)
    elif isinstance(value, tuple | list):
        yield from value
    elif isinstance(value, Mapping):
        yield from (part for item in value.items() for part in item)
    elif isinstance(value, FunctionType | type):
        if _is_known(value):
            yield f"{value.__module__}:{value.__qualname__}"
        else:
            yield from _parts_of_class(value) if isinstance(value, type) else _parts_of_function(value)
    elif isinstance(value, SimpleNamespace) or (not _is_known(type(value)) and hasattr(value, "__dict__")):
        yield type(value)
        yield dict(sorted(vars(value).items()))
    elif not isinstance(value, Iterator):  # which goes on as it is used
        yield _ADDRESS.sub("", repr(value))


def _parts_of_class(value: type) -> Iterator[object]:
    yield value.__qualname__
    yield value.__bases__
    yield {name: part for name, part in sorted(vars(value).items()) if name not in _NO_CODE}


def _parts_of_function(value: FunctionType) -> Iterator[object]:
    yield from (value.__code__, value.__defaults__, value.__kwdefaults__)
    yield from (cell.cell_contents for cell in value.__closure__ or ())
    found = {name: value.__globals__[name] for name in sorted(_globals(value.__code__)) if name in value.__globals__}
    yield found
    yield from _parts_of_modules(found, _names(value.__code__))


def _parts_of_modules(found: Mapping[str, object], names: set[str]) -> Iterator[object]:
    """The parts of the user's own modules among the found objects, and of modules in these, that code may mean by its
    names.
    """
    waiting = list(found.values())
    done = list[ModuleType]()
    while waiting:
        module = waiting.pop()
        if isinstance(module, ModuleType) and module not in done and not _is_installed(module.__name__):
            done.append(module)
            named = {name: vars(module)[name] for name in sorted(names & vars(module).keys())}
            yield named
            waiting += named.values()


def _globals(code: CodeType) -> set[str]:
    """The names of variables outside that code reads, in its inner functions too."""
    names = {str(step.argval) for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
    return names.union(*map(_globals, _inner(code)))


def _names(code: CodeType) -> set[str]:
    """The names of variables outside and of attributes that code reads, in its inner functions too."""
    return {*code.co_names}.union(*map(_names, _inner(code)))


def _inner(code: CodeType) -> list[CodeType]:
    """The code of the functions that are made in a function."""
    return [each for each in code.co_consts if isinstance(each, CodeType)]


def _is_installed(module: str | None) -> bool:
    """Whether a module is Python's own, of this package or of another installed one, and not the user's."""
    if module is None or module == "__main__":
        return False
    top = module.partition(".")[0]
    return top == "imagine_bench" or top in sys.stdlib_module_names or _is_of_package(module)


def _is_of_package(module: str) -> bool:
    """Whether a module lies where packages are installed."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return file is not None and any(folder in Path(file).parts for folder in _INSTALLED)


def _is_known(value: type | FunctionType) -> bool:
    """Whether a class or function is of an installed module; code without a module is said to be in ``builtins``."""
    if value.__module__ == "builtins":
        return hasattr(builtins, value.__qualname__)
    return _is_installed(value.__module__)
