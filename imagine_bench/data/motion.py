"""Demonstrations: real episodes of continuous control, in the formats of datasets, read and written one at a time.

An episode of N commands is these arrays, by name:

==================  ===========================  ==============================================================
``hand, front``     uint8 (N + 1, size, size, 3)  images before each command, and after the last
``proprio``         float32 (N + 1, 16)          the arm's own sense, likewise
``actions``         float32 (N, A)               commands
``rewards``         float64 (N,)                 rewards
``terminated``      bool (N,)                    whether the episode ended there by the rules
``truncated``       bool (N,)                    whether it was cut off there
``success``         bool (N,)                    whether it ended there in success
``macro_action``    int64 (N,)                   the macro-action under way, -1 where there is none
``instruction``     str (N,)                     the wish of the person at that moment, in words
==================  ===========================  ==============================================================

LeRobot's rows are commands: there the observation after the last one is left out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.arrays import Arrays, content_hash
from imagine_bench.data.folder import FORMATS, read_card
from imagine_bench.errors import ArtefactError

CAMERAS = ("hand", "front")
OBSERVATIONS = (*CAMERAS, "proprio")
"""The arrays that hold one entry more than there are commands."""
PROPRIO_NAMES = (
    *(f"joint {index}, rad" for index in range(7)),
    *("left finger, m", "right finger, m"),
    *(f"hand {axis}, m" for axis in "xyz"),
    *(f"hand quaternion {part}" for part in "wxyz"),
)
"""The meaning of each number of ``proprio``."""
OUTCOMES = ("rewards", "terminated", "truncated", "success", "instruction")
"""The arrays that follow from the commands."""


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """A folder of demonstrations."""

    folder: Path  #: where it lies
    card: Mapping[str, Any]  #: its facts

    def __iter__(self) -> Iterator[Arrays]:
        """Each episode. Raises ArtefactError: it is damaged."""
        yield from registry.load(FORMATS[self.card["format"]]).read_motion(self.folder)


def read_demonstrations(folder: Path) -> Demonstrations:
    """The demonstrations of a folder; episodes are read when they are asked for.

    Raises:
        ArtefactError: There are none, or the card is damaged.
        SetupError: The library that the format needs is not installed.
    """
    card = read_card(folder)
    if card is None or "control" not in card:
        raise ArtefactError(f"{folder} has no demonstrations; 'imagine-bench dataset ArrowPuzzleMotion' makes some.")
    registry.load(FORMATS[card["format"]])
    return Demonstrations(folder=folder, card=card)


class Digest:
    """A digest of episodes, in their order: the same in each format."""

    def __init__(self) -> None:
        self._sha = hashlib.sha256()

    def add(self, episode: Arrays) -> None:
        """Add an episode."""
        n_steps = len(episode["rewards"])
        held = {name: array[:n_steps] for name, array in episode.items()}
        self._sha.update(content_hash(held).encode())

    def __str__(self) -> str:
        return self._sha.hexdigest()
