"""What an ordinary user installs: a wheel that holds only ``imagine_bench``, with everything it needs at run time."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

_TOP = Path(__file__).parent.parent
_ROOMS = ("tasks", "agents", "assets")


def packages() -> dict[str, Path]:
    """Every folder with Python in it, by the name of the package it installs as."""
    found = {}
    for room in ("imagine_bench", *_ROOMS):
        for init in (_TOP / room).rglob("*.py"):
            parts = init.parent.relative_to(_TOP).parts
            found[".".join(parts if room == "imagine_bench" else ("imagine_bench", *parts))] = init.parent
    return found


def test_every_folder_with_python_is_installed() -> None:
    listed = tomllib.loads((_TOP / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    assert sorted(packages()) == sorted(listed)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Names in a wheel built from a copy of the tracked and new files, so that the checkout stays as it is."""
    copy, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    listing = subprocess.run(
        ["git", "-C", str(_TOP), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        check=True,
    )
    for name in filter(None, listing.stdout.decode().split("\0")):
        if (_TOP / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).write_bytes((_TOP / name).read_bytes())
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        str(out),
        str(copy),
    ]
    subprocess.run(command, check=True, capture_output=True)
    (built,) = out.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        return archive.namelist()


def test_the_wheel_holds_only_imagine_bench(wheel: list[str]) -> None:
    tops = {name.split("/")[0] for name in wheel}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"imagine_bench"}


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
    assert missing == []
    assert any(name.endswith(".safetensors") for name in wheel)  # non-vacuous
