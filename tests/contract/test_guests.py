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

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.registry.builtin import guests as own_guests

ROOT = Path(__file__).parents[2]
FOLDERS = sorted(file.parent for file in (ROOT / "agents" / "guests").glob("*/pyproject.toml"))
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


def project(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    return found


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda folder: folder.name)
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

    monkeypatch.setattr("imagine_bench.registry.entry_points", others)
    registry.offers.cache_clear()
    yield
    registry.offers.cache_clear()


@pytest.mark.usefixtures("without_guests")
def test_guests_that_are_not_installed_are_marked_and_named_with_their_install_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["describe"]) == 0
    marked = capsys.readouterr().out.partition("\nNot installed\n")[2].partition("\n\n")[0].splitlines()
    names = {name: folder for folder in FOLDERS for each in project(folder)["entry-points"].values() for name in each}
    assert {line.split()[0]: line.split(maxsplit=1)[1] for line in marked} == {
        name: f"pip install -e {folder}" for name, folder in names.items()
    }
    assert main(["bench", "--task", "arrow_puzzle", "--agents", "dqn", "dreamer_v3:replay_ratio=2"]) == 2
    said = capsys.readouterr().err
    where = f"Install it with: pip install -e {ROOT / 'agents' / 'guests' / 'peers'}"
    assert f"The agent dreamer_v3 is in the package imagine-bench-peers, which is not installed. {where}" in said
