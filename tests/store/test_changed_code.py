"""Benches of agents and tasks that packages offer: code that was changed resumes no run, and nothing is lost."""

from __future__ import annotations

import dataclasses
import random
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from guest_packages import Guests
from small_runs import TWO_EPISODES, Inline

import imagine_bench
from imagine_bench import api, registry
from imagine_bench.errors import ArtefactError
from imagine_bench.judge.judgement import Judgement
from imagine_bench.judge.verify import verify_runs
from imagine_bench.protocols import data
from imagine_bench.protocols.control import protocol, registered_code
from imagine_bench.registry.builtin import OUR_AGENTS
from imagine_bench.registry.by_value import CodeByValue, code_digest
from imagine_bench.registry.entries import AgentEntry
from imagine_bench.regression.protocol import plan as plan_regression
from imagine_bench.running.trained import load_trained
from imagine_bench.store.bench_folder import read_control
from imagine_bench.sweep.grid import Study, Variant
from imagine_bench.sweep.run import run_study

_COMMENT = "\n# another version\n"
_DONE = "All runs lie in"
_CHANGED = "the code of an agent or of the task was changed since"
_REGRESSOR = """
from imagine_bench.registry import RegressorEntry

ENTRY = RegressorEntry(make="line:f", title="a line", description="A line.")
"""
Bench = Callable[[], api.Comparison]


@pytest.fixture
def module(guests: Guests) -> Path:
    """The only module of a package that offers an agent."""
    return guests.new("agent", "theirs") / "src/theirs.py"


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """Runs a small bench of that agent, always by the same call."""
    return lambda: imagine_bench.bench(
        "arrow_puzzle", agents=["random", "theirs"], out=tmp_path / "runs", **TWO_EPISODES
    )


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def edit(module: Path) -> None:
    module.write_text(module.read_text() + _COMMENT)


def bring_back(module: Path) -> None:
    module.write_text(module.read_text().replace(_COMMENT, ""))


