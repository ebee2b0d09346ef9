"""The settings of a learner in words: default, meaning with its unit, and range, for ``imagine-bench describe``."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from imagine_bench import registry
from imagine_bench.values import Setting, dotted

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Cases = Mapping[str, tuple[str, str]]
"""A set of hyperparameters and a config group by the words for where they hold; that of no words is the default."""
OF_AGENTS: Cases = {
    "": ("fast", "chapter_5"),
    "preset thesis": ("published", "chapter_5"),
    "pick_place": ("fast", "chapter_3"),
    "pick_place, preset thesis": ("published", "chapter_3"),
}
_WIDTH = 100


def settings_in_words(target: str, cases: Cases) -> str:
    """Two lines or more for each setting that has an effect; its meaning is the comment on it in the source.

    Args:
        target: The ``"module:attr"`` of the settings, as of :class:`.AgentEntry`.
        cases: Where the settings have which values.
    """
    known = registry.load(target)
    inert = known.inert() if hasattr(known, "inert") else ()
    settings = {words: known.resolve(name, {}, group) for words, (name, group) in cases.items()}
    values = {words: dotted(dataclasses.asdict(each)) for words, each in settings.items()}
    lines = []
    for name, meaning in _meanings(settings[""], ""):
        if name in inert:  # a bench refuses another value
            continue
        default = values[""][name]
        others = [f"{words}: {_typed(of[name])}" for words, of in values.items() if of[name] != default]
        elsewhere = f" ({'; '.join(others)})" if others else ""
        lines.append(f"  {name} = {_typed(default)}{elsewhere}")
        lines.append(textwrap.fill(meaning, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6))
    return "\n".join(lines)


def _typed(value: Setting) -> str:
    """A value as it is typed behind ``--set NAME=``."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _meanings(settings: DataclassInstance, prefix: str) -> Iterator[tuple[str, str]]:
    """The dotted name of every setting, with its comment and its range."""
    comments = _comments(type(settings))
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from _meanings(value, f"{prefix}{field.name}.")
            continue
        allowed = field.metadata["allowed"]
        allowed_words = f"one of {', '.join(allowed)}" if isinstance(allowed, tuple) else allowed.words
        yield f"{prefix}{field.name}", "; ".join(filter(None, [comments.get(field.name), allowed_words]))


def _comments(kind: type) -> dict[str, str]:
    """The ``#:`` comments on the fields of a dataclass, those that it inherits included, by name."""
    found: dict[str, str] = {}
    for part in reversed([each for each in kind.__mro__ if dataclasses.is_dataclass(each)]):
        above: list[str] = []
        name = ""
        for line in inspect.getsource(part).splitlines():
            code, _, behind = line.strip().partition("#:")
            if behind and not code:
                above.append(behind)
                continue
            declared = re.match(r"(\w+): ", code)
            name = declared[1] if declared else name
            comment = " ".join(" ".join([*above, behind]).split())
            if comment and name:
                found[name] = re.sub(r":\w+:|`", "", comment).rstrip(".")
            above = []
    return found
