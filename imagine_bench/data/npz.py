"""Episodes as one numpy archive, ``episodes.npz``, of the arrays of :class:`.Episodes`; it needs no other library."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.store.files import read_arrays, reading, write_arrays
from imagine_bench.values import Json


def write(folder: Path, episodes: Episodes, card: Mapping[str, Json]) -> None:
    """Write the archive."""
    write_arrays(folder / "episodes.npz", episodes.arrays())


def read(path: Path) -> Episodes:
    """Read an archive. Raises ArtefactError: it is damaged, or the arrays are not those of episodes."""
    what = "an archive of episodes"
    with reading(path, what):
        return Episodes(**read_arrays(path, what))
