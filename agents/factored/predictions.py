"""What the model predicts of each code, kept until the model learns: plans from many codes share it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .factors import Code, Codes
from .model import FactoredModel

Rows = NDArray[np.int64]

_HAPPENS = 1e-3
"""Branches in which the episode goes on less probably than this are not followed."""


class Predictions:
    """Codes that were met, numbered in rows, and what every action would lead to from those that were asked about.

    Attributes:
        reward: Expected reward. Shape (rows, A), as of ``unknown`` and ``ends``.
        unknown: Probability that something untested decides.
        ends: Probability that the episode ends.
        next: Rows that may follow, 0 where nothing does. Shape (rows, A, B), as of ``continues``.
        continues: Probability that this one follows and the episode goes on.
    """

    def __init__(self, model: FactoredModel, branches: int) -> None:
        self._model = model
        self._index: dict[Code, int] = {}
        self._known = np.zeros(0, dtype=np.bool_)
        actions = (0, model.n_actions)
        self.reward, self.unknown, self.ends = np.zeros(actions), np.zeros(actions), np.zeros(actions)
        self.next, self.continues = np.zeros((*actions, branches), dtype=np.int64), np.zeros((*actions, branches))
        self._codes: list[Code] = []

    def __len__(self) -> int:
        return len(self._index)

    def row(self, code: Code) -> int:
        """Its row, a new one if it is met for the first time."""
        row = self._index.setdefault(code, len(self._index))
        if row == len(self._codes):
            self._codes.append(code)
        return row

    def expand(self, rows: Rows) -> None:
        """Predict what follows from those of ``rows`` of which it is not known."""
        self._grow()
        new = rows[~self._known[rows]]
        if not len(new):
            return
        found = self._model.successors(np.array([self._codes[row] for row in new.tolist()], dtype=np.int64))
        continues = np.where(found.p_continues > _HAPPENS, found.p_continues, 0.0)
        following = self._rows(found.following, continues > 0.0)
        self._grow()
        self.reward[new], self.unknown[new], self.ends[new] = found.reward, found.unknown, found.p_terminated
        self.next[new], self.continues[new] = following, continues
        self._known[new] = True

    def following(self, rows: Rows) -> Rows:
        """Rows that may follow from ``rows``, which are expanded; each once."""
        return np.unique(self.next[rows][self.continues[rows] > 0.0])

    def _rows(self, codes: Codes, follows: NDArray[np.bool_]) -> Rows:
        """Rows of the codes (N, A, B, P) that follow, 0 elsewhere. Shape (N, A, B)."""
        rows = np.zeros(follows.shape, dtype=np.int64)
        if follows.any():
            found = codes[follows]
            packed = np.ravel_multi_index(tuple(found.T), tuple(found.max(axis=0) + 1))
            _, first, which = np.unique(packed, return_index=True, return_inverse=True)
            rows[follows] = np.array([self.row(tuple(code)) for code in found[first].tolist()])[which]
        return rows

    def _grow(self) -> None:
        """Room for every row, at least twice as much as before."""
        more = len(self) - len(self._known)
        if more > 0:
            more = max(more, len(self._known))
            for name in ("_known", "reward", "unknown", "ends", "next", "continues"):
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)]))
