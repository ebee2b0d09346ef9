"""The plug-in of pytest, in a pytest of its own: the contract's checks are tests beside those that are there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_THEIRS = """
from imagine_bench.agents.baselines import make_random
from imagine_bench.registry import AGENTS, AgentEntry


def forgetful(context):
    agent = make_random(context)
    agent.restore = lambda state: None
    return agent


def test_of_their_own():
    pass


AGENTS["forgetful"] = AgentEntry(make="test_theirs:forgetful", learns=False, needs_encoder=False)
"""


def run(folder: Path, *words: str) -> tuple[int, str]:
    (folder / "test_theirs.py").write_text(_THEIRS)
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    return done.returncode, done.stdout + done.stderr


def test_checks_are_tests_beside_those_that_are_there(tmp_path: Path) -> None:
    code, said = run(tmp_path, "--imagine-bench-agent=forgetful", "--imagine-bench-task=arrow_puzzle_easy")
    assert code == 1 and "= 1 failed, " in said and "test_of_their_own PASSED" in said, said
    assert "imagine-bench::forgetful: taken up from its state it goes on to the same bits FAILED" in said
    assert "\nit acts otherwise\n" in said and "Traceback" not in said


def test_what_does_not_exist_is_one_sentence(tmp_path: Path) -> None:
    code, said = run(tmp_path, "--imagine-bench-task=arrow_puzle")
    assert code == 4 and "ERROR: No task 'arrow_puzle'. Did you mean 'arrow_puzzle'?" in said
