"""Codes of factors, transitions between them, and the memory of an episode.

A *factor* is one independent object of the scene as a discrete encoder finds it; a *code* holds one value a factor.
Shapes: ``N`` codes, ``P`` factors, ``A`` macro-actions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Arrays, Bools, Ints

Code = tuple[int, ...]
Codes = Ints
"""Codes as rows. Shape (..., P)."""
Mask = Bools


def table_size(factors: Sequence[int], sizes: Sequence[int]) -> int:
    """Joint values of some of the factors."""
    return math.prod(sizes[factor] for factor in factors)


def strides(factors: Sequence[int], sizes: Sequence[int]) -> Ints:
    """Multipliers that number the joint values of ``factors``, the last one fastest."""
    return np.array([table_size(factors[i + 1 :], sizes) for i in range(len(factors))], dtype=np.int64)


class CodeTransition(NamedTuple):
    """One transition between codes.

    ``has_dynamics``: it happened, and so shows the order of codes; False if it was only asked about.
    ``has_reward``: reward and end are known; False if a query about it got no label.
    ``is_first``: an episode began with it.
    ``code_is_clear``, ``following_is_clear``: False where a hidden part leaves more than one value possible.
    """

    code: Code
    action: int
    following: Code
    reward: float
    terminated: bool
    has_dynamics: bool = True
    has_reward: bool = True
    is_first: bool = False
    code_is_clear: bool = True
    following_is_clear: bool = True

    @property
    def is_clear(self) -> bool:
        """Whether both codes are clear. Nothing is learned from other transitions."""
        return self.code_is_clear and self.following_is_clear


def as_arrays(rows: Sequence[CodeTransition], factors: int) -> Arrays:
    """Transitions between codes of so many factors, by column."""
    types = {"code": np.int64, "action": np.int64, "following": np.int64, "reward": np.float64}
    columns: Arrays = {}
    for name in CodeTransition._fields:
        columns[name] = np.array([getattr(row, name) for row in rows], dtype=types.get(name, np.bool_))
    return columns | {name: columns[name].reshape(-1, factors) for name in ("code", "following")}


def from_arrays(arrays: Arrays) -> list[CodeTransition]:
    """Undo :func:`as_arrays`."""
    columns = (arrays[name].tolist() for name in CodeTransition._fields)
    return [
        CodeTransition(tuple(code), action, tuple(following), *rest)
        for code, action, following, *rest in zip(*columns, strict=True)
    ]


class Memory(NamedTuple):
    """The last value of a factor in an episode but one, which tells nothing and stands for never.

    A code with a memory ends with the remembered values.
    """

    factor: int
    hidden: int

    def after(self, remembered: int, code: Code) -> int:
        """The memory once a code was seen."""
        value = code[self.factor]
        return remembered if value == self.hidden else value

    def all_after(self, remembered: Codes, codes: Codes) -> Codes:
        """The same of many: ``remembered`` (...) and codes (..., P)."""
        values = codes[..., self.factor]
        return np.where(values == self.hidden, remembered, values)


def remembering(rows: Sequence[CodeTransition], begins: Iterable[bool], memory: Memory | None) -> list[CodeTransition]:
    """Transitions whose codes end with the remembered values; codes that are not clear are not remembered.

    ``begins`` tells which transitions are the first of an episode.
    """
    if memory is None:
        return list(rows)
    found = []
    remembered = memory.hidden
    for row, first in zip(rows, begins, strict=True):
        before = memory.hidden if first else remembered
        if row.code_is_clear:
            before = memory.after(before, row.code)
        remembered = memory.after(before, row.following) if row.following_is_clear else before
        found.append(row._replace(code=(*row.code, before), following=(*row.following, remembered)))
    return found


def contradictions(rows: Sequence[CodeTransition]) -> int:
    """How many clear transitions brought another outcome than the first of the same codes and action."""
    told = [row for row in rows if row.is_clear]
    first = {row[:3]: row[3:5] for row in reversed(told)}
    return sum(first[row[:3]] != row[3:5] for row in told)
