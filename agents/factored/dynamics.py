"""What an action does to each factor of a code: a factored, categorical dynamics model with learned structure.

Each factor's next value depends on a few factors only (factored MDPs: Boutilier, Dearden & Goldszmidt 2000; Kearns &
Koller 1999). Which ones is learned, a factor and an action, by Bayesian averaging over sets of parents that hold the
factor itself, with Dirichlet tables whose evidence is closed (Cooper & Herskovits 1992; Heckerman et al. 1995), and
over the hypothesis that the action leaves the factor alone. Stochastic results are tables with several entries. Each
table comes twice: its rows are learned apart, or they are *alike*, and an action that changes the factor fails to do so
as often in every row: a slip, which all transitions teach (a Dirichlet tree whose first branch is shared; Minka 1999).
Or a factor changes by itself, in the same way whatever the action.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats

from .factors import Codes, strides, table_size
from .settings import DynamicsSettings

_LARGEST_TABLE = 1 << 16
"""Parent sets whose table would have more rows are not considered."""
_NEGLIGIBLE = 1e-12
"""Structures of no more posterior probability are left out of predictions."""
_GROWTH = 1.1
"""What all actions teach together is learned anew once so many times the transitions of the last time were seen."""
_AT_ONCE = 64
"""Codes whose counts are read at once, so that tables of many values need little memory."""
_TABLES = 2
"""Structures before those of tables."""
EVERY = slice(None)
"""All actions."""


@dataclass(frozen=True, slots=True)
class FactorPrediction:
    """What each action would make of one factor in N codes."""

    expected: Floats  #: predictive probability of each value. Shape (N, A, K).
    unknown: Floats  #: weight of the prior in ``expected``; 0 where it is negligible. Shape (N, A).


@dataclass(frozen=True, slots=True)
class _Counted:
    """What was counted for n codes of T tables that matter."""

    codes: slice
    own: tuple[NDArray[np.int64], slice, NDArray[np.int64]]  #: where an array (n, A, K) has the value that they have
    apart: Floats  #: weight of each table. Shape (T, A).
    alike: Floats  #: the same if its rows are alike
    counts: Floats  #: of next values. Shape (n, T, A, K).
    total: Floats  #: sums of them. Shape (n, T, A).
    moved: Floats  #: the same without the value that a code has


class FactorDynamics:
    """How one factor changes; ``sizes`` are the numbers of values of every factor."""

    def __init__(self, factor: int, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings) -> None:
        self.factor, self.values, self.settings = factor, sizes[factor], settings
        self._pseudo, self._others = settings.concentration * self.values, max(1, self.values - 1)
        others = [other for other in range(len(sizes)) if other != factor]
        sets = [(factor, *more) for size in range(settings.parents) for more in itertools.combinations(others, size)]
        sets = [parents for parents in sets if table_size(parents, sizes) <= _LARGEST_TABLE] or [(factor,)]
        self.parents = sets
        """Of each Dirichlet table the factors that the next value depends on."""
        rows = [table_size(parents, sizes) for parents in sets]
        self._first, self._strides = np.cumsum(rows) - rows, np.zeros((len(sizes), len(sets)))
        for index, parents in enumerate(sets):
            self._strides[list(parents), index] = strides(parents, sizes)
        self.counts = np.zeros((sum(rows), n_actions, self.values))
        """Of the next values: a row for every setting of the parents of every table. Shape (R, A, K)."""
        self._total = np.zeros((sum(rows), n_actions))
        same_size = [sum(len(parents) == len(other) for other in sets) for parents in sets]
        prior = np.array(
            [settings.parent_decay ** (len(parents) - 1) / n for parents, n in zip(sets, same_size, strict=True)]
        )
        prior *= (1.0 - settings.persistence) / prior.sum()
        both = np.concatenate([(1.0 - settings.alike) * prior, settings.alike * prior])
        both *= 1.0 - settings.by_itself
        by_itself = (1.0 - settings.persistence) * settings.by_itself
        self.evidence = np.tile(np.log([settings.persistence, by_itself, *both]), (n_actions, 1))
        """Log prior plus log evidence that the action leaves the factor alone, that it changes by itself, then of each
        table, then of each whose rows are alike. Shape (A, 2 + 2T)."""
        self.tried, self.stayed = np.zeros(n_actions), np.zeros(n_actions)
        """How often each action was tried, and left the factor at its value. Shape (A,)."""
        self.fails = settings.fails
        """How often any action that changes the factor is expected to leave it at its value."""
        self._turns = np.zeros((self.values, self.values))
        """How often each value came after each, whatever the action. Shape (K, K)."""
        self._pool_turns()

    def add(self, code: Codes, action: int, value: int) -> None:
        """Learn that ``action`` in ``code`` (P,) led to ``value``."""
        slip, pseudo, others, own = self.settings.slip, self._pseudo, self._others, code[self.factor]
        stayed = value == own
        rows, tables = self._rows(code[None])[0], _TABLES + len(self.parents)
        counts, total = self.counts[rows, action, value], self._total[rows, action]
        fails, moved = self._fails()[action], total - self.counts[rows, action, own]
        goes = (1.0 - fails) * (counts + pseudo / others) / (moved + pseudo)
        self.evidence[action, 0] += np.log(1.0 - slip if stayed else slip / others)
        self.evidence[action, 1] += np.log(self._by_itself[own, value])
        self.evidence[action, _TABLES:tables] += np.log((counts + self.settings.concentration) / (total + pseudo))
        self.evidence[action, tables:] += np.log(fails if stayed else goes)
        self.tried[action] += 1.0
        self.stayed[action] += stayed
        self._turns[own, value] += 1.0
        self.counts[rows, action, value] += 1.0
        self._total[rows, action] += 1.0

    def weights(self) -> Floats:
        """Posterior probability of each structure, an action. Shape (A, 2 + 2 tables)."""
        weight = np.exp(self.evidence - self.evidence.max(axis=1, keepdims=True))
        return weight / weight.sum(axis=1, keepdims=True)

    def pool(self) -> Floats:
        """Learn how it changes by itself; how often actions that change it were tried, and left it as it was: (2,)."""
        self._pool_turns()
        changes = np.where(self.stayed < self.tried, 1.0 - self.weights()[:, 0], 0.0)
        return np.array([changes @ self.tried, changes @ self.stayed])

    def predict(self, codes: Codes, actions: slice = EVERY) -> FactorPrediction:
        """What some actions would lead to in ``codes`` (N, P)."""
        weight, pseudo, fails = self._weights(actions), self._pseudo, self._fails()[actions]
        own = codes[:, self.factor]
        expected = self._stays(weight, codes) + weight[:, 1, None] * self._by_itself[own][:, None]
        unknown = weight[:, 1] * self._unsure[own][:, None]
        unsure = fails * pseudo / (self.tried[actions] + pseudo)
        for each in self._counted(weight, codes, actions):
            apart = each.apart / (each.total + pseudo)
            alike = each.alike * (1.0 - fails) / (each.moved + pseudo)
            expected[each.codes] += ((apart + alike)[..., None] * each.counts).sum(axis=1)
            expected[each.codes] += pseudo * (apart / self.values + alike / self._others).sum(axis=1)[..., None]
            goes = (alike * (each.total - each.moved + pseudo / self._others)).sum(axis=1)
            expected[each.codes][each.own] += (each.alike * fails).sum(axis=0) - goes  # which stays, if rows are alike
            unknown[each.codes] += ((apart + alike) * pseudo + each.alike * unsure).sum(axis=1)
        return FactorPrediction(expected, np.where(unknown < self.settings.least_unknown, 0.0, unknown))

    def seen(self, codes: Codes) -> Floats:
        """The same from observations alone: staying, if ever tried, and frequencies; 0 of none. Shape (N, A, K)."""
        weight, failed = self._weights(EVERY), self.stayed / np.maximum(self.tried, 1.0)
        turns = self._pooled[codes[:, self.factor]]
        turns /= np.maximum(turns.sum(axis=1, keepdims=True), 1.0)
        seen = (self._stays(weight, codes) + weight[:, 1, None] * turns[:, None]) * (self.tried[:, None] > 0.0)
        for each in self._counted(weight, codes, EVERY):
            apart = each.apart / np.maximum(each.total, 1.0)
            alike = each.alike * (1.0 - failed) / np.maximum(each.moved, 1.0)
            seen[each.codes] += ((apart + alike)[..., None] * each.counts).sum(axis=1)
            stays = (each.alike * failed).sum(axis=0) - (alike * (each.total - each.moved)).sum(axis=1)
            seen[each.codes][each.own] += stays
        return seen

    def happens(self, codes: Codes, actions: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """How probable each value is after one action (N,) each, as it was seen to happen, or as expected where never.

        Returns these, (N, K), and the weight of the prior, (N,).
        """
        each, predicted = np.arange(len(codes)), self.predict(codes)
        seen, unknown = self.seen(codes)[each, actions], predicted.unknown[each, actions]
        chance = np.where((seen.sum(axis=1) > unknown)[:, None], seen, predicted.expected[each, actions])
        return chance / chance.sum(axis=1, keepdims=True), unknown

    def _weights(self, actions: slice) -> Floats:
        """Those of :meth:`weights` that are not negligible."""
        weight = self.weights()[actions]
        weight[weight <= _NEGLIGIBLE] = 0.0
        return weight

    def _stays(self, weight: Floats, codes: Codes) -> Floats:
        """The share of structures by which the factor is left alone, at its value. Shape (N, A, K)."""
        return weight[None, :, :1] * np.eye(self.values)[codes[:, self.factor]][:, None, :]

    def _rows(self, codes: Codes) -> NDArray[np.int64]:
        """The row of each table T that holds for each code (N, P). Shape (N, T)."""
        return np.asarray((codes @ self._strides).astype(np.int64) + self._first)  # floats are fast, and exact here

    def _pool_turns(self) -> None:
        """Learn how it changes by itself, from each value to each, (K, K), and the weight of the prior, (K,)."""
        self._pooled = self._turns.copy()
        total = self._pooled.sum(axis=1, keepdims=True) + self._pseudo
        self._by_itself, self._unsure = (self._pooled + self.settings.concentration) / total, self._pseudo / total[:, 0]

    def _fails(self) -> Floats:
        """How often each action leaves the factor at its value, where rows are alike. Shape (A,)."""
        pseudo = self.settings.pseudo_fails
        return np.asarray((self.stayed + pseudo * self.fails) / (self.tried + pseudo))

    def _counted(self, weight: Floats, codes: Codes, actions: slice) -> Iterator[_Counted]:
        """What was counted for a few codes at a time."""
        apart, alike = weight[:, _TABLES:].T.reshape(2, len(self.parents), -1)
        matters = np.flatnonzero((apart + alike).any(axis=1))
        if not len(matters):
            return
        rows = self._rows(codes)[:, matters]
        for first in range(0, len(codes), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            counts, total = self.counts[rows[some], actions], self._total[rows[some], actions]
            value = codes[some, self.factor]
            own = np.arange(len(value)), EVERY, value
            stayed = counts[np.arange(len(value)), ..., value]
            yield _Counted(some, own, apart[matters], alike[matters], counts, total, total - stayed)


class Dynamics:
    """How every factor changes, or the first ``moving``; ``sizes`` are the numbers of values of all."""

    def __init__(
        self, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings, moving: int | None = None
    ) -> None:
        factors = range(len(sizes) if moving is None else moving)
        self.factors = [FactorDynamics(factor, sizes, n_actions, settings) for factor in factors]
        self._settings, self._seen, self.pooled_at = settings, 0, 0

    def add(self, code: Codes, action: int, following: Codes) -> None:
        """Learn from one transition from a code (P,) to values of those that move."""
        for factor, value in zip(self.factors, following.tolist(), strict=True):
            factor.add(code, action, value)
        self._seen += 1
        if self._seen >= _GROWTH * self.pooled_at:
            self._pool()

    def _pool(self) -> None:
        """Learn anew how factors change by themselves, and how often actions fail, of each factor and of all."""
        self.pooled_at, pseudo = self._seen, self._settings.pseudo_fails
        each = [factor.pool() for factor in self.factors]
        tried, stayed = np.sum(each, axis=0)
        fails = (stayed + self._settings.fails) / (tried + 1.0)
        for factor, (own_tried, own_stayed) in zip(self.factors, each, strict=True):
            factor.fails = float((own_stayed + pseudo * fails) / (own_tried + pseudo))

    def predict(self, codes: Codes, actions: slice = EVERY) -> list[FactorPrediction]:
        """What some actions would make of each factor in ``codes`` (N, P)."""
        return [factor.predict(codes, actions) for factor in self.factors]
