"""The family of errors a user can cause, each one sentence: the given value, the allowed ones, the remedy."""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib.util
import operator
import re
import reprlib
import unicodedata
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Self, SupportsIndex

_LONGEST = 200
_FEW = 8
LISTED = ("task", "agent", "regressor", "world model", "task, agent or world model", "encoder", "grid")
"""Kinds of names that 'imagine-bench list' lists; a message has the nearest alone if there are many."""
_LONGEST_REASON = 1000
"""Characters of a library's own complaint that are handed on."""
_OF_CONSTRUCTORS = re.compile(
    r"__init__\(\) (missing \d+ required .*arguments?: (?P<missing>.+)|got an unexpected \D+ (?P<unknown>'[^']*'))"
)
"""Python's message where a file does not have the fields of its dataclass: one is missing, or one is unknown."""
_REASONS = {
    errno.EACCES: "you may not write there; choose another folder or change its permissions",
    errno.EPERM: "you may not write there; choose another folder or change its permissions",
    errno.EROFS: "that file system is read-only; choose another folder",
    errno.ENOSPC: "the disk is full; free some space and run the same command again",
    errno.ENOTDIR: "a part of that path is a file, not a folder; choose another folder",
    errno.EEXIST: "a part of that path is a file, not a folder; choose another folder",
}
"""Advice about refusals of the operating system; of others its own words are shown."""
_SHORT = reprlib.Repr()
_SHORT.maxstring = _LONGEST
_SHORT.maxother = _LONGEST
_SHORT.maxlong = 60
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxarray = 10


def brief(value: object) -> str:
    """``repr(value)`` on one line, whatever the value is, at most a few hundred characters of it."""
    return " ".join(_SHORT.repr(value).split())


def why(error: Exception) -> str:
    """The reason of an error, for a sentence: its first line, or the fields that a dataclass lacks or does not know."""
    text = str(error).strip()
    found = _OF_CONSTRUCTORS.search(text)
    if found is not None:
        return f"it lacks {found['missing']}" if found["missing"] else f"it has {found['unknown']}, which is unknown"
    if isinstance(error, KeyError):
        return f"{text} is missing"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return plain(text.partition("\n")[0][:_LONGEST_REASON]).rstrip(". ") or type(error).__name__


def plain(text: object) -> str:
    """A text for a terminal: its control characters as escapes, the middle of words that no reader needs left out."""
    shown = "".join(mark if mark.isprintable() or mark == "\n" else repr(mark)[1:-1] for mark in str(text))
    return re.sub(r"\S{1000,}", lambda word: f"{word[0][:80]}... ({len(word[0]):,} characters)", shown)


def unprintable(value: object) -> bool:
    """Whether a text, or one in a sequence, has control characters other than line breaks."""
    if isinstance(value, str):
        return any(unicodedata.category(mark) == "Cc" and mark != "\n" for mark in value)
    return isinstance(value, tuple) and any(map(unprintable, value))


class ImagineBenchError(Exception):
    """Base of every error whose message is written for the user; the CLI prints it without a traceback."""

    exit_code = 2


class UnknownNameError(ImagineBenchError, ValueError):
    """A name that is not among the known ones.

    Args:
        kind: The kind of thing that was named, for example ``"task"``.
        given: The value as the user wrote it.
        known: Every allowed name.
    """

    def __init__(self, kind: str, given: object, known: Iterable[object]) -> None:
        super().__init__(kind, given, [str(name) for name in known])

    def __str__(self) -> str:
        kind, given, names = self.args
        word = str(given) if isinstance(given, str | int | float | None) else brief(given)
        return f"No {kind} {brief(word)}.{_nearest(word, names, kind in LISTED and len(names) > _FEW)}"


def _nearest(word: str, names: list[str], are_listed: bool = False) -> str:
    """The nearest name and all names, or of many that are listed elsewhere the five nearest."""
    closest = difflib.get_close_matches(word[:_LONGEST], names, n=1, cutoff=0.4)
    hint = f" Did you mean {closest[0]!r}?" if closest else ""
    if are_listed:
        near = difflib.get_close_matches(word[:_LONGEST], names, n=5, cutoff=0.0)
        return f"{hint} The five nearest: {', '.join(near)}. 'imagine-bench list' names all {len(names)}."
    return f"{hint} Known: {', '.join(names) or 'none'}."


