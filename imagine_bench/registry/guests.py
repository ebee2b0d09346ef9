"""The guests of this suite: packages with agents of their own, known by name also where they are not installed.

Their ``pyproject.toml`` files lie in the checkout and in the wheel; the code of a guest is in its own package alone.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Guest:
    """A package of this suite that is installed apart from it."""

    package: str  #: its name as pip knows it
    names: Mapping[str, tuple[str, ...]]  #: what it offers, by group of entry points
    install: str  #: the command line that installs it


@functools.cache
def guests() -> tuple[Guest, ...]:
    """All guests of this suite, installed or not, in the order of their folders."""
    folder = Path(str(resources.files("imagine_bench.agents"))) / "guests"
    return tuple(_guest(file) for file in sorted(folder.glob("*/pyproject.toml")))


def guest_of(name: str, group: str) -> Guest | None:
    """The guest that offers a name in a group of entry points, or None."""
    return next((guest for guest in guests() if name in guest.names.get(group, ())), None)


def _guest(file: Path) -> Guest:
    project = tomllib.loads(file.read_text())["project"]
    in_checkout = (file.parent / "src").is_dir()
    return Guest(
        package=project["name"],
        names={group: tuple(points) for group, points in project["entry-points"].items()},
        install=f"pip install -e {file.parent}" if in_checkout else f"pip install {project['name']}",
    )
