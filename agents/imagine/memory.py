"""Every real transition between codes, in the order it happened."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..snapshot import Arrays


class CodeTransition(NamedTuple):
    """One real transition between codes, one value a part each."""

    code: tuple[int, ...]
    action: int
    following: tuple[int, ...]
    reward: float
    terminated: bool


class CodeMemory:
    """Transitions between codes of P parts; a few integers each, so none is ever forgotten.

    Args:
        parts: P.
    """

    def __init__(self, parts: int) -> None:
        self._parts = parts
        self._rows: list[CodeTransition] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: CodeTransition) -> None:
        """Remember one more."""
        self._rows.append(row)

    def since(self, first: int) -> Iterator[CodeTransition]:
        """The transitions from index ``first`` on."""
        return iter(self._rows[first:])

    def arrays(self) -> Arrays:
        """Copies of all rows, by column."""
        return {
            "code": np.array([row.code for row in self._rows], dtype=np.int64).reshape(-1, self._parts),
            "action": np.array([row.action for row in self._rows], dtype=np.int64),
            "following": np.array([row.following for row in self._rows], dtype=np.int64).reshape(-1, self._parts),
            "reward": np.array([row.reward for row in self._rows], dtype=np.float64),
            "terminated": np.array([row.terminated for row in self._rows], dtype=np.bool_),
        }

    def load(self, arrays: Arrays) -> None:
        """Take up the rows of :meth:`arrays`."""
        columns = (arrays[name].tolist() for name in CodeTransition._fields)
        self._rows = [
            CodeTransition(tuple(code), action, tuple(following), reward, terminated)
            for code, action, following, reward, terminated in zip(*columns, strict=True)
        ]