class UnknownKeywordError(ImagineBenchError, TypeError):
    """A keyword argument that a function does not take: a TypeError in Python's words, by which libraries know it."""

    @classmethod
    def of(cls, name: str, known: Iterable[str]) -> Self:
        """The error for a keyword argument that is none of the known ones."""
        return cls(f"Got an unexpected keyword argument {name!r}.{_nearest(name, list(known))}")


class InvalidValueError(ImagineBenchError, ValueError):
    """A value out of its range, of the wrong shape or of the wrong type."""


class UnableError(InvalidValueError):
    """An agent cannot do what an option asks for."""


class ArtefactError(ImagineBenchError):
    """A file (checkpoint, encoder, result) that is missing, damaged or made by something else. It is left untouched."""


class AbsentError(ArtefactError):
    """A file that a kept run used, or the agent that it trained, is not on this machine."""


class SetupError(ImagineBenchError):
    """The machine lacks something: headless GL, disk space, write permission. Names the remedy."""


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn the operating system's refusal to write at ``path`` into a SetupError of one sentence."""
    try:
        yield
    except OSError as error:
        raise SetupError(f"Cannot write {path}: {reason(error)}.") from error


def reason(error: OSError) -> str:
    """Why the system refused, in words."""
    return _REASONS.get(error.errno or 0, error.strerror or str(error))


class BusyError(ImagineBenchError):
    """Another process is at work in the same folder."""


class DivergedError(ImagineBenchError):
    """NaN or infinity in physics or in learning; the state was saved for inspection where the message says."""

    exit_code = 1


class RunFailedError(ImagineBenchError):
    """At least one run of a bench failed; the message names its log."""

    exit_code = 1


class CheckFailedError(ImagineBenchError):
    """A command that checks has found something wrong and has printed its complaints."""

    exit_code = 1


class IncompleteCheckError(ImagineBenchError):
    """A command that checks has found nothing wrong, and could not compare everything; the message names the rest."""

    exit_code = 3


EXTRAS = {
    "torch": "agents",
    "matplotlib": "report",
    "PIL": "report",
    "rerun": "rerun",
    "rerun_notebook": "notebook",
    "ray": "ray",
    "pygame": "play",
    "minari": "data",
    "pyarrow": "data",
    "stable_baselines3": "peers",
    "sb3_contrib": "peers",
    "sheeprl": "peers",
    "torch_world": "peers",
    "hydra": "peers",
    "tensorboard": "tracking",
    "wandb": "tracking",
    "submitit": "slurm",
}
"""The extra of this package that brings a module."""


def lacking(module: str) -> SetupError:
    """The error where a module of an extra is not installed."""
    return SetupError(f"This needs {module}, which is not installed: pip install 'imagine-bench[{EXTRAS[module]}]'.")


def require_modules(*modules: str) -> None:
    """Raise SetupError if one of these modules, of extras, is not installed."""
    for module in modules:
        if importlib.util.find_spec(module) is None:
            raise lacking(module)


def require_known(kind: str, given: str, known: Iterable[str]) -> str:
    """Return ``given`` if it is one of ``known``.

    Raises:
        UnknownNameError: It is not; the message lists all of ``known`` and the nearest one.
    """
    names = tuple(known)
    if not isinstance(given, str) or given not in names:
        raise UnknownNameError(kind, given, names)
    return given


def require(holds: bool, complaint: str) -> None:
    """Raise ArtefactError with the complaint unless a claim of a file holds."""
    if not holds:
        raise ArtefactError(complaint)


def require_integer(name: str, given: SupportsIndex, low: int) -> int:
    """An integer from ``low`` on, also one of numpy. Raises InvalidValueError: it is none."""
    with contextlib.suppress(TypeError):
        number = operator.index(given)
        if number >= low:
            return number
    raise InvalidValueError(f"{name} is {brief(given)}; give an integer from {low} on.")
