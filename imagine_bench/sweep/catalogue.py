"""The grids by name: those in ``sweep/grids``, and the studies that installed packages offer."""

from __future__ import annotations

from pathlib import Path

from imagine_bench import registry
from imagine_bench.sweep.grid import Study, Suite, read_grid

SUITE = "suite"
"""Name of the benchmark suite."""
_FOLDER = Path(__file__).parent / "grids"
GRIDS = {path.stem: read_grid(path) for path in sorted(_FOLDER.glob("*.toml"))}
(LADDER,) = (grid for grid in GRIDS.values() if isinstance(grid, Suite))
"""The suite of ``make suite``; two cores are meant to finish it within the hour."""
STUDIES = {name: grid for name, grid in GRIDS.items() if isinstance(grid, Study)}
registry.describe_group(registry.STUDY_GROUP, what="study", kind=Study, own=GRIDS)


def grid_named(name: str) -> Study | Suite:
    """The grid of a name, or of a file if the name ends in ``.toml`` or ``.json``.

    Raises:
        UnknownNameError: No such grid.
        InvalidValueError: The file is no grid.
        SetupError: A package offers it, and it cannot be loaded.
    """
    if name.endswith((".toml", ".json")):
        return read_grid(Path(name))
    grid: Study | Suite = registry.offered(name, GRIDS, registry.STUDY_GROUP)
    return grid


def all_grids() -> dict[str, Study | Suite]:
    """All grids by name, also those of installed packages, without those that cannot be loaded."""
    return {**GRIDS, **registry.usable(registry.STUDY_GROUP)}
