"""The doctor and the facts it reads: a fault is said in words, sound parts are left alone."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest

from imagine_bench.cli import exit_code as main
from imagine_bench.errors import SetupError
from imagine_bench.registry import machine as environment
from imagine_bench.tools import doctor


def test_this_installation_works(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    for word in ("mujoco", "torch", "GL renderer", "processor", "Everything works."):
        assert word in out


def with_version(**changed: str) -> Callable[[str], str]:
    return lambda package: changed.get(package) or environment.installed(package)


def test_the_broken_pair_is_named() -> None:
    (complaint,) = doctor.unmet_requirements(with_version(mujoco="4.0.0"))
    assert complaint.startswith("mujoco 4.0.0 is installed, but")
    assert "MuJoCo 4.0 breaks dm-control 1.0.50" in complaint and "make setup" in complaint
    assert doctor.unmet_requirements() == [], "this machine's own versions satisfy every requirement"
    alone = with_version(**{"mujoco": "4.0.0", "dm-control": "missing"})
    assert doctor.unmet_requirements(alone) == [] == doctor.missing_extras(alone)


def test_changed_code_is_part_of_the_commit(tmp_path: Path) -> None:
    """Each edit, and a new file that nobody added, has a name of its own; a file that is no code has none."""

    def git(words: str) -> None:
        identity = ("-c", "user.name=x", "-c", "user.email=x@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *words.split()], check=True, capture_output=True)

    def commit_with(name: str, text: str) -> str | None:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        return environment.commit(tmp_path)

    git("init -q")
    commit_with("agents/a.py", "1")
    git("add .")
    git("commit -qm x")
    head = commit_with("README.md", "words")
    assert head is not None and "+" not in head and head == commit_with("runs/x.py", "results")
    new = ["agents/new.py", "tasks/new.py", "imagine_bench/new.py", "assets/new.xml", "pyproject.toml"]
    edits = [("agents/a.py", "2"), ("agents/a.py", "3"), *((name, text) for name in new for text in "12")]
    seen = [commit_with(*edit) for edit in edits]
    assert len(set(seen)) == 12 and all(str(each).startswith(f"{head}+changes.") for each in seen)
    for name in new:
        (tmp_path / name).unlink()
    assert commit_with("agents/a.py", "1") == head
    (tmp_path / ".git/index").write_bytes(b"damaged")  # git still knows the commit, and not what differs
    assert environment.commit(tmp_path) == f"{head}+changes.unknown"


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["-m", "my_tools", "bench", "--task", "a b"], "python -m my_tools bench --task 'a b'"),
        (["my_tools/imagine-bench", "describe"], "imagine-bench describe"),
    ],
)
def test_the_command_is_what_a_shell_takes(tmp_path: Path, words: list[str], command: str) -> None:
    (tmp_path / "my_tools").mkdir()
    for name in ("__main__.py", "imagine-bench"):
        code = "from imagine_bench.registry.machine import command; print(command())"
        (tmp_path / "my_tools" / name).write_text(code)
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == f"{command}\n"


def test_missing_packages_are_complaints_and_missing_extras_notes() -> None:
    (complaint,) = doctor.unmet_requirements(with_version(mink="missing"))
    assert complaint.startswith("mink is missing, but")
    without = with_version(torch="missing", matplotlib="missing")
    assert doctor.unmet_requirements(without) == [] and doctor.missing_extras() == []
    (note,) = doctor.missing_extras(without)
    assert note.endswith("pip install 'imagine-bench[agents,report]'.")


def test_versions_that_are_not_the_locks_are_named(tmp_path: Path) -> None:
    assert doctor.unlocked_versions() == []
    (note,) = doctor.unlocked_versions(version_of=with_version(numpy="2.2.0", daqp="missing"))
    assert "results: daqp missing (not 0." in note and ", numpy 2.2.0 (not 2." in note and "make setup" in note
    assert doctor.unlocked_versions(tmp_path / "no.lock", with_version(numpy="2.2.0")) == []


def test_missing_gl_and_a_full_disk_are_complaints_and_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for gpu, gl in ((None, "Mesa, llvmpipe"), ("a card", "NVIDIA, a card"), ("a card", "Mesa, llvmpipe")):
        monkeypatch.setattr(doctor, "machine", lambda gpu=gpu: {**environment.machine(), "gpu": gpu})
        monkeypatch.setattr(doctor, "gl_renderer", lambda gl=gl: gl)
        assert main(["doctor"]) == 0
        said = capsys.readouterr().out
        assert re.search(rf"^NVIDIA GPU +{gpu or 'none'}$", said, re.MULTILINE)
        note = f"Note: Frames are drawn in software ({gl}) although there is a GPU; "
        assert (note in said) == ("Note: Frames" in said) == (gpu is not None and "Mesa" in gl)
    monkeypatch.setattr(doctor, "gl_renderer", mock.Mock(side_effect=SetupError("No OpenGL: install libegl1.")))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=2**29))
    assert main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "Wrong: No OpenGL: install libegl1.\n" in said and "Wrong: Only 0.5 GiB are free in" in said
