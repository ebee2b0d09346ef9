"""Planning in imagination: every future within reach of a code is imagined once, and values are backed up through it.

Two values are planned. The *worth* of an action is the expected discounted reward (value iteration in the learned
model, Sutton 1990). Its *novelty* is the largest discounted chance of meeting something unknown on the way: the best
single discovery, not a sum, so that nothing is gained by going round in circles. Acting for one until there is nothing
left to find, then for the other, is "explicit explore or exploit" (E3, Kearns & Singh 2002); believing that the unknown
is worth the best reward seen is R-max (Brafman & Tennenholtz 2002).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .dynamics import Codes
from .model import StructuredModel
from .outcomes import Floats
from .settings import PlanningSettings

_HAPPENS = 1e-3
"""Branches in which the episode goes on less probably than this are not followed."""


class Planner:
    """Plans with one model; :meth:`forget` what was imagined whenever the model has learned.

    Args:
        model: Imagines.
        settings: How far and how broadly.
    """

    def __init__(self, model: StructuredModel, settings: PlanningSettings) -> None:
        self._model, self._settings = model, settings
        self.forget()

    def forget(self) -> None:
        """Drop every imagined future."""
        shape = (0, self._model.n_actions)
        self._index: dict[tuple[int, ...], int] = {}
        self._reward, self._unknown, self._ends = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._next = np.zeros((*shape, self._settings.branches), dtype=np.int64)
        self._goes_on = np.zeros((*shape, self._settings.branches))
        self._values: dict[str, Floats] = {}
        self._only: tuple[int, ...] | None = None

    @property
    def imagined(self) -> int:
        """Codes whose futures are imagined."""
        return len(self._reward)

    def worth(self, code: tuple[int, ...]) -> Floats:
        """Expected discounted reward of each action. Shape (A,)."""
        return self._value("worth", code)

    def optimistic(self, code: tuple[int, ...]) -> Floats:
        """The same if whatever is unknown brought the largest reward seen. Shape (A,)."""
        return self._value("optimistic", code)

    def novelty(self, code: tuple[int, ...]) -> Floats:
        """Largest discounted chance of meeting something unknown by each action. Shape (A,)."""
        return self._value("novelty", code)

    def unknown(self, code: tuple[int, ...]) -> Floats:
        """How much of what each action does at once is unknown. Shape (A,)."""
        row = self._known(code)
        return np.asarray(self._unknown[row])

    def reward(self, code: tuple[int, ...]) -> Floats:
        """Expected reward of each action. Shape (A,)."""
        row = self._known(code)
        return np.asarray(self._reward[row])

    def terminates(self, code: tuple[int, ...]) -> Floats:
        """Probability that each action ends the episode. Shape (A,)."""
        row = self._known(code)
        return np.asarray(self._ends[row])

    def _value(self, kind: str, code: tuple[int, ...]) -> Floats:
        row = self._known(code)
        if kind not in self._values:
            self._values[kind] = self._back_up(kind)
        return np.asarray(self._values[kind][row])

    def _back_up(self, kind: str) -> Floats:
        """Action values of every imagined code, ``depth`` macro-actions deep. Shape (imagined, A)."""
        settings = self._settings
        best = self._model.outcomes.rewards.max()
        state, action = np.zeros(len(self._index)), self._reward
        for _ in range(settings.depth):
            ahead = (self._goes_on * state[self._next]).sum(axis=2)
            if kind == "novelty":
                action = np.maximum(self._unknown, settings.novelty_discount * ahead)
            else:
                action = self._reward + settings.discount * ahead
            if kind == "optimistic":
                action = (1.0 - self._unknown) * action + self._unknown * best
            state[: len(action)] = action.max(axis=1)
        return action

    def _known(self, code: tuple[int, ...]) -> int:
        """Row of a code; everything within its reach is imagined first if it is new.

        A plan is whole or, where too much is within reach, belongs to one code only: so values never depend on what
        was asked before, and a resumed agent finds the same.
        """
        if self._only not in (None, code):
            self.forget()
        if code not in self._index:
            alone = not self._index
            whole = self._imagine_from(code)
            if not whole and not alone:
                self.forget()
                whole = self._imagine_from(code)
            self._only = None if whole else code
        return self._index[code]

    def _imagine_from(self, code: tuple[int, ...]) -> bool:
        """Imagine the futures of a new code and of all that follow; whether they are within bounds."""
        front, self._values = [code], {}
        self._reserve(front)
        while front and len(self._index) <= self._settings.states:
            front = self._expand(front)
            self._reserve(front)
        return not front

    def _reserve(self, codes: list[tuple[int, ...]]) -> None:
        self._index.update({code: len(self._index) + offset for offset, code in enumerate(codes)})

    def _expand(self, front: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
        """Imagine the futures of codes that have rows reserved; the codes met first there."""
        futures = self._model.futures(np.array(front, dtype=np.int64))
        goes_on = np.where(futures.goes_on > _HAPPENS, futures.goes_on, 0.0)
        rows, met = self._rows(futures.following, goes_on > 0.0)
        self._reward = np.concatenate([self._reward, futures.reward])
        self._unknown = np.concatenate([self._unknown, futures.unknown])
        self._ends = np.concatenate([self._ends, futures.terminates])
        self._next = np.concatenate([self._next, rows])
        self._goes_on = np.concatenate([self._goes_on, goes_on])
        return met

    def _rows(self, codes: Codes, follows: NDArray[np.bool_]) -> tuple[NDArray[np.int64], list[tuple[int, ...]]]:
        """Rows of the codes (N, A, B, P) that follow, 0 elsewhere, and those among them that are new."""
        rows = np.zeros(follows.shape, dtype=np.int64)
        flat, new = codes.reshape(-1, codes.shape[-1]).tolist(), dict[tuple[int, ...], int]()
        for position in np.flatnonzero(follows):
            code = tuple(flat[position])
            row = self._index.get(code)
            rows.flat[position] = new.setdefault(code, len(self._index) + len(new)) if row is None else row
        return rows, list(new)
