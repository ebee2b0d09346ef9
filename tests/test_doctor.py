"""The doctor and the facts it reads: what is wrong is said in words, what is right is left alone."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from imagine_bench import doctor, environment
from imagine_bench.cli import main
from imagine_bench.errors import SetupError


def test_this_installation_works(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    for word in ("mujoco", "dm-control", "torch", "GL renderer", "64x64 frame", "processor", "Everything works."):
        assert word in out


def with_version(**changed: str) -> Callable[[str], str]:
    return lambda package: changed.get(package) or environment.installed(package)


def test_the_broken_pair_is_named() -> None:
    (complaint,) = doctor.unmet_requirements(with_version(mujoco="4.0.0"))
    assert complaint.startswith("mujoco 4.0.0 is installed, but")
    assert "MuJoCo 4.0 breaks dm-control 1.0.50" in complaint and "make setup" in complaint


def test_the_command_is_what_a_shell_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/x/imagine_bench/__main__.py", "bench", "--task", "a b"])
    assert environment.command() == "python -m imagine_bench bench --task 'a b'"
    monkeypatch.setattr("sys.argv", ["/x/bin/imagine-bench", "list"])
    assert environment.command() == "imagine-bench list"


@pytest.mark.parametrize("package", ["mink", "jinja2", "matplotlib"])
def test_a_missing_package_is_named(package: str) -> None:
    (complaint,) = doctor.unmet_requirements(with_version(**{package: "missing"}))
    assert complaint.startswith(f"{package} is missing, but")


def test_versions_of_this_machine_satisfy_every_requirement() -> None:
    assert doctor.unmet_requirements() == []


def test_missing_gl_is_a_complaint_and_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none() -> str:
        raise SetupError("No OpenGL for headless rendering: install libegl1.")

    monkeypatch.setattr(doctor, "gl_renderer", none)
    with pytest.raises(SystemExit) as caught:
        main(["doctor"])
    assert caught.value.code == 1
    assert capsys.readouterr().out.splitlines()[-1] == "Wrong: No OpenGL for headless rendering: install libegl1."


def test_the_environment_is_json_and_complete() -> None:
    facts = environment.describe_environment()
    assert set(facts) == {"command", "commit", "versions", "machine", "gl_renderer", "threads_a_run"}
    assert "missing" not in facts["versions"].values()
    assert facts["machine"]["cores"] >= 1 and facts["machine"]["cpu"]
    assert {"daqp", "stable-baselines3"} <= set(facts["versions"]), "a solver of mink's, and a peer of the tests' extra"
    assert facts["gl_renderer"] and not facts["gl_renderer"].startswith("none")
