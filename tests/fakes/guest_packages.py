"""Packages of others as pip would leave them, without pip."""

from __future__ import annotations

import tomllib
from pathlib import Path


def install(folder: Path) -> Path:
    """Put beside a package's module what its pyproject.toml says; the folder is then one for ``sys.path``."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    facts = folder / f"{project['name']}-{project['version']}.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in each.items()) for group, each in groups
    ]
    (facts / "entry_points.txt").write_text("".join(lines))
    return folder
