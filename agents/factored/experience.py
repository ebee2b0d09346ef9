"""Every transition between codes that was lived through or asked about, in that order."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..snapshot import Arrays


class CodeTransition(NamedTuple):
    """One transition between codes, one value a part each.

    Attributes:
        code: Before.
        action: The macro-action.
        following: After.
        reward: Of this task.
        terminated: Whether the episode ended.
        moves: Whether it happened, and so shows what follows what; not if it was only asked about.
        pays: Whether reward and end are known; not if a question about it had no answer.
    """

    code: tuple[int, ...]
    action: int
    following: tuple[int, ...]
    reward: float
    terminated: bool
    moves: bool = True
    pays: bool = True


class CodeMemory:
    """Transitions between codes of P parts; a few integers each, so none need ever be forgotten.

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

    def real(self, since: int = 0) -> int:
        """How many of them, from index ``since`` on, happened."""
        return sum(row.moves for row in self.since(since))

    def told(self, since: int = 0) -> int:
        """How many of them, from index ``since`` on, are answers."""
        return sum(row.pays and not row.moves for row in self.since(since))

    @property
    def in_vain(self) -> frozenset[tuple[tuple[int, ...], int]]:
        """Codes and actions that were asked about without an answer."""
        return frozenset((row.code, row.action) for row in self._rows if not row.moves and not row.pays)

    def arrays(self) -> Arrays:
        """Copies of all rows, by column."""
        return {
            "code": np.array([row.code for row in self._rows], dtype=np.int64).reshape(-1, self._parts),
            "action": np.array([row.action for row in self._rows], dtype=np.int64),
            "following": np.array([row.following for row in self._rows], dtype=np.int64).reshape(-1, self._parts),
            "reward": np.array([row.reward for row in self._rows], dtype=np.float64),
            **{
                name: np.array([getattr(row, name) for row in self._rows], dtype=np.bool_)
                for name in ("terminated", "moves", "pays")
            },
        }

    def load(self, arrays: Arrays) -> None:
        """Take up the rows of :meth:`arrays`."""
        columns = (arrays[name].tolist() for name in CodeTransition._fields)
        self._rows = [
            CodeTransition(tuple(code), action, tuple(following), *rest)
            for code, action, following, *rest in zip(*columns, strict=True)
        ]
