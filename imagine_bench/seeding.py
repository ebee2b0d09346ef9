"""Randomness as a tree: every consumer gets its own generator, named by its path, and nothing is global.

Training, evaluation and tuning can never share an environment seed: the purpose is part of the number.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from imagine_bench.errors import InvalidValueError, require_known

Purpose = Literal[
    "training",
    "evaluation",
    "tuning",
    "encoder_training",
    "encoder_probe",
    "recording",
    "planning",
    "earlier_training",
    "feedback",
    "dataset",
    "board",
]
_PURPOSES: tuple[str, ...] = get_args(Purpose)
_SEED_BITS = 24
_EPISODE_BITS = 32
SEEDS = 1 << _SEED_BITS
"""Seeds of runs lie below."""
TUNING_SEEDS = 1000
"""Runs with a seed from here on are for choosing settings; reported runs have smaller ones."""


def _key(name: str | int) -> int:
    """A stable 32-bit spawn key: Python's own ``hash`` differs between processes."""
    return int.from_bytes(hashlib.sha256(str(name).encode()).digest()[:4], "little")


@dataclass(frozen=True)
class SeedTree:
    """A node of the seed tree; children are addressed by name, in any order, with the same result.

    ``root`` is the seed of the whole tree, at least 0, and ``path`` the names from there to this node.
    """

    root: int
    path: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.root < 0:
            raise InvalidValueError(f"Seed {self.root} is negative; give an integer of at least 0.")

    def child(self, *names: str | int) -> SeedTree:
        """The node below this one at ``names``."""
        return SeedTree(self.root, self.path + tuple(str(name) for name in names))

    def sequence(self) -> np.random.SeedSequence:
        """This node's SeedSequence."""
        return np.random.SeedSequence(self.root, spawn_key=tuple(_key(name) for name in self.path))

    def generator(self) -> np.random.Generator:
        """A fresh numpy generator of this node: every call starts the same stream again."""
        return np.random.default_rng(self.sequence())

    def integer(self) -> int:
        """A seed in [0, 2**63) for libraries that take one integer, such as ``torch.Generator.manual_seed``."""
        return int(self.sequence().generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_range(word: str) -> range:
    """The seeds of a word: ``7``, or ``0-21`` for 0, 1 and so on to 21. Raises InvalidValueError: it is neither."""
    first, dash, last = word.partition("-")
    last = last if dash else first
    seeds = range(int(first), int(last) + 1) if first.isdecimal() and last.isdecimal() else range(0)
    if not 1 <= len(seeds) <= TUNING_SEEDS:
        raise InvalidValueError(
            f"Seeds {word!r} are neither a number nor a range such as 0-21, of at most {TUNING_SEEDS:,} seeds."
        )
    return seeds


def seeds_text(seeds: Sequence[int]) -> str:
    """Ascending seeds as the command line takes them, three or more that follow each other as a range: ``0-5 9``."""
    words: list[str] = []
    for _, group in itertools.groupby(enumerate(seeds), key=lambda placed: placed[1] - placed[0]):
        some = [seed for _, seed in group]
        words += [f"{some[0]}-{some[-1]}"] if len(some) > 2 else map(str, some)
    return " ".join(words)


def is_tuning_seed(seed: int) -> bool:
    """Whether a run of this seed is for choosing settings."""
    return seed >= TUNING_SEEDS


def evaluation_split(seed: int) -> Purpose:
    """The starts of the tests of a run of this seed; a run for choosing settings meets no start of a reported one."""
    return "tuning" if is_tuning_seed(seed) else "evaluation"


def episode_seed(purpose: Purpose, seed: int, episode: int) -> int:
    """The environment seed of one episode; distinct (purpose, seed, episode) give distinct numbers, by construction.

    Raises:
        UnknownNameError: An unknown purpose.
        InvalidValueError: A seed outside [0, 2**24) or an episode outside [0, 2**32).
    """
    require_known("seed purpose", purpose, _PURPOSES)
    if not (0 <= seed < SEEDS and 0 <= episode < 1 << _EPISODE_BITS):
        raise InvalidValueError(
            f"seed {seed} and episode {episode} must lie in [0, 2**{_SEED_BITS}) and [0, 2**{_EPISODE_BITS})."
        )
    return (_PURPOSES.index(purpose) << (_SEED_BITS + _EPISODE_BITS)) | (seed << _EPISODE_BITS) | episode
