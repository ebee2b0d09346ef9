"""The installation of an ordinary user: a wheel that holds only ``imagine_bench``, with everything it needs at run
time.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from imagine_bench.errors import EXTRAS
from imagine_bench.version import __version__

_TOP = Path(__file__).parent.parent
_PROJECT = tomllib.loads((_TOP / "pyproject.toml").read_text())
_LOCK = (_TOP / ".ci/requirements.lock").read_text()
_PYTHONS = ("3.11", "3.12", "3.13", "3.14")
_GUESTS = ("board", "controls", "factored", "motion", "peers", "programs", "regression", "serving")
_ROOMS = ("tasks", "agents", "assets")


def packages() -> dict[str, Path]:
    """Every folder with Python in it, by the name of the package it installs as."""
    found = {}
    for room in ("imagine_bench", *_ROOMS):
        for init in (path for path in (_TOP / room).rglob("*.py") if "guests" not in path.relative_to(_TOP).parts):
            parts = init.parent.relative_to(_TOP).parts
            found[".".join(parts if room == "imagine_bench" else ("imagine_bench", *parts))] = init.parent
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Names in a wheel built from a copy of the tracked and new files, so that the checkout stays as it is."""
    copy, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    files = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", ":!docs", ":!tests"]
    listing = subprocess.run(files, cwd=_TOP, capture_output=True, check=True)
    for name in filter(None, listing.stdout.decode().split("\0")):
        if (_TOP / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).write_bytes((_TOP / name).read_bytes())
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(out)], cwd=copy, check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        return archive.namelist()


def test_the_wheel_holds_only_imagine_bench(wheel: list[str]) -> None:
    tops = {name.split("/")[0] for name in wheel}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"imagine_bench"}
    of_guests = [f"imagine_bench/agents/guests/{guest}/pyproject.toml" for guest in _GUESTS]
    assert sorted(name for name in wheel if "guest" in name) == of_guests


def test_the_wheel_holds_every_module_and_resource(wheel: list[str]) -> None:
    missing = []
    for package, folder in packages().items():
        where = package.replace(".", "/")
        files = [path for path in folder.iterdir() if path.suffix == ".py"]
        missing += [f"{where}/{path.name}" for path in files if f"{where}/{path.name}" not in wheel]
    for room in ("imagine_bench", "assets"):
        for path in (_TOP / room).rglob("*"):
            if path.suffix in (".json", ".xml", ".png", ".safetensors", ".html", ".md", ".j2", ".css"):
                inside = path.relative_to(_TOP / room)
                name = f"imagine_bench/{inside}" if room == "imagine_bench" else f"imagine_bench/assets/{inside}"
                missing += [name] if name not in wheel else []
    assert missing == [], "name a new folder in packages of pyproject.toml"
    assert any(name.endswith(".safetensors") for name in wheel)  # non-vacuous


def locked(python: str) -> dict[str, Version]:
    """Versions that the lock gives a Python on Linux."""
    system = {"python_version": python, "python_full_version": f"{python}.5", "sys_platform": "linux"}
    lines = [Requirement(line.rstrip(" \\")) for line in _LOCK.splitlines() if "==" in line]
    found = [line for line in lines if line.marker is None or line.marker.evaluate(system)]
    assert len({line.name for line in found}) == len(found) > 50, "one version each"
    return {line.name: Version(str(line.specifier).removeprefix("==")) for line in found}


@pytest.mark.parametrize("python", _PYTHONS)
def test_the_lock_meets_every_requirement(python: str) -> None:
    extras = _PROJECT["project"]["optional-dependencies"]
    versions = locked(python) | {"torch": Version(torch_version())}
    of_all = [text for name in ("agents", "report", "rerun", "dev", "docs") for text in extras[name]]
    for text in [*_PROJECT["project"]["dependencies"], *of_all]:
        wanted = Requirement(text)
        if wanted.name == "imagine-bench":
            continue
        if wanted.marker is None or wanted.marker.evaluate({"python_version": python}):
            assert wanted.name in versions, f"{wanted.name} is not in the lock; run 'make lock'"
            assert versions[wanted.name] in wanted.specifier, f"the lock has another {wanted.name}; run 'make lock'"


def test_every_python_gets_the_versions_of_the_others() -> None:
    """The packages that bits depend on differ between no two Pythons."""
    shared = set.intersection(*({*locked(python).items()} for python in _PYTHONS))
    assert {"daqp", "gymnasium", "mink", "mujoco", "numpy", "safetensors", "scipy"} <= {name for name, _ in shared}
    assert "dm-control" in locked("3.12") and "dm-control" not in locked("3.13"), "labmaze has no wheel for it"


def test_the_lock_has_a_hash_for_everything_and_names_no_host() -> None:
    entries = re.split(r"^(?=[a-z0-9])", _LOCK, flags=re.MULTILINE)[1:]
    assert len(entries) > 80 and all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries)
    assert "//" not in _LOCK and "--index" not in _LOCK and "--find-links" not in _LOCK


