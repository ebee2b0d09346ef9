"""Planning with the model: what follows from a code is predicted once, and values are backed up through it.

Two values are planned. The *value* of an action is the expected discounted reward (value iteration in the learned
model, Sutton 1990). Its *novelty* is the largest discounted chance of meeting something unknown on the way: the best
single discovery, not a sum, so that cycles gain nothing. Acting for novelty until there is nothing left to find, then
for value, is "explicit explore or exploit" (E3, Kearns & Singh 2002); valuing the unknown at the best reward seen is
R-max (Brafman & Tennenholtz 2002). A search for the unknown ends as soon as nothing farther can be worth as much.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from imagine_bench.interfaces import Floats

from .factors import Code, Ints
from .model import FactoredModel
from .settings import PlanningSettings

_KEPT = 20
"""Predictions of more codes than so many plans visit are dropped."""
TIE = 1e-9
"""Actions whose values differ by less are worth the same."""

_HAPPENS = 1e-3
"""Branches in which the episode goes on less probably than this are not followed."""

Objective = Literal["value", "optimistic", "novelty"]


class PredictedTransitions:
    """Codes that were met, numbered in rows, and what every action would lead to from those that were asked about.

    Attributes:
        reward: Expected reward. Shape (rows, A), as of ``unknown`` and ``ends``.
        unknown: Probability that something untested decides.
        ends: Probability that the episode ends.
        continues: Probability that each of B branches comes about and the episode goes on. Shape (rows, A, B).
        next: Rows where these lead, as far as they are followed; shape as of ``continues``.
        known: Whether these are what the model predicts now. Shape (rows,).
    """

    def __init__(self, model: FactoredModel, branches: int) -> None:
        self._model = model
        self._rows: dict[int, int] = {}
        self._numbers: list[int] = []
        pairs = (0, model.n_actions)
        triples = (*pairs, branches)
        self.reward = np.zeros(pairs)
        self.unknown = np.zeros(pairs)
        self.ends = np.zeros(pairs)
        self.continues = np.zeros(triples)
        self.next = np.zeros(triples, dtype=np.int64)
        self.known = np.zeros(0, dtype=np.bool_)

    def __len__(self) -> int:
        return len(self._rows)

    def row(self, number: int) -> int:
        """The row of a code, by its number; a new one if it is met for the first time."""
        row = self._rows.setdefault(number, len(self._rows))
        if row == len(self._numbers):
            self._numbers.append(number)
        return row

    def expand(self, rows: Ints) -> None:
        """Predict what follows from those of ``rows`` of which it is not known."""
        self._grow()
        rows = rows[~self.known[rows]]
        if not len(rows):
            return
        sizes = self._model.sizes
        numbers = np.array([self._numbers[row] for row in rows.tolist()])
        codes = np.stack(np.unravel_index(numbers, sizes), axis=-1)
        moves = self._model.moves(codes)
        found = self._model.results(codes, moves)
        follows = found.p_continues > _HAPPENS
        numbers, which = np.unique(np.ravel_multi_index(tuple(moves.following[follows].T), sizes), return_inverse=True)
        following = np.zeros(follows.shape, dtype=np.int64)
        following[follows] = np.array([self.row(number) for number in numbers.tolist()], dtype=np.int64)[which]
        self._grow()
        self.reward[rows] = found.reward
        self.unknown[rows] = found.unknown
        self.ends[rows] = found.p_terminated
        self.next[rows] = following
        self.continues[rows] = np.where(follows, found.p_continues, 0.0)
        self.known[rows] = True

    def _grow(self) -> None:
        """Room for every row, at least twice as much as before."""
        more = len(self) - len(self.known)
        if more > 0:
            more = max(more, len(self.known))
            for name, array in vars(self).items():
                if isinstance(array, np.ndarray):
                    setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)]))


class Planner:
    """Plans with one model, which must say when it :meth:`learned`.

    A plan holds everything within reach of a code, and then all its codes share it, or, where too much is within
    reach, what is nearest to that code: so values never depend on what was asked before, and a resumed agent finds the
    same.
    """

    def __init__(self, model: FactoredModel, settings: PlanningSettings) -> None:
        self._model = model
        self._settings = settings
        self._predictions = PredictedTransitions(model, settings.branches)
        self.learned()
        self.expanded = 0
        """Codes of the newest plan whose successors are predicted."""

    def learned(self) -> None:
        """The model has learned something: plan anew."""
        self._predictions.known[:] = False
        self._known: dict[tuple[Objective, int], dict[int, Floats]] = {}

    def values(self, code: Code, objective: Objective = "value", left: int | None = None) -> Floats:
        """What each action in ``code`` is worth, with so many macro-actions left, or as many as it plans: (A,).

        ``"value"`` is the expected discounted reward; ``"optimistic"`` the same if whatever is unknown brought the
        largest reward seen; ``"novelty"`` the largest discounted chance of meeting something unknown, of which only the
        largest need be exact.
        """
        settings = self._settings
        if len(self._predictions) > _KEPT * settings.states:
            self._predictions = PredictedTransitions(self._model, settings.branches)
            self.learned()
        depth = settings.depth if left is None else max(1, min(left, settings.depth))
        root = self._row(code)
        known = self._known.setdefault((objective, depth), {})
        if root not in known:
            known.update(self._plan(root, objective, depth))
        return known[root].copy()

    def outcome(self, code: Code) -> tuple[Floats, Floats, Floats]:
        """Expected reward of each action, P(it ends the episode), and how much it does is unknown: three (A,)."""
        row = self._row(code)
        predictions = self._predictions
        predictions.expand(np.array([row]))
        return predictions.reward[row], predictions.ends[row], predictions.unknown[row]

    def _row(self, code: Code) -> int:
        return self._predictions.row(int(np.ravel_multi_index(code, self._model.sizes)))

    def _plan(self, root: int, objective: Objective, depth: int) -> dict[int, Floats]:
        """Action values (A,) of every row within reach of ``root``, or of it alone where that is too much."""
        predictions = self._predictions
        rows = front = np.array([root])
        self.expanded = steps = 0
        while len(front) and len(rows) <= self._settings.states and steps < depth:
            predictions.expand(front)
            self.expanded = len(rows)
            steps = steps + 1
            front = np.setdiff1d(predictions.next[front][predictions.continues[front] > 0.0], rows)
            rows = np.concatenate([rows, front])
            if objective == "novelty" and len(front) and (found := self._discovery(rows, depth)) is not None:
                return {root: found}
        values = self._back_up(rows, objective, depth)
        return {root: values[0].copy()} if len(front) else dict(zip(rows.tolist(), values, strict=True))

    def _discovery(self, rows: Ints, depth: int) -> Floats | None:
        """Novelty (A,) of the first of ``rows``; None where what lies beyond them may change the best actions."""
        near = self._back_up(rows, "novelty", depth)[0]
        far = self._back_up(rows, "novelty", depth, beyond=1.0)[0]
        return None if ((far > near) & (far >= near.max() - TIE)).any() else near

    def _back_up(self, rows: Ints, objective: Objective, depth: int, beyond: float = 0.0) -> Floats:
        """Action values of the expanded rows, which come first, (expanded, A); all others are worth ``beyond``."""
        settings = self._settings
        predictions = self._predictions
        inside = rows[: self.expanded]
        best = self._model.outcomes.rewards.max()
        place = np.zeros(len(predictions), dtype=np.int64)
        place[rows] = np.arange(len(rows))
        reward = predictions.reward[inside]
        unknown = predictions.unknown[inside]
        continues = predictions.continues[inside]
        following = place[predictions.next[inside]]
        state = np.zeros(len(rows))
        action = reward
        state[self.expanded :] = beyond
        for _ in range(depth):
            ahead = (continues * state[following]).sum(axis=2)
            if objective == "novelty":
                action = np.maximum(unknown, settings.novelty_discount * ahead)
            else:
                action = reward + settings.discount * ahead
            if objective == "optimistic":
                action = (1.0 - unknown) * action + unknown * best
            best_of = action.max(axis=1)
            if np.array_equal(best_of, state[: self.expanded]):
                break  # every further step would be the same
            state[: self.expanded] = best_of
        return action
