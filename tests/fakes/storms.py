"""Tools of the fault-injection tests: deaths at any file operation, damages of any file, values that nobody means."""

from __future__ import annotations

import builtins
import functools
import io
import itertools
import os
import shutil
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imagine_bench.errors import ImagineBenchError

_KILLED = 99
_REGIONS = 40
"""Places in each file that are damaged, each in three ways."""


class DeathError(BaseException):
    """The end of a process: nothing that catches errors catches it."""


def one_sentence(error: BaseException) -> str:
    text = str(error)
    assert isinstance(error, ImagineBenchError), f"raw {type(error).__name__}: {text[:300]}"
    assert len(text) < 3000 and "\n" not in text and text.isprintable(), text[:300]
    return text


def interrupted(
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    how: str,
    act: Callable[[Path], object],
    places: Iterable[int] | None = None,
) -> Iterator[Path]:
    """New folders below ``root`` in which ``act`` was ended at the file operations ``places``, by default at each.

    ``how`` is ``"full disk"``, ``"death"`` (an exception that ``except Exception`` does not catch) or ``"kill"`` (of a
    process of its own, in which nothing else runs after it).
    """
    count = itertools.count(10**9)
    at: int | None = None

    def guarded(real: Callable[..., Any], arms: Callable[..., bool] = lambda *_, **__: True) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            if arms(*args, **named) and next(count) == at:
                if how == "kill":
                    os._exit(_KILLED)
                raise DeathError if how == "death" else OSError(28, "No space left on device")
            return real(*args, **named)

        return call

    for name in ("mkdir", "replace", "rename", "unlink", "fsync", "rmdir"):
        monkeypatch.setattr(os, name, guarded(getattr(os, name)))
    for module in (builtins, io):
        monkeypatch.setattr(module, "open", guarded(open, functools.partial(_writes, str(root))))
    for at in itertools.count() if places is None else places:
        count = itertools.count()
        folder = root / f"run_{at}"
        if how == "kill":
            ended = _in_fork(act, folder) != _KILLED
        else:
            _until_death(act, folder)
            ended = next(count) <= at
        count = itertools.count(10**9)
        yield folder
        shutil.rmtree(folder, ignore_errors=True)
        if ended:
            break


def _writes(root: str, file: object, mode: str = "r", *_: object, **__: object) -> bool:
    return any(mark in str(mode) for mark in "wax+") and root in str(file)


def _until_death(act: Callable[[Path], object], folder: Path) -> None:
    try:
        act(folder)
    except DeathError:
        pass
    except ImagineBenchError as error:
        one_sentence(error)


def _in_fork(act: Callable[[Path], object], folder: Path) -> int:
    """The exit code of a process that acts: 0, or ``_KILLED`` where it was."""
    child = os.fork()
    if not child:
        try:
            act(folder)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, _KILLED), code
    return code


def damages(content: bytes, rng: np.random.Generator) -> Iterator[bytes]:
    """A bit flipped, a byte replaced by a digit and an end cut off, in each of many regions."""
    yield b""
    edges = np.unique(np.linspace(0, len(content), min(_REGIONS, len(content)) + 1).astype(int))
    for low, high in itertools.pairwise(edges.tolist()):
        place = int(rng.integers(low, high))
        for byte in (content[place] ^ (1 << int(rng.integers(8))), 48 + int(rng.integers(10))):
            yield content[:place] + bytes([byte]) + content[place + 1 :]
        yield content[:place]


def facts(result: Any) -> str:
    """All that a report could say, as text."""
    rows = [(run.agent, run.seed, run.settings, run.checkpoints, run.training_success.tolist()) for run in result.runs]
    return f"{result.protocol}{result.environment}{rows}"


_TEXTS = [
    "", " ", "x" * 5000, "\x1b[31mred", "\udcff", "a\nb", "../..", "~nobody/x", "NaN", "null", "quick\x00", "[" * 900,
]  # fmt: skip
_NUMBERS = [-1, 0, 10**9, 10**30, -(10**400), 0.5, 1e308, float("nan"), float("inf"), -float("inf"), True, None]
_OTHERS: list[Any] = [
    [], {}, (), [[]], {"a": {}}, b"\xff", np.ma.masked, np.array(["clean", "mild"]), np.zeros((3, 3)), object(),
    Ellipsis, np.array([]), range(3), {1, 2}, [1.5, None], np.float64("nan"), np.datetime64("NaT"), 1j, len,
]  # fmt: skip


def hostile(rng: np.random.Generator) -> Any:
    """A value that nobody means."""
    everything = [*_TEXTS, *_NUMBERS, *_OTHERS]
    return everything[int(rng.integers(len(everything)))]


def as_word(value: Any) -> str:
    return value if isinstance(value, str) else str(value)[:4000]
