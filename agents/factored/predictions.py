"""What the model predicts of each code, kept until it learns otherwise: plans from many codes share it.

What an action does is predicted anew where transitions of that action were learned, or how often actions fail; what it
brings whenever anything was.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from .dynamics import EVERY
from .factors import Code
from .model import FactoredModel, Moves

Rows = NDArray[np.int64]

_HAPPENS = 1e-3
"""Branches in which the episode goes on less probably than this are not followed."""


class PredictedTransitions:
    """Codes that were met, numbered in rows, and what every action would lead to from those that were asked about.

    Attributes:
        reward: Expected reward. Shape (rows, A), as of ``unknown`` and ``ends``.
        unknown: Probability that something untested decides.
        ends: Probability that the episode ends.
        continues: Probability that each of B branches comes about and the episode goes on. Shape (rows, A, B).
        next: Rows where these lead, as far as they are followed; shape as of ``continues``.
    """

    def __init__(self, model: FactoredModel, branches: int) -> None:
        self._model = model
        self._index: dict[int, int] = {}
        self._numbers: list[int] = []
        pairs = (0, model.n_actions)
        triples = (0, model.n_actions, branches)
        self.reward = np.zeros(pairs)
        self.unknown = np.zeros(pairs)
        self.ends = np.zeros(pairs)
        self.continues = np.zeros(triples)
        self.next = np.zeros(triples, dtype=np.int64)
        self._chance = np.zeros(triples)
        self._following = np.zeros(triples, dtype=np.int64)
        self._certain = np.zeros(pairs)
        self._pooled_at = model.dynamics.pooled_at
        self._moved = np.zeros(pairs, dtype=np.bool_)
        self._known = np.zeros(0, dtype=np.bool_)

    def __len__(self) -> int:
        return len(self._index)

    def learned(self, actions: Iterable[int]) -> None:
        """The model learned something, and of the dynamics of these actions; or of all, if failures were pooled."""
        pooled_at = self._model.dynamics.pooled_at
        self._known[:] = False
        self._moved[:, list(actions) if pooled_at == self._pooled_at else EVERY] = False
        self._pooled_at = pooled_at

    def row(self, code: Code) -> int:
        """Its row, a new one if it is met for the first time."""
        return self._row(int(np.ravel_multi_index(code, self._model.sizes)))

    def _row(self, number: int) -> int:
        row = self._index.setdefault(number, len(self._index))
        if row == len(self._numbers):
            self._numbers.append(number)
        return row

    def expand(self, rows: Rows) -> None:
        """Predict what follows from those of ``rows`` of which it is not known."""
        self._grow()
        rows = rows[~self._known[rows]]
        if not len(rows):
            return
        self._move(rows)
        moves = Moves(self._codes(self._following[rows]), self._chance[rows], self._certain[rows])
        found = self._model.results(self._codes_of(rows), moves)
        continues = np.where(found.p_continues > _HAPPENS, found.p_continues, 0.0)
        following = self._met(self._following[rows], continues > 0.0)
        self._grow()
        self.reward[rows] = found.reward
        self.unknown[rows] = found.unknown
        self.ends[rows] = found.p_terminated
        self.next[rows] = following
        self.continues[rows] = continues
        self._known[rows] = True

    def following(self, rows: Rows) -> Rows:
        """Rows that may follow from ``rows``, which are expanded; each once."""
        return np.unique(self.next[rows][self.continues[rows] > 0.0])

    def _move(self, rows: Rows) -> None:
        """Predict the moves of ``rows`` that are not known."""
        new = ~self._moved[rows].any(axis=1)
        for some, actions in [(rows[new], EVERY), *self._stale(rows[~new])]:
            if len(some):
                moves = self._model.moves(self._codes_of(some), actions)
                following = np.ravel_multi_index(tuple(np.moveaxis(moves.following, -1, 0)), self._model.sizes)
                self._following[some, actions] = following
                self._chance[some, actions] = moves.chance
                self._certain[some, actions] = moves.known
                self._moved[some, actions] = True

    def _stale(self, rows: Rows) -> list[tuple[Rows, slice]]:
        """Of which actions the moves of which ``rows`` are not known."""
        stale = ~self._moved[rows]
        return [(rows[stale[:, action]], slice(action, action + 1)) for action in np.flatnonzero(stale.any(axis=0))]

    def _codes_of(self, rows: Rows) -> NDArray[np.int64]:
        return self._codes(np.array([self._numbers[row] for row in rows.tolist()]))

    def _codes(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Codes (..., P) of their numbers (...)."""
        return np.stack(np.unravel_index(numbers, self._model.sizes), axis=-1)

    def _met(self, numbers: NDArray[np.int64], follows: NDArray[np.bool_]) -> Rows:
        """Rows of the codes that follow, by their numbers (N, A, B); 0 elsewhere."""
        rows = np.zeros(numbers.shape, dtype=np.int64)
        found, which = np.unique(numbers[follows], return_inverse=True)
        rows[follows] = np.array([self._row(number) for number in found.tolist()], dtype=np.int64)[which]
        return rows

    def _grow(self) -> None:
        """Room for every row, at least twice as much as before."""
        more = len(self) - len(self._known)
        if more > 0:
            more = max(more, len(self._known))
            for name, array in vars(self).items():
                if isinstance(array, np.ndarray):
                    setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)]))
