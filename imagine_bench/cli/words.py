"""The words of a command line before they are parsed: former commands, ``--task``, and the home folder."""

from __future__ import annotations

import re
import shlex
import sys
import unicodedata
from collections.abc import Sequence
from pathlib import Path

from imagine_bench.errors import InvalidValueError, brief

_LONGEST_WORD = 1000
FORMER = {
    "film": ("play", "--film"),
    "list": ("describe",),
    "margins": ("check", "--physics"),
    "study": ("sweep",),
    "suite": ("sweep",),
    "why": ("verify", "--causes"),
}
"""Commands of former versions, and the words that replace each."""
ELSEWHERE = {
    "coverage": "python tests/measure/coverage.py",
    "speed": "make speed",
}
"""Former commands that are measurements of a checkout now, and the line to type there."""
_TASK_FIRST = {"bench", "judge", "sweep", "dataset", "encoder", "play", "check", "describe"}
"""Commands whose first word is a task; of others it may be a path."""


def understood(words: Sequence[str]) -> list[str]:
    """The words that are parsed. A former command is replaced, after one line on standard error.

    Raises:
        InvalidValueError: A word that no terminal could show, a task given twice, or a former command that is no
            command any more.
    """
    given = [_readable(word) for word in words]
    command = given[0] if given else ""
    if command in ELSEWHERE:
        raise InvalidValueError(
            f"'{command}' is no command any more. In a checkout type: {ELSEWHERE[command]}. "
            "'imagine-bench check TASK --physics' measures the physics of any task."
        )
    if command in FORMER:
        given = [*FORMER[command], *given[1:]]
        print(f"imagine-bench: '{command}' is now: imagine-bench {shlex.join(given)}", file=sys.stderr)
    return _with_task_first(given) if given and given[0] in _TASK_FIRST else given


def _readable(word: str) -> str:
    """A word with ``~`` as the home folder. Raises InvalidValueError if no terminal could show it."""
    if len(word) > _LONGEST_WORD or any(unicodedata.category(mark) in ("Cc", "Cs") for mark in word):
        raise InvalidValueError(
            f"The word {brief(word)} cannot be meant: give at most {_LONGEST_WORD:,} characters, none of them a "
            "control character or outside Unicode."
        )
    return re.sub(r"^(--[a-z-]+=)?~(?=/|$)", lambda found: f"{found[1] or ''}{Path.home()}", word)


def _with_task_first(words: list[str]) -> list[str]:
    """The task of ``--task TASK`` or ``--task=TASK`` as the first word behind the command."""
    command, *rest = words
    tasks = []
    others = []
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        if name != "--task" or not (equals or rest):
            others.append(f"{name}{equals}{value}")
        else:
            tasks.append(value if equals else rest.pop(0))
    if others and not others[0].startswith("-"):
        tasks.insert(0, others.pop(0))
    if len(tasks) > 1:
        raise InvalidValueError(f"Both {tasks[0]} and --task {tasks[1]} were given; leave one of them out.")
    return [command, *tasks, *others]
