"""The rule of conftest.py about the CPU time of fast tests, on a small session of its own."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

_TESTS = """
import time
import pytest

def burn(seconds):
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass

@pytest.fixture(scope="module")
def trained():
    burn(0.3)

def test_cheap(trained): pass
def test_over(): burn(0.15)
def test_far_over(): burn(0.3)
def test_disturbed_once(times=[0.3, 0.0]): burn(times.pop(0))
def test_wrong_once(results=[False, True]): assert results.pop(0)
def test_first_import(): import its_library
@pytest.mark.slow
def test_marked_slow(): burn(0.3)
"""
_CHANGES = "LIMIT_CPU_S = 0.1\nslowness = lambda: 1.0\n"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("session")
    (folder / "conftest.py").write_text((Path(__file__).parents[1] / "conftest.py").read_text() + "\n" + _CHANGES)
    (folder / "test_it.py").write_text(_TESTS)
    (folder / "its_library.py").write_text("from test_it import burn\nimport its_part\nburn(0.3)\n")
    (folder / "its_part.py").write_text("")
    options = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    again = shlex.split(options["addopts"].partition("--reruns")[2])
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--rootdir", str(folder), str(folder), "-q"]
    command += ["--reruns", *again]
    environment = {**os.environ, "PYTEST_ADDOPTS": ""}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False).stdout


def test_a_slow_test_is_named_and_a_very_slow_one_fails(report: str) -> None:
    assert "2 failed, 5 passed" in report
    assert "test_far_over" in report and "more than twice the limit of 0.1 CPU s" in report
    _, _, named = report.partition("fast tests over")
    assert "test_over" in named and "test_cheap" not in named and "test_marked_slow" not in named
    assert "test_first_import" not in report


def test_only_a_test_that_failed_for_its_time_is_run_again(report: str) -> None:
    failed = report.partition("short test summary")[2]
    assert "test_wrong_once" in failed and "test_far_over" in failed and "test_disturbed_once" not in failed
    assert "3 rerun" in report  # one of the disturbed test, two of the one that is too slow always
