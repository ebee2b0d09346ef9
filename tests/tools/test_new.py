"""Packages that ``imagine-bench new`` writes pass the checks as they are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from guest_packages import Guests
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.rules import facts
from imagine_bench.running.bench import bench, plan


@pytest.mark.parametrize("kind", ["task", "agent", "model"])
def test_a_new_package_keeps_the_contract(
    guests: Guests, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    folder = tmp_path / "a folder" / "my_own"
    assert main(["new", kind, "my_own", "--out", str(folder.parent)]) == 0
    assert f"pip install -e '{folder}' && imagine-bench check --{kind} my_own" in capsys.readouterr().out
    guests.add(folder)
    assert main(["check", f"--{kind}", "my_own"]) == 0, capsys.readouterr().out


def test_the_new_packages_own_tests_find_a_fault(guests: Guests) -> None:
    site = guests.new("task", "my_own", ("self._state, self.np_random.bit_generator.state = state", "pass"))
    environment = {**os.environ, "PYTHONPATH": str(site / "src")}
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    said = subprocess.run(words, capture_output=True, text=True, env=environment, cwd=site, check=False).stdout
    assert "1 failed, 6 passed" in said and "put back in the same environment, it goes on otherwise" in said


def test_the_new_agent_learns_the_new_task(guests: Guests, tmp_path: Path) -> None:
    guests.new("task", "my_world")
    guests.new("agent", "my_own")
    few = {"budgets": (100,), "evaluation_episodes": 100, "open_loop_starts": 0, "recorded_episodes": 0}
    wanted, paths = plan("my_world", "smoke", agents=("my_own",), execution="kinematic", **few)
    (run,) = bench(wanted, paths, root=tmp_path, launcher=Inline()).runs
    chance = facts(registry.task("my_world").rules, 8).chance_level
    assert run.checkpoints[-1].success_rate > 0.9 > 2 * chance


def test_a_new_folder_hides_no_module_and_one_that_does_is_named(tmp_path: Path) -> None:
    """Beside the folder Python takes it for a package, where an editable install only adds a finder."""
    assert main(["new", "agent", "my_own", "--out", str(tmp_path)]) == 0
    reads = "import sys; sys.path += sys.argv[1:]; from imagine_bench import registry; "
    reads += "print(registry.load('my_own:ENTRY').title)"

    def loaded(*added: Path) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-c", reads, *added]
        return subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert f"no attribute 'ENTRY', as the folder {tmp_path / 'my_own'} hides it" in loaded().stderr
    assert loaded(tmp_path / "my_own" / "src").stdout == "My own\n", "as setuptools adds it"


def test_a_folder_that_exists_is_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "there").mkdir()
    assert main(["new", "agent", "there", "--out", str(tmp_path)]) == 2
    assert "there exists; give another name or --out. Nothing was written." in capsys.readouterr().err
    assert not any((tmp_path / "there").iterdir())
