"""Episodes as one numpy archive, ``episodes.npz``, of the arrays of :class:`.Episodes`; it needs no other library.

Demonstrations are an archive an episode, ``episodes/000000.npz`` and so on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from imagine_bench.arrays import Arrays
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


def write_motion(folder: Path, episodes: Iterator[Arrays], card: Mapping[str, Json]) -> None:
    """Write demonstrations, one after another."""
    for index, episode in enumerate(episodes):
        write_arrays(folder / f"episodes/{index:06}.npz", episode)


def read_motion(folder: Path) -> Iterator[Arrays]:
    """Read demonstrations, one at a time. Raises ArtefactError: one is damaged."""
    for path in sorted(folder.glob("episodes/*.npz")):
        yield read_arrays(path, "an archive of one episode")
