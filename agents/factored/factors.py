"""Codes of factors, transitions between them, and their replay memory.

A *factor* is one independent object of the scene as a discrete encoder finds it; a *code* holds one value a factor.
Shapes: ``N`` codes, ``P`` factors, ``A`` macro-actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Arrays

Code = tuple[int, ...]
Codes = NDArray[np.int64]


def as_codes(code: Code) -> Codes:
    """A code as an array (P,)."""
    return np.array(code, dtype=np.int64)


def table_size(factors: tuple[int, ...], sizes: tuple[int, ...]) -> int:
    """Joint values of some of the factors."""
    return int(np.prod([sizes[factor] for factor in factors]))


def strides(factors: tuple[int, ...], sizes: tuple[int, ...]) -> NDArray[np.int64]:
    """Multipliers that number the joint values of ``factors``, the last one fastest."""
    return np.array([table_size(factors[i + 1 :], sizes) for i in range(len(factors))], dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Memory:
    """The last value of a factor in an episode but one, which tells nothing and stands for never.

    A code with a memory ends with what is remembered.
    """

    factor: int
    hidden: int

    def after(self, remembered: int, code: Code) -> int:
        """What is remembered once a code was seen."""
        value = code[self.factor]
        return remembered if value == self.hidden else value

    def all_after(self, remembered: Codes, codes: Codes) -> Codes:
        """The same of many: ``remembered`` (...) and codes (..., P)."""
        values = codes[..., self.factor]
        return np.where(values == self.hidden, remembered, values)


class CodeTransition(NamedTuple):
    """One transition between codes.

    ``has_dynamics``: it happened, and so shows what follows what; False if it was only asked about.
    ``has_reward``: reward and end are known; False if a query about it got no label.
    """

    code: Code
    action: int
    following: Code
    reward: float
    terminated: bool
    has_dynamics: bool = True
    has_reward: bool = True


class CodeReplay:
    """Every transition that happened or was asked about, in that order; a few integers each, so none is dropped."""

    def __init__(self, factors: int) -> None:
        self._factors = factors
        self._rows: list[CodeTransition] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: CodeTransition) -> None:
        """Append one."""
        self._rows.append(row)

    def rows(self, first: int = 0, end: int | None = None) -> list[CodeTransition]:
        """The transitions from index ``first`` on, up to ``end``."""
        return self._rows[first:end]

    def recode(self, pairs: Sequence[tuple[Code, Code]], factors: int) -> None:
        """Give every transition other codes before and after, of so many factors."""
        self._factors = factors
        self._rows = [
            row._replace(code=code, following=following)
            for row, (code, following) in zip(self._rows, pairs, strict=True)
        ]

    def count_real(self, first: int = 0) -> int:
        """How many of them, from index ``first`` on, happened."""
        return sum(row.has_dynamics for row in self.rows(first))

    def count_labels(self, first: int = 0) -> int:
        """How many of them, from index ``first`` on, are labels of an oracle."""
        return sum(row.has_reward and not row.has_dynamics for row in self.rows(first))

    @property
    def without_label(self) -> frozenset[tuple[Code, int]]:
        """Codes and actions that were asked about and got no label."""
        return frozenset((row.code, row.action) for row in self._rows if not row.has_dynamics and not row.has_reward)

    def arrays(self) -> Arrays:
        """Copies of all rows, by column."""
        types = {"code": np.int64, "action": np.int64, "following": np.int64, "reward": np.float64}
        columns: Arrays = {}
        for name in CodeTransition._fields:
            columns[name] = np.array([getattr(row, name) for row in self._rows], dtype=types.get(name, np.bool_))
        return columns | {name: columns[name].reshape(-1, self._factors) for name in ("code", "following")}

    def load(self, arrays: Arrays) -> None:
        """Take up the rows of :meth:`arrays`."""
        self._factors = arrays["code"].shape[1]
        columns = (arrays[name].tolist() for name in CodeTransition._fields)
        self._rows = [
            CodeTransition(tuple(code), action, tuple(following), *rest)
            for code, action, following, *rest in zip(*columns, strict=True)
        ]
