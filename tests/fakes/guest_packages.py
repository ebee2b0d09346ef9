"""Packages of others as pip would leave them, without pip."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import gymnasium
import pytest

from imagine_bench import registry
from imagine_bench.tools.new import new_package

Offers = Mapping[str, Mapping[str, str]]
"""The offers of a package, as in its pyproject.toml: targets by name, by group."""


class Guests:
    """Packages that are installed until :meth:`forget`, which the fixture ``guests`` calls."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self._folder = folder
        self._patch = patch
        self._names: set[str] = set()

    def add(self, folder: Path) -> Path:
        """Install the package of a folder with a pyproject.toml; the folder."""
        project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
        return self._install(folder, project["name"], project["version"], project["entry-points"])

    def new(self, kind: str, name: str, *changes: tuple[str, str]) -> Path:
        """Install a package that ``imagine-bench new`` writes, with some of its code replaced."""
        self._folder.mkdir(exist_ok=True)
        new_package(kind, name, self._folder)
        module = self._folder / name / "src" / f"{name}.py"
        code = module.read_text()
        for old, new in changes:
            assert old in code
            code = code.replace(old, new)
        module.write_text(code)
        return self.add(self._folder / name)

    def write(self, name: str, code: str, offers: Offers) -> Path:
        """Install a package of one module."""
        folder = self._folder / name
        folder.mkdir(parents=True)
        (folder / f"{name}.py").write_text(code)
        return self._install(folder, name, "1.2", offers)

    def offer(self, folder: Path, offers: Offers) -> None:
        """Have an installed package offer something else."""
        (facts,) = folder.rglob("*.dist-info")
        lines = []
        for group, targets in offers.items():
            lines.append(f"[{group}]")
            lines += [f"{name} = {target}" for name, target in targets.items()]
        (facts / "entry_points.txt").write_text("\n".join(lines))
        registry.offers.cache_clear()

    def forget(self) -> None:
        """Leave nothing of them in this process; the patch takes their folders from the path."""
        for module in [module for module in sys.modules if module.partition(".")[0] in self._names]:
            sys.modules.pop(module)
        for env_id in [env_id for env_id in gymnasium.registry if env_id.partition("/")[0] in self._names]:
            gymnasium.registry.pop(env_id)
        registry.offers.cache_clear()

    def _install(self, folder: Path, name: str, version: str, offers: Offers) -> Path:
        source = folder / "src" if (folder / "src").is_dir() else folder
        facts = source / f"{name}-{version}.dist-info"
        facts.mkdir()
        (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        self._names.add(name)
        self._patch.syspath_prepend(source)
        self.offer(folder, offers)
        self.forget()
        return folder
