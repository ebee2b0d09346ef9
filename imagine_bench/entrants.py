"""Entrants of a bench: an agent as it is, ``dqn``, or with settings of its own, ``dqn:controller.discount=0.99``.

The text is the entrant's name in protocols, tables and files; one agent may enter a bench with several settings.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from imagine_bench.errors import InvalidValueError

_BETWEEN = re.compile(r",(?=[\w.]+=)")
_LONGEST = 100


class Entrant(NamedTuple):
    """An agent and the settings that it alone has in a bench."""

    agent: str  #: registered name
    settings: Mapping[str, Any]  #: by dotted name, in the order of names

    def __str__(self) -> str:
        """The one name of this entrant, however its settings were written."""
        return ":".join([self.agent, *filter(None, [",".join(f"{n}={_text(v)}" for n, v in self.settings.items())])])

    @property
    def words(self) -> str:
        """The settings for a reader, by the last part of their names where that is enough: ``discount 0.99``."""
        short = [name.rpartition(".")[2] for name in self.settings]
        names = self.settings if len(set(short)) < len(short) else short
        return ", ".join(f"{name} {_text(value)}" for name, value in zip(names, self.settings.values(), strict=True))


def entrant(text: str) -> Entrant:
    """Undo ``str(entrant)``. Raises InvalidValueError: settings that are none, or one that is given twice."""
    agent, colon, rest = text.partition(":")
    return Entrant(agent, dict(parse_settings(_BETWEEN.split(rest), f"entrant {text!r}:")) if colon else {})


def parse_settings(pairs: Sequence[str], where: str = "--set") -> tuple[tuple[str, Any], ...]:
    """``name=value`` words to sorted (name, value) pairs; values are read as JSON, and as text where they are none.

    Raises InvalidValueError: a word without ``=``, or a name given twice.
    """
    settings: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise InvalidValueError(f"{where} {pair!r} is not of the form name=value, such as controller.discount=0.9.")
        if name in settings:
            raise InvalidValueError(f"{where} names {name!r} twice; give it once.")
        settings[name] = _value(text)
    return tuple(sorted(settings.items()))


def file_name(text: str) -> str:
    """An entrant's name as a file or folder may have it on any system; of different entrants, different ones."""
    safe = re.sub(r"[^\w.,=-]", "-", text, flags=re.ASCII)
    if safe == text.replace(":", "-", 1) and len(safe) <= _LONGEST:
        return safe
    return f"{safe[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _text(value: Any) -> str:
    return value if isinstance(value, str) and _value(value) == value else json.dumps(value, separators=(",", ":"))
