"""Commands and make targets of November 27 still work, or answer with the line to type."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from imagine_bench.cli import parsed
from imagine_bench.errors import InvalidValueError

ROOT = Path(__file__).parents[2]
COMMANDS = [
    "bench",
    "report",
    "plan",
    "judge",
    "verify",
    "why",
    "study",
    "suite",
    "dataset",
    "view",
    "encoder",
    "film",
    "play",
    "speed",
    "margins",
    "coverage",
    "check",
    "describe",
    "new",
    "doctor",
    "list",
]
TARGETS = [
    "help",
    "ready",
    "setup",
    "bench",
    "peers",
    "plan",
    "judge",
    "verify",
    "why",
    "study",
    "suite",
    "view",
    "report",
    "data",
    "encoder",
    "film",
    "doctor",
    "test",
    "test-slow",
    "storm",
    "mutants",
    "lint",
    "docs",
    "build",
    "lock",
    "speed",
    "clean",
]


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
def test_a_former_make_target_has_a_recipe(target: str) -> None:
    said = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    assert said.stdout.strip()


def test_what_make_types_is_understood() -> None:
    """The command of each target, as make would type it, is one that there is."""
    for target in TARGETS:
        said = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False).stdout
        for command in re.findall(r"bin/imagine-bench ([a-z]+)", said):
            with pytest.raises(SystemExit) as ended:
                parsed([command, "--help"])
            assert ended.value.code == 0, (target, command)
