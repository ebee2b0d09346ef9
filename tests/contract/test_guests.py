"""The suite's own guest packages: built as wheels, named where they are not installed, and offered as any package."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.metadata import Distribution, EntryPoints, distributions
from pathlib import Path
from typing import Any

import pytest
from guest_packages import Guests
from packaging.requirements import Requirement
from whole_outputs import Expected, masked, questions

import imagine_bench
from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError, SetupError
from imagine_bench.protocols.control import protocol, usual_agents
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.registry.builtin import guests as own_guests
from imagine_bench.running.control import plan_control
from imagine_bench.store.files import sealed, write_json

ROOT = Path(__file__).parents[2]
FOLDERS = sorted(file.parent for file in (ROOT / "agents" / "guests").glob("*/pyproject.toml"))
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


def project(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    return found


FEW = ("controls", "motion")
"""Guests whose wheels the fast tests build; ``make build`` and the slow tests build all, which have one layout."""
WHEELS = [pytest.param(folder, marks=[pytest.mark.slow] * (folder.name not in FEW)) for folder in FOLDERS]


@pytest.fixture(scope="module", params=WHEELS, ids=lambda folder: folder.name)
def installed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Distribution]:
    """A guest's folder, and the guest as a wheel leaves it in an empty environment."""
    source, out, site = (tmp_path_factory.mktemp(name) for name in ("source", "wheel", "site"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(request.param / name, source / name)
    shutil.copytree(request.param / "src", source / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=source, check=True, capture_output=True)
    (wheel,) = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (found,) = distributions(path=[str(site)])
    return request.param, found


def test_a_wheel_offers_every_agent_and_holds_one_package(installed: tuple[Path, Distribution]) -> None:
    folder, wheel = installed
    for group, offered in project(folder)["entry-points"].items():
        assert {point.name: point.value for point in wheel.entry_points.select(group=group)} == offered
    package = f"imagine_bench_{folder.name}"
    names = {path.as_posix() for path in wheel.files or []}
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {package}
    modules = {path.relative_to(folder / "src").as_posix() for path in (folder / "src" / package).rglob("*.py")}
    assert modules <= names and f"{package}/py.typed" in names


def test_the_extra_peers_names_the_guest_and_all_that_it_needs() -> None:
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["peers"]
    named = {str(Requirement(text)) for text in extra}
    needed = {str(Requirement(text)) for text in project(ROOT / "agents" / "guests" / "peers")["dependencies"]}
    assert named - {"imagine-bench-peers"} == needed - {"imagine-bench[agents]"}


def test_a_package_is_known_by_all_of_its_modules(guests: Guests) -> None:
    """Their code is in the version that results name."""
    offers = {registry.AGENT_GROUP: {"one": "pair:ONE"}, registry.TASK_GROUP: {"two": "pair_more.deep:TWO"}}
    guests.write("pair", "", offers)
    assert registry.guest_packages()["pair"] == {"pair", "pair_more"}


@pytest.fixture
def without_guests(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As where only imagine_bench is installed."""
    packages = {guest.package for guest in own_guests()}

    there = [point for each in distributions() if each.name not in packages for point in each.entry_points]

    def others(**chosen: str) -> EntryPoints:
        return EntryPoints(there).select(**chosen)

    monkeypatch.setattr("imagine_bench.registry.plugins.entry_points", others)
    registry.offers.cache_clear()
    yield
    registry.offers.cache_clear()


@pytest.mark.usefixtures("without_guests")
def test_absent_guests_are_marked_with_their_install_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], expected: Expected
) -> None:
    assert main(["describe"]) == 0
    marked = capsys.readouterr().out.partition("\nNot installed\n")[2].partition("\n\n")[0].splitlines()
    names = {name: folder for folder in FOLDERS for each in project(folder)["entry-points"].values() for name in each}
    lines = {name: f"pip install -e {folder}" for name, folder in names.items()}
    assert {line.split()[0]: line.split(maxsplit=1)[1] for line in marked} == lines
    with pytest.raises(InvalidValueError, match="There is an agent 'factored' already"):
        imagine_bench.register_agent("factored", "some:agent")
    write_json(tmp_path / "card.json", sealed({"control": "twist"}))  # of demonstrations
    answers = []
    for words in questions("not_installed"):
        assert main([word.replace("HERE", str(tmp_path)) for word in words.split()]) == 2
        answers += [f"$ {words}", masked(capsys.readouterr().err, ROOT)]
    expected("not_installed", "\n".join(answers))


@pytest.mark.usefixtures("without_guests")
def test_a_default_leaves_out_absent_agents_and_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    install = f"To install: pip install -e {ROOT / 'agents' / 'guests' / 'factored'}"
    default, _ = plan_control("arrow_puzzle", "quick")
    assert capsys.readouterr().out == f"Left out, as not installed: factored:given. {install}\n"
    assert set(usual_agents("arrow_puzzle", "quick")) - set(default.agents) == {"factored:given"}
    assert dict(default.few_seeds).keys() <= set(default.agents) and default.headlines
    by_hand, _ = plan_control("arrow_puzzle", "quick", agents=default.agents)
    assert capsys.readouterr().out == "" and by_hand.agents == default.agents
    for agents in ({}, {"agents": ("dqn", "factored")}):
        with pytest.raises(
            SetupError, match=r"is in the package imagine-bench-factored, which is not installed\. Install"
        ):
            plan_control("arrow_puzzle", "sample_efficiency", **agents)
    models, note = registry.installed_of(("copy", "structured"), registry.WORLD_MODEL_GROUP)
    assert models == ("copy",) and note == f"Left out, as not installed: structured. {install}"
    agents, note = registry.installed_of(("dqn", "factored:given,planning.depth=1"))
    assert agents == ("dqn",) and note == f"Left out, as not installed: factored:given,planning.depth=1. {install}"


def test_a_default_has_every_agent_where_all_are_installed() -> None:
    for preset in PRESETS:
        usual = usual_agents("arrow_puzzle", preset)
        assert protocol("arrow_puzzle", preset).agents == usual and registry.installed_of(usual) == (usual, "")


@pytest.mark.usefixtures("without_guests")
def test_kept_results_of_a_guest_that_is_not_installed_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = shutil.copytree(ROOT / "docs" / "results" / "arrow_puzzle-sample_efficiency", tmp_path / "kept")
    assert main(["report", str(kept)]) == 0
    assert "\nfactored:given" in capsys.readouterr().out


def test_an_old_path_into_an_absent_guest_names_its_install() -> None:
    absent = "import sys; sys.modules['imagine_bench_factored'] = None; import imagine_bench.agents.factored.settings"
    done = subprocess.run([sys.executable, "-c", absent], capture_output=True, text=True, check=False)
    assert "ModuleNotFoundError: " in done.stderr
    assert "imagine-bench-factored, which is not installed. Install it with: pip" in done.stderr


def test_no_other_package_takes_the_name_of_a_guests_agent(guests: Guests) -> None:
    guests.write("taker", "", {registry.AGENT_GROUP: {"factored": "taker:ONE"}})
    assert registry.agent_entry("factored").make == "imagine_bench_factored.learned:make"
    assert any(
        "offers taker:ONE as agent factored, a name that is taken" in str(each) for each in registry.refused_offers()
    )


def test_runs_share_a_process_unless_code_of_others_takes_part() -> None:
    ours = ("imagine_bench.agents.dqn", "imagine_bench_factored.agent", "imagine_bench_controls.swaps")
    assert all(registry.is_ours(f"{module}:make") for module in ours)
    others = ("imagine_bench_peers.sb3", "imagine_bench_of_others", "__main__")
    assert not any(registry.is_ours(f"{module}:make") for module in others)
