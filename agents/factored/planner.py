"""Planning with the model: what follows from a code is predicted once, and values are backed up through it.

Two values are planned. The *value* of an action is the expected discounted reward (value iteration in the learned
model, Sutton 1990). Its *novelty* is the largest discounted chance of meeting something unknown on the way: the best
single discovery, not a sum, so that cycles gain nothing. Acting for novelty until there is nothing left to find, then
for value, is "explicit explore or exploit" (E3, Kearns & Singh 2002); valuing the unknown at the best reward seen is
R-max (Brafman & Tennenholtz 2002). A search for the unknown ends as soon as nothing farther can be worth as much.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np

from imagine_bench.interfaces import Floats

from .factors import Code
from .model import FactoredModel
from .predictions import PredictedTransitions, Rows
from .settings import PlanningSettings

_KEPT = 20
"""Predictions of more codes than so many plans visit are dropped."""
TIE = 1e-9
"""Actions whose values differ by less are worth the same."""

Objective = Literal["value", "optimistic", "novelty"]


class Planner:
    """Plans with one model, which must say when it :meth:`learned`.

    A plan holds everything within reach of a code, and then all its codes share it, or, where too much is within
    reach, what is nearest to that code: so values never depend on what was asked before, and a resumed agent finds the
    same.
    """

    def __init__(self, model: FactoredModel, settings: PlanningSettings) -> None:
        self._model = model
        self._settings = settings
        self.expanded = 0
        """Codes of the newest plan whose successors are predicted."""
        self._forget()

    def _forget(self) -> None:
        """Drop every prediction."""
        self._predictions = PredictedTransitions(self._model, self._settings.branches)
        self.learned(())

    def learned(self, actions: Iterable[int]) -> None:
        """The model has learned something, and of the dynamics of these actions: plan anew."""
        self._predictions.learned(actions)
        self._known: dict[tuple[Objective, int], dict[int, Floats]] = {}

    def values(self, code: Code, objective: Objective = "value", left: int | None = None) -> Floats:
        """What each action in ``code`` is worth, with so many macro-actions left, or as many as it plans: (A,).

        ``"value"`` is the expected discounted reward; ``"optimistic"`` the same if whatever is unknown brought the
        largest reward seen; ``"novelty"`` the largest discounted chance of meeting something unknown, of which only the
        largest need be exact.
        """
        if len(self._predictions) > _KEPT * self._settings.states:
            self._forget()
        depth = self._settings.depth if left is None else max(1, min(left, self._settings.depth))
        root = self._predictions.row(code)
        known = self._known.setdefault((objective, depth), {})
        if root not in known:
            known.update(self._plan(root, objective, depth))
        return known[root].copy()

    def outcome(self, code: Code) -> tuple[Floats, Floats, Floats]:
        """Expected reward of each action, P(it ends the episode), and how much it does is unknown: three (A,)."""
        row = self._predictions.row(code)
        predictions = self._predictions
        predictions.expand(np.array([row]))
        return predictions.reward[row], predictions.ends[row], predictions.unknown[row]

    def _plan(self, root: int, objective: Objective, depth: int) -> dict[int, Floats]:
        """Action values (A,) of every row within reach of ``root``, or of it alone where that is too much."""
        rows = front = np.array([root])
        self.expanded = steps = 0
        while len(front) and len(rows) <= self._settings.states and steps < depth:
            self._predictions.expand(front)
            self.expanded = len(rows)
            steps = steps + 1
            front = np.setdiff1d(self._predictions.following(front), rows)
            rows = np.concatenate([rows, front])
            if objective == "novelty" and len(front) and (found := self._discovery(rows, depth)) is not None:
                return {root: found}
        values = self._back_up(rows, objective, depth)
        return {root: values[0].copy()} if len(front) else dict(zip(rows.tolist(), values, strict=True))

    def _discovery(self, rows: Rows, depth: int) -> Floats | None:
        """Novelty (A,) of the first of ``rows``; None where what lies beyond them may change the best actions."""
        near = self._back_up(rows, "novelty", depth)[0]
        far = self._back_up(rows, "novelty", depth, beyond=1.0)[0]
        return None if ((far > near) & (far >= near.max() - TIE)).any() else near

    def _back_up(self, rows: Rows, objective: Objective, depth: int, beyond: float = 0.0) -> Floats:
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
