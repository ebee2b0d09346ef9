"""Everything that was documented on November 27 still works: paths can be imported, commands and make targets name the
line.

A line of ``frozen/documented.txt`` is a module, ``module:name`` or ``module:Class.member``. An old one warns once.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import subprocess
import warnings
from collections.abc import Mapping
from pathlib import Path

import pytest

from imagine_bench import MOVED, MOVED_NAMES, registry
from imagine_bench.cli import parsed
from imagine_bench.errors import InvalidValueError

LINES = (Path(__file__).parent / "frozen" / "documented.txt").read_text().split()
NAMES: Mapping[str, list[str]] = {
    module: [line.partition(":")[2] for line in LINES if line.startswith(f"{module}:")]
    for module in dict.fromkeys(line.partition(":")[0] for line in LINES)
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


@pytest.mark.parametrize("old", sorted({*MOVED_NAMES} & {*LINES}))
def test_an_old_documented_name_warns_once(old: str) -> None:
    path, _, name = old.partition(":")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        module = importlib.import_module(path)
    vars(module).pop(name, None)
    with pytest.warns(DeprecationWarning, match=f"{old} is now ") as seen:
        for _ in range(2):
            assert getattr(module, name)
    assert len(seen) == 1


COMMANDS = (
    "bench report plan judge verify why study suite dataset view encoder film play speed margins coverage "
    "check describe new doctor list"
).split()
TARGETS = (
    "help ready setup bench peers plan judge verify why study suite view report data encoder film doctor "
    "test test-slow storm mutants lint docs build lock speed clean"
).split()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_former_command_is_parsed_or_names_the_line(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        with pytest.raises(SystemExit) as ended:
            parsed([command, "--help"])
    except InvalidValueError as refusal:
        assert re.search(r"In a checkout type: (make|python) \S+", str(refusal))
    else:
        assert ended.value.code == 0 and "usage: imagine-bench" in capsys.readouterr().out


@pytest.mark.parametrize("target", TARGETS)
def test_a_former_make_target_types_a_command_that_there_is(target: str) -> None:
    root = Path(__file__).parents[2]
    said = subprocess.run(["make", "-n", target], cwd=root, capture_output=True, text=True, check=False)
    assert said.returncode == 0 and said.stdout.strip(), said.stderr
    for command in re.findall(r"bin/imagine-bench ([a-z]+)", said.stdout):
        with pytest.raises(SystemExit) as ended:
            parsed([command, "--help"])
        assert ended.value.code == 0, command


def test_every_stable_module_is_there_under_its_own_name() -> None:
    page = (Path(__file__).parents[2] / "docs/reference/api.md").read_text()
    section = page.partition("## Modules that other packages may import")[2].partition("\n## ")[0]
    modules = set(re.findall(r"(?<=`)imagine_bench\w*\.[a-z_.]+(?=`)", section)) - set(MOVED)
    assert len(modules) > 20
    for module in modules:
        assert importlib.util.find_spec(module) is not None, module
    assert hasattr(importlib.import_module("imagine_bench.values"), "Json")
    entries = re.findall(r"`(\w+Entry)`", section)
    assert len(entries) == 5 and all(hasattr(registry, name) for name in entries)
