"""The family of errors a user can cause, each one sentence: what was given, what is allowed, what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


class ImagineBenchError(Exception):
    """Base of every error whose message is written for the user; the CLI prints it without a traceback."""

    exit_code = 2


class UnknownNameError(ImagineBenchError, ValueError):
    """A name that is not among the known ones.

    Args:
        kind: What was named, for example ``"task"``.
        given: The value as the user wrote it.
        known: Every allowed name.
    """

    def __init__(self, kind: str, given: object, known: Iterable[object]) -> None:
        names = [str(name) for name in known]
        closest = difflib.get_close_matches(str(given), names, n=1, cutoff=0.4)
        hint = f" Did you mean {closest[0]!r}?" if closest else ""
        super().__init__(f"No {kind} {str(given)!r}.{hint} Known: {', '.join(names) or 'none'}.")
        self.kind, self.given, self.known = kind, given, tuple(names)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.kind, self.given, self.known)  # worker processes send errors back


class InvalidValueError(ImagineBenchError, ValueError):
    """A value out of its range, of the wrong shape or of the wrong type."""


class ArtefactError(ImagineBenchError):
    """A file (checkpoint, encoder, result) that is missing, damaged or made by something else. It is left untouched."""


class SetupError(ImagineBenchError):
    """The machine lacks something: headless GL, disk space, write permission. Says what to install or change."""


class BusyError(ImagineBenchError):
    """Another process is at work in the same folder."""


class DivergedError(ImagineBenchError):
    """NaN or infinity in physics or in learning; the state was saved for inspection where the message says."""

    exit_code = 1


class RunFailedError(ImagineBenchError):
    """At least one run of a bench failed; the message names its log."""

    exit_code = 1


def require_known(kind: str, given: str, known: Iterable[str]) -> str:
    """Return ``given`` if it is one of ``known``.

    Raises:
        UnknownNameError: It is not; the message lists all of ``known`` and the nearest one.
    """
    names = tuple(known)
    if given not in names:
        raise UnknownNameError(kind, given, names)
    return given
