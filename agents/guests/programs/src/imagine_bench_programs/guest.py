"""The process of a program: the file is carried out here, and its function is asked.

A program may compute, and import the modules of :data:`ALLOWED`. Its ``import`` is a checked one. An audit hook,
which code cannot take away again, refuses it files, processes, threads, sockets, the C library and modules that are
not loaded yet.
"""

from __future__ import annotations

import builtins
import contextlib
import importlib
import inspect
import io
import math
import sys
from collections.abc import Hashable, Iterator, Mapping, Sequence
from importlib.abc import InspectLoader
from types import ModuleType
from typing import Any

import numpy as np

from imagine_bench.errors import InvalidValueError, brief
from imagine_bench.interfaces import Arrays

ALLOWED = (
    "bisect", "collections", "collections.abc", "copy", "dataclasses", "enum", "fractions", "functools", "heapq",
    "itertools", "math", "numpy", "operator", "re", "statistics", "string", "typing",
)  # fmt: skip
"""Modules that a program may import."""
_PARTS = ("numpy.linalg", "numpy.random")
_REFUSED = ("_thread.", "ctypes.", "fcntl.", "mmap.", "os.", "pty.", "shutil.", "signal.", "socket.", "subprocess.")
_REFUSED_IMPORT = f"it imports {{name}}; a program may import {', '.join(ALLOWED)}."
FUNCTION = "outcomes"
"""The name of a program's function."""


class _Text(InspectLoader):
    """Carries out the text of a module."""

    def __init__(self, source: str) -> None:
        self._source = source

    def get_source(self, fullname: str) -> str:
        """The text."""
        return self._source


class ServedProgram:
    """A program, as :class:`imagine_bench.running.isolation.Isolated` serves it.

    ``source`` is the text of the file.

    Raises:
        InvalidValueError: It has no function of the name, or does something that is refused.
    """

    def __init__(self, source: str) -> None:
        for name in (*ALLOWED, *_PARTS):
            importlib.import_module(name)
        sys.addaudithook(_refuse)
        module = sys.modules["program"] = ModuleType("program")
        module.__dict__["__builtins__"] = {**vars(builtins), "__import__": _import}
        with _silent():
            _Text(source).exec_module(module)
        self._function = getattr(module, FUNCTION, None)
        if not inspect.isfunction(self._function):
            raise InvalidValueError(f"it has no function {FUNCTION}(symbols, action).")
        self._remembers = len(inspect.signature(self._function).parameters) > 2
        self._memories: list[Hashable] = [None]
        """The memory of the program, by number; a new episode begins with number 0."""
        self._numbers: dict[Hashable, int] = {None: 0}

    def facts(self) -> Arrays:
        """Whether it remembers anything."""
        return {"remembers": np.array(self._remembers)}

    def ask(self, symbols: tuple[int, ...], memory: int, n_actions: int) -> Arrays:
        """The outcomes of every macro-action from some symbols.

        Returns:
            B outcomes: ``action``, ``symbols``, ``probability``, ``reward``, ``ended`` and ``memory``, the latter three
            NaN, False and 0 where the program says nothing of them.
        """
        assert self._function is not None
        rows = []
        for action in range(n_actions):
            given = (symbols, action, self._memories[memory]) if self._remembers else (symbols, action)
            with _silent():
                found = self._function(*given)
            if not isinstance(found, dict) or not found:
                raise InvalidValueError(f"{FUNCTION}{given} gives {brief(found)}; give a dictionary of outcomes.")
            rows += [(action, *self._outcome(each, len(symbols)), float(share)) for each, share in found.items()]
        kinds = {
            "action": np.int64,
            "symbols": np.int64,
            "reward": np.float64,
            "ended": np.bool_,
            "memory": np.int64,
            "probability": np.float64,
        }
        columns = zip(*rows, strict=True)
        return {name: np.array(column, dtype=kinds[name]) for name, column in zip(kinds, columns, strict=True)}

    def _outcome(self, given: Any, factors: int) -> tuple[tuple[int, ...], float, bool, int]:
        """Symbols, reward, end and number of the memory of an outcome as the program writes it."""
        whole = isinstance(given, tuple) and bool(given) and isinstance(given[0], tuple)
        symbols, *more = given if whole else (given,)
        if not isinstance(symbols, tuple) or len(symbols) != factors or len(more) > 3:
            raise InvalidValueError(
                f"it gives the outcome {brief(given)}; give {factors} symbols, or (symbols, reward, ended, memory)."
            )
        if any(isinstance(symbol, float) and not symbol.is_integer() for symbol in symbols):
            raise InvalidValueError(f"it gives the symbols {brief(symbols)}; give whole numbers.")
        reward, ended, memory = (*more, None, None, None)[:3]
        values = tuple(int(symbol) for symbol in symbols)
        return values, math.nan if reward is None else float(reward), bool(ended), self._number(memory)

    def _number(self, memory: Hashable) -> int:
        """The number of something that is remembered. Raises InvalidValueError: it can be changed."""
        try:
            number = self._numbers.setdefault(memory, len(self._memories))
        except TypeError as error:
            raise InvalidValueError(
                f"it remembers {brief(memory)}, which can be changed; give None, a number, a text or a tuple of them."
            ) from error
        if number == len(self._memories):
            self._memories.append(memory)
        return number


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Raise InvalidValueError if the block prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        yield
    if printed.getvalue():
        raise InvalidValueError(f"it prints {brief(printed.getvalue())}; a program only returns outcomes.")


def _import(
    name: str,
    global_names: Mapping[str, object] | None = None,
    local_names: Mapping[str, object] | None = None,
    names: Sequence[str] = (),
    level: int = 0,
) -> ModuleType:
    """``import`` in a program. Many modules are loaded already, so that no audit event tells of them.

    Raises:
        InvalidValueError: The module is none of :data:`ALLOWED`.
    """
    if level or name not in (*ALLOWED, *_PARTS):
        raise InvalidValueError(_REFUSED_IMPORT.format(name="." * level + name))
    return builtins.__import__(name, global_names, local_names, names)


def _refuse(event: str, given: tuple[object, ...]) -> None:
    """Raise InvalidValueError for an event that a program may not cause."""
    if event == "import" and given[0] not in ALLOWED:
        raise InvalidValueError(_REFUSED_IMPORT.format(name=given[0]))
    if event == "open":
        raise InvalidValueError(f"it opens {brief(given[0])}; a program reads and writes no files.")
    if event.startswith(_REFUSED):
        raise InvalidValueError(f"it calls {event}; a program only computes.")
