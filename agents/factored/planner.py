"""Planning with the model: what follows from a code is predicted once, and values are backed up through it.

Two values are planned. The *value* of an action is the expected discounted reward (value iteration in the learned
model, Sutton 1990). Its *novelty* is the largest discounted chance of meeting something unknown on the way: the best
single discovery, not a sum, so that cycles gain nothing. Acting for novelty until there is nothing left to find, then
for value, is "explicit explore or exploit" (E3, Kearns & Singh 2002); valuing the unknown at the best reward seen is
R-max (Brafman & Tennenholtz 2002).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats

from .factors import Code, Codes
from .model import FactoredModel
from .settings import PlanningSettings

_HAPPENS = 1e-3
"""Branches in which the episode goes on less probably than this are not followed."""

Objective = Literal["value", "optimistic", "novelty"]


class Planner:
    """Plans with one model; :meth:`clear` what was predicted whenever the model has learned."""

    def __init__(self, model: FactoredModel, settings: PlanningSettings) -> None:
        self._model, self._settings = model, settings
        self.clear()

    def clear(self) -> None:
        """Drop every prediction."""
        shape = (0, self._model.n_actions)
        self._index: dict[Code, int] = {}
        self._reward, self._unknown, self._ends = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._next = np.zeros((*shape, self._settings.branches), dtype=np.int64)
        self._continues = np.zeros((*shape, self._settings.branches))
        self._planned: dict[Objective, Floats] = {}
        self._only: Code | None = None

    @property
    def expanded(self) -> int:
        """Codes whose successors are predicted."""
        return len(self._reward)

    def values(self, code: Code, objective: Objective = "value") -> Floats:
        """What each action in ``code`` is worth. Shape (A,).

        ``"value"`` is the expected discounted reward; ``"optimistic"`` the same if whatever is unknown brought the
        largest reward seen; ``"novelty"`` the largest discounted chance of meeting something unknown.
        """
        row = self._row(code)
        if objective not in self._planned:
            self._planned[objective] = self._back_up(objective)
        return np.asarray(self._planned[objective][row])

    def outcome(self, code: Code) -> tuple[Floats, Floats, Floats]:
        """Expected reward of each action, P(it ends the episode), and how much it does is unknown: three (A,)."""
        row = self._row(code)
        return self._reward[row], self._ends[row], self._unknown[row]

    def _back_up(self, objective: Objective) -> Floats:
        """Action values of every expanded code, ``depth`` macro-actions deep. Shape (expanded, A)."""
        settings = self._settings
        best = self._model.outcomes.rewards.max()
        state, action = np.zeros(len(self._index)), self._reward
        for _ in range(settings.depth):
            ahead = (self._continues * state[self._next]).sum(axis=2)
            if objective == "novelty":
                action = np.maximum(self._unknown, settings.novelty_discount * ahead)
            else:
                action = self._reward + settings.discount * ahead
            if objective == "optimistic":
                action = (1.0 - self._unknown) * action + self._unknown * best
            state[: len(action)] = action.max(axis=1)
        return action

    def _row(self, code: Code) -> int:
        """Row of a code; everything within its reach is expanded first if it is new.

        A plan is whole or, where too much is within reach, belongs to one code only: so values never depend on what
        was asked before, and a resumed agent finds the same.
        """
        if self._only not in (None, code):
            self.clear()
        if code not in self._index:
            alone = not self._index
            whole = self._expand_from(code)
            if not whole and not alone:
                self.clear()
                whole = self._expand_from(code)
            self._only = None if whole else code
        return self._index[code]

    def _expand_from(self, code: Code) -> bool:
        """Expand a new code and all that follow; whether they are within bounds."""
        front, self._planned = [code], {}
        self._reserve(front)
        while front and len(self._index) <= self._settings.states:
            front = self._expand(front)
            self._reserve(front)
        return not front

    def _reserve(self, codes: list[Code]) -> None:
        self._index.update({code: len(self._index) + offset for offset, code in enumerate(codes)})

    def _expand(self, front: list[Code]) -> list[Code]:
        """Predict the successors of codes that have rows reserved; the codes met first there."""
        found = self._model.successors(np.array(front, dtype=np.int64))
        continues = np.where(found.p_continues > _HAPPENS, found.p_continues, 0.0)
        rows, met = self._rows(found.following, continues > 0.0)
        self._reward = np.concatenate([self._reward, found.reward])
        self._unknown = np.concatenate([self._unknown, found.unknown])
        self._ends = np.concatenate([self._ends, found.p_terminated])
        self._next = np.concatenate([self._next, rows])
        self._continues = np.concatenate([self._continues, continues])
        return met

    def _rows(self, codes: Codes, follows: NDArray[np.bool_]) -> tuple[NDArray[np.int64], list[Code]]:
        """Rows of the codes (N, A, B, P) that follow, 0 elsewhere, and those among them that are new."""
        rows, new = np.zeros(follows.shape, dtype=np.int64), dict[Code, int]()
        if follows.any():
            found = codes[follows]
            packed = np.ravel_multi_index(tuple(found.T), tuple(found.max(axis=0) + 1))
            _, first, which = np.unique(packed, return_index=True, return_inverse=True)
            numbers = np.empty(len(first), dtype=np.int64)
            for index in np.argsort(first).tolist():
                code = tuple(found[first[index]].tolist())
                row = self._index.get(code)
                numbers[index] = new.setdefault(code, len(self._index) + len(new)) if row is None else row
            rows[follows] = numbers[which]
        return rows, list(new)