def test_changed_code_of_a_package_begins_a_new_bench(
    module: Path, bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    first = bench().folder
    kept = files(first)
    assert bench().folder == first and _DONE in capsys.readouterr().out
    edit(module)
    second = bench().folder
    assert second != first and f"{_CHANGED} {first}, which stays as it is" in capsys.readouterr().out
    assert bench().folder == second, "now that one goes on"
    bring_back(module)
    assert bench().folder == first
    assert _CHANGED not in capsys.readouterr().out
    assert {path: path.read_bytes() for path in kept} == {**kept, **files(first / "report")}


def test_other_files_of_a_package_count_as_its_code_does(guests: Guests) -> None:
    package = guests.new("agent", "mine") / "src/mine"
    module = package.with_suffix(".py")
    package.mkdir()
    module.rename(package / "__init__.py")
    before = registry.package_code("mine:ENTRY")
    (package / ".cache").write_text("hidden")
    (package / "__pycache__").mkdir(exist_ok=True)
    (package / "__pycache__" / "mine.pyc").write_bytes(b"bytecode")
    assert before and registry.package_code("mine:ENTRY") == before
    seen = {before}
    for name, text in (("scene.xml", "<a/>"), ("scene.xml", "<b/>"), ("other.xml", "<b/>")):
        (package / name).write_text(text)
        seen.add(registry.package_code("mine:ENTRY"))
    (package / "scene.xml").unlink()
    seen.add(registry.package_code("mine:ENTRY"))
    assert len(seen) == 5


def test_an_agent_of_changed_code_is_not_taken_up(module: Path, bench: Bench) -> None:
    run = bench().folder / "theirs/seed_0"
    assert load_trained(run).episodes == 2
    edit(module)
    with pytest.raises(ArtefactError, match=r"code of agent theirs is not that of this bench .* bring the"):
        load_trained(run)
    assert load_trained(run.parent.parent / "random/seed_0")


def test_a_class_of_an_installed_package_has_the_digest_of_that_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    guests = Guests(tmp_path / "site-packages", monkeypatch)
    module = guests.new("agent", "theirs") / "src/theirs.py"
    agent = import_module("theirs").Theirs
    of = CodeByValue.of
    run = imagine_bench.bench("arrow_puzzle", agents=[agent], out=tmp_path, **TWO_EPISODES).folder / "Theirs/seed_0"
    assert load_trained(run).episodes == 2
    with monkeypatch.context() as earlier:
        earlier.setattr(CodeByValue, "of", classmethod(lambda cls, made: dataclasses.replace(of(made), module="")))
        before = imagine_bench.bench("arrow_puzzle", agents=[agent], out=tmp_path / "before", **TWO_EPISODES).folder
    again = imagine_bench.bench("arrow_puzzle", agents=[agent], out=tmp_path / "before", **TWO_EPISODES).folder
    assert again == before, "a bench of before classes had the digests of packages"
    assert load_trained(before / "Theirs/seed_0").episodes == 2
    edit(module)
    other = imagine_bench.bench("arrow_puzzle", agents=[agent], out=tmp_path, **TWO_EPISODES).folder
    assert other != run.parent.parent
    with pytest.raises(ArtefactError, match="code of agent Theirs is not that of this bench"):
        load_trained(run)
    del registry.AGENTS["Theirs"]
    guests.forget()


@pytest.fixture
def before(bench: Bench, module: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of that bench as versions left it that kept no digest of packages."""
    with monkeypatch.context() as earlier:
        earlier.setattr(data, "package_code", lambda place: "")
        folder = bench().folder
    assert read_control(folder).code == ()
    return folder


@pytest.mark.parametrize("made", [np.random.default_rng, np.random.RandomState, random.Random, torch.Generator])
def test_draws_of_a_generator_are_no_change_of_code(made: Callable[[], object]) -> None:
    """One that a script makes without a seed is another at each call, and one of a module has drawn before the next."""

    def digest(value: object) -> str:
        return code_digest(lambda: value)

    assert digest(made()) == digest(made()) != digest(made)


def test_a_bench_of_before_digests_goes_on(
    before: Path, module: Path, bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench().folder == before and _DONE in capsys.readouterr().out
    assert [verdict.complaint for verdict in verify_runs(before)] == ["", "", ""]
    assert load_trained(before / "theirs/seed_0").episodes == 2
    edit(module)
    assert bench().folder != before
    assert f"{_CHANGED} {before}" in capsys.readouterr().out, "its first session tells another version of the package"


def test_code_of_this_suite_has_no_digest() -> None:
    """An edit of another file would else end every bench that is under way; the commit stands beside results."""
    ours = [name for name in registry.agents() if registry.guest_with(registry.AGENT_GROUP, name) or name in OUR_AGENTS]
    assert len(ours) > 10
    assert protocol("arrow_puzzle", agents=tuple(ours)).code == ()
    assert plan_regression("toy_regression", "smoke")[0].code == ()


def test_studies_tasks_and_regressors_notice_changed_code(
    guests: Guests, module: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (Variant(name="one", agent="theirs"),)
    study = Study(name="few", question="?", budgets=(1,), seeds=(1000,), evaluation_episodes=1, variants=lines)
    (first,) = run_study(study, "arrow_puzzle", root=tmp_path, launcher=Inline())
    edit(module)
    (second,) = run_study(study, "arrow_puzzle", root=tmp_path, launcher=Inline())
    assert second.folder != first.folder and f"{_CHANGED} {first.folder}" in capsys.readouterr().out

    task = guests.new("task", "their_task") / "src/their_task.py"
    judgement = Judgement(task="their_task", models=("copy",))
    found = [(protocol("their_task", agents=("random",)).hash, judgement.folder_name)]
    edit(task)
    found.append((protocol("their_task", agents=("random",)).hash, judgement.folder_name))
    assert found[0][0] != found[1][0] and found[0][1] != found[1][1]

    line = guests.write("line", _REGRESSOR, {registry.REGRESSOR_GROUP: {"line": "line:ENTRY"}}) / "line.py"
    wanted = [plan_regression("toy_regression", "smoke", agents=("line",))[0]]
    edit(line)
    wanted.append(plan_regression("toy_regression", "smoke", agents=("line",))[0])
    assert wanted[0].hash != wanted[1].hash


def test_a_process_that_has_not_imported_an_agents_package_finds_the_same_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a new worker process, which is given the class by its name."""
    package = tmp_path / "site-packages"
    package.mkdir()
    (package / "packaged_agent.py").write_text("class Mine:\n    pass\n")
    monkeypatch.syspath_prepend(str(package))
    make = CodeByValue.of(import_module("packaged_agent").Mine)
    monkeypatch.setitem(registry.AGENTS, "mine", AgentEntry(make=make, needs_encoder=False))
    here = registered_code(["mine"])
    monkeypatch.delitem(sys.modules, "packaged_agent")
    assert registered_code(["mine"]) == here
    assert here != (("mine", make.digest),), "the files of the package count, too"
