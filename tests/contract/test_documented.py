"""Paths that the documentation of November 27 named, in ``frozen/documented.txt``: each can be imported today.

A line is a module, ``module:name`` or ``module:Class.member``. An old one warns once.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path

import pytest

from imagine_bench import MOVED, MOVED_NAMES

LINES = (Path(__file__).parent / "frozen" / "documented.txt").read_text().split()
NAMES: Mapping[str, list[str]] = {
    module: [line.partition(":")[2] for line in LINES if line.startswith(f"{module}:")]
    for module in dict.fromkeys(line.partition(":")[0] for line in LINES)
}
OLD = {
    *MOVED,
    *MOVED_NAMES,
    "imagine_bench.agents.factored.agent:FactoredAgent",
    "imagine_bench.agents.factored.agent:make",
}


def has(found: object, dotted: str) -> bool:
    """Whether an object has a member, a member's member, or an annotated field of a class."""
    for name in filter(None, dotted.split(".")):
        if name in getattr(found, "__annotations__", {}):
            return True
        try:
            found = getattr(found, name)
        except AttributeError:
            return False
    return True


@pytest.mark.parametrize("module", NAMES)
def test_every_documented_path_is_found(module: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        there = importlib.import_module(module)
        for name in NAMES[module]:
            if not has(there, name):
                importlib.import_module(f"{module}.{name}")


@pytest.mark.parametrize("old", sorted(OLD & {*NAMES, *LINES}))
def test_an_old_documented_path_warns_once(old: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path, _, name = old.partition(":")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = importlib.import_module(path)
    if name:
        vars(module).pop(name, None)
    else:
        monkeypatch.delitem(sys.modules, old)
    with pytest.warns(DeprecationWarning, match=f"{old} is now ") as seen:
        for _ in range(2):
            module = importlib.import_module(path)
            assert not name or getattr(module, name)
    assert len(seen) == 1