def torch_version() -> str:
    """The version of torch that setup installs, the only package that is not in the lock."""
    (described,) = tomllib.loads((_TOP / ".ci/lock.toml").read_text())["dependency-metadata"]
    return str(described["version"])


def test_torch_is_pinned_alike_and_its_needs_are_locked() -> None:
    (described,) = tomllib.loads((_TOP / ".ci/lock.toml").read_text())["dependency-metadata"]
    assert "torch" not in locked("3.11")
    assert f"readonly torch={torch_version()}\n" in (_TOP / ".ci/setup.sh").read_text()
    for needed in map(Requirement, metadata.requires("torch") or []):
        of_gpus = needed.name.startswith(("nvidia-", "cuda-")) or needed.name == "triton"
        if not of_gpus and (needed.marker is None or needed.marker.evaluate({"extra": ""})):
            assert str(needed) in described["requires-dist"]
            assert locked("3.11")[needed.name] in needed.specifier


def test_environments_alone_need_no_torch_rerun_or_matplotlib() -> None:
    """In a process that finds no module of an extra: an episode, the lists, the rules; and the answer of a bench."""
    code = f"""
import sys
from importlib.machinery import PathFinder
class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, *rest):
        return None if name.partition(".")[0] in {sorted(EXTRAS)} else super().find_spec(name, *rest)
sys.meta_path = [Without if finder is PathFinder else finder for finder in sys.meta_path]
import gymnasium, imagine_bench
from imagine_bench.cli import exit_code as main
env = gymnasium.make("imagine_bench/PickPlace-v0", execution="kinematic")
env.reset(seed=0)
env.step(0)
env.close()
assert main(["list"]) == 0
assert main(["doctor"]) == 0
assert main(["check", "--task", "pick_place"]) == 0
assert main(["bench", "--task", "arrow_puzzle", "--preset", "smoke"]) == 2
assert main(["view"]) == 2
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "This needs matplotlib, which is not installed: pip install 'imagine-bench[report]'." in done.stderr
    assert "This needs rerun, which is not installed: pip install 'imagine-bench[rerun]'." in done.stderr


def test_every_module_of_an_extra_is_brought_by_it() -> None:
    brought = {"PIL": "pillow", "rerun": "rerun-sdk", "pygame": "pygame-ce", "hydra": "hydra-core"}
    for module, extra in EXTRAS.items():
        named = [Requirement(text).name for text in _PROJECT["project"]["optional-dependencies"][extra]]
        assert brought.get(module, module.replace("_", "-")) in named


def test_python_versions_agree() -> None:
    wanted = Requirement(f"python{_PROJECT['project']['requires-python']}").specifier
    assert [minor for minor in range(30) if f"3.{minor}.1" in wanted] == [int(python[2:]) for python in _PYTHONS]
    assert f'readonly versions="{" ".join(_PYTHONS)}"' in (_TOP / ".ci/setup.sh").read_text()


def test_the_container_installs_what_drawing_needs() -> None:
    """On a bare Debian; no builder of images runs here."""
    steps = (_TOP / ".ci/Dockerfile").read_text()
    gl_packages = re.search(r'gl_packages="([^"]+)"', (_TOP / ".ci/setup.sh").read_text())
    assert gl_packages is not None
    (installs,) = re.findall(r"apt-get install (.*)", steps)
    assert {"make", "git", *gl_packages[1].split()} <= set(installs.split())


def test_version_and_authors_are_those_of_changelog_and_citation() -> None:
    """A version that is not released yet is a development version of the one that the changelog announces."""
    newest = re.findall(r"^## (.*)$", (_TOP / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    announced = re.search(r"\d+\.\d+\.\d+", newest)
    version = Version(__version__)
    assert announced is not None and version.base_version == announced[0]
    assert version.is_devrelease == newest.startswith("Unreleased")
    citation = (_TOP / "CITATION.cff").read_text().partition("references:")[0]
    assert f"\nversion: {__version__}\n" in citation
    assert re.findall(r'- name: "(.*)"', citation) == [each["name"] for each in _PROJECT["project"]["authors"]]


def test_whatever_ci_fetches_is_named_by_its_digest() -> None:
    """Actions by commit, packages by a lock with hashes; only the job of MuJoCo's newest version floats."""
    for workflow in (_TOP / ".github/workflows").glob("*.yml"):
        text = workflow.read_text()
        for used in re.findall(r"uses: (\S+)", text):
            assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", used), used
        for line in re.findall(
            r"(?:pip install|uv pip) .*", text.partition("  mujoco-4:")[0] + text.partition("  lowest:")[2]
        ):
            assert "--require-hashes" in line or "--no-deps --no-build-isolation -e ." in line, line
    for lock in (_TOP / ".ci").glob("*.lock"):
        for wanted in re.split(r"\n(?=\S)", lock.read_text()):
            assert wanted.startswith("#") or "--hash=sha256:" in wanted, f"{lock.name}: {wanted}"
