"""Planning with the model: the next codes of a code are predicted once, and values are backed up through it.

Two values are planned. The *value* of an action is the expected discounted reward (value iteration in the learned
model, Sutton 1990). Its *novelty* is the largest discounted chance of meeting something unknown on the way: the best
single discovery, not a sum, so that cycles gain nothing. Acting for novelty until there is nothing left to find, then
for value, is "explicit explore or exploit" (E3, Kearns & Singh 2002); valuing the unknown at the best reward seen is
R-max (Brafman & Tennenholtz 2002), which is how it explores, unless another way is set. A search for the unknown ends
as soon as nothing farther can be worth as much.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from imagine_bench.arrays import Floats, Ints

from .factors import Code
from .model import FactoredModel
from .settings import PlanningSettings

_KEPT = 20
"""Predictions of more codes than so many plans visit are dropped."""
TIE = 1e-9
"""Actions whose values differ by less are worth the same."""

_HAPPENS = 1e-3
"""Branches in which the episode goes on less probably than this are not followed."""

Objective = Literal["value", "optimistic", "r_max", "novelty"]


class Planner:
    """Plans with one model, which must say when it :meth:`learned`.

    A plan holds everything within reach of a code, and then all its codes share it, or, where too much is within reach,
        the nearest ones to that code: so values never depend on earlier questions, and a resumed agent finds the
    same. Codes that were met are numbered in rows; their predictions are kept until the model learns.
    """

    def __init__(self, model: FactoredModel, settings: PlanningSettings) -> None:
        self._model = model
        self._settings = settings
        self._forget()
        self.expanded = 0
        """Codes of the newest plan whose successors are predicted."""

    def _forget(self) -> None:
        """Drop every prediction."""
        self._rows: dict[int, int] = {}
        """The row of each code that was met, by its number."""
        pairs = (0, self._model.n_actions)
        triples = (*pairs, self._settings.branches)
        self._reward = np.zeros(pairs)
        """Expected reward of every action. Shape (rows, A), as of the next two."""
        self._unknown = np.zeros(pairs)
        """Probability that something untested decides."""
        self._ends = np.zeros(pairs)
        """Probability that the episode ends."""
        self._continues = np.zeros(triples)
        """Probability that each of B branches comes about and the episode goes on. Shape (rows, A, B)."""
        self._next = np.zeros(triples, dtype=np.int64)
        """Rows where these lead, as far as they are followed. Shape (rows, A, B)."""
        self.learned()

    def learned(self) -> None:
        """The model has learned something: plan anew."""
        self._predicted = np.zeros(len(self._reward), dtype=bool)
        """Whether the model predicts this now. Shape (rows,)."""
        self._plans: dict[tuple[Objective, int], dict[int, Floats]] = {}
        """Action values (A,) by row, of each objective and depth."""

    def values(self, code: Code, objective: Objective = "value", left: int | None = None) -> Floats:
        """The value of each action in ``code``, with so many macro-actions left, or as many as it plans: (A,).

        ``"value"`` is the expected discounted reward; ``"optimistic"`` the same if whatever is unknown brought the
        largest reward seen; ``"r_max"`` the same where more is unknown than a threshold, and known values elsewhere;
        ``"novelty"`` the largest discounted chance of meeting something unknown, of which only the
        largest need be exact.
        """
        settings = self._settings
        if len(self._rows) > _KEPT * settings.states:
            self._forget()
        depth = settings.depth if left is None else max(1, min(left, settings.depth))
        root = self._row(self._number(code))
        known = self._plans.setdefault((objective, depth), {})
        if root not in known:
            known.update(self._plan(root, objective, depth))
        return known[root].copy()

    def outcome(self, code: Code) -> tuple[Floats, Floats, Floats]:
        """Expected reward of each action, P(it ends the episode), and how much it does is unknown: three (A,)."""
        row = self._row(self._number(code))
        self._expand(np.array([row]))
        return self._reward[row], self._ends[row], self._unknown[row]

    def _number(self, code: Code) -> int:
        return int(np.ravel_multi_index(code, self._model.sizes))

    def _row(self, number: int) -> int:
        """The row of a code, by its number; a new one if it is met for the first time."""
        return self._rows.setdefault(number, len(self._rows))

    def _expand(self, rows: Ints) -> None:
        """Predict the next codes of ``rows``, as far as they are not predicted yet."""
        self._grow()
        rows = rows[~self._predicted[rows]]
        if not len(rows):
            return
        sizes = self._model.sizes
        codes = np.stack(np.unravel_index(np.fromiter(self._rows, np.int64)[rows], sizes), axis=-1)
        moves = self._model.moves(codes)
        found = self._model.results(codes, moves)
        follows = found.p_continues > _HAPPENS
        numbers, which = np.unique(np.ravel_multi_index(tuple(moves.following[follows].T), sizes), return_inverse=True)
        following = np.zeros(follows.shape, dtype=np.int64)
        following[follows] = np.array([self._row(number) for number in numbers.tolist()], dtype=np.int64)[which]
        self._grow()
        self._reward[rows] = found.reward
        self._unknown[rows] = found.unknown
        self._ends[rows] = found.p_terminated
        self._next[rows] = following
        self._continues[rows] = np.where(follows, found.p_continues, 0.0)
        self._predicted[rows] = True

    def _grow(self) -> None:
        """Room for every row, at least twice as much as before."""
        more = len(self._rows) - len(self._reward)
        if more > 0:
            more = max(more, len(self._reward))
            for name, array in vars(self).items():
                if isinstance(array, np.ndarray):
                    setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)]))

    def _plan(self, root: int, objective: Objective, depth: int) -> dict[int, Floats]:
        """Action values (A,) of every row within reach of ``root``, or of it alone where that is too much."""
        rows = front = np.array([root])
        self.expanded = steps = 0
        while len(front) and len(rows) <= self._settings.states and steps < depth:
            self._expand(front)
            self.expanded = len(rows)
            steps = steps + 1
            front = np.setdiff1d(self._next[front][self._continues[front] > 0.0], rows)
            rows = np.concatenate([rows, front])
            if objective == "novelty" and len(front) and (found := self._discovery(rows, depth)) is not None:
                return {root: found}
        values = self._back_up(rows, objective, depth)
        return {root: values[0].copy()} if len(front) else dict(zip(rows.tolist(), values, strict=True))

    def _discovery(self, rows: Ints, depth: int) -> Floats | None:
        """Novelty (A,) of the first of ``rows``; None where codes beyond them may change the best actions."""
        near = self._back_up(rows, "novelty", depth)[0]
        far = self._back_up(rows, "novelty", depth, beyond=1.0)[0]
        return None if ((far > near) & (far >= near.max() - TIE)).any() else near

    def _back_up(self, rows: Ints, objective: Objective, depth: int, beyond: float = 0.0) -> Floats:
        """Action values of the expanded rows, which come first, (expanded, A); all others are worth ``beyond``."""
        settings = self._settings
        inside = rows[: self.expanded]
        best = self._model.outcomes.rewards.max()
        place = np.zeros(len(self._rows), dtype=np.int64)
        place[rows] = np.arange(len(rows))
        reward = self._reward[inside]
        unknown = self._unknown[inside]
        continues = self._continues[inside]
        following = place[self._next[inside]]
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
            elif objective == "r_max":
                action = np.where(unknown > settings.r_max_threshold, best, action)
            best_of = action.max(axis=1)
            if np.array_equal(best_of, state[: self.expanded]):
                break  # every further step would be the same
            state[: self.expanded] = best_of
        return action
