"""The effect of an action on each factor of a code: a factored, categorical dynamics model with learned structure.

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
from collections import Counter
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats, Ints

from .factors import Codes, strides, table_size
from .settings import DynamicsSettings

_LARGEST_TABLE = 1 << 16
"""Parent sets whose table would have more rows are not considered."""
_NEGLIGIBLE = 1e-12
"""Structures of no more posterior probability are left out of predictions."""
_GROWTH = 1.1
"""The joint knowledge of all actions is learned anew once so many times the transitions of the last time were seen."""
_AT_ONCE = 64
"""Codes whose counts are read at once, so that tables of many values need little memory."""
_TABLES = 2
"""Structures before those of tables."""


class FactorPrediction(NamedTuple):
    """The next value of one factor after each action in N codes."""

    expected: Floats  #: predictive probability of each value. Shape (N, A, K).
    unknown: Floats  #: weight of the prior in ``expected``; 0 where it is negligible. Shape (N, A).


class FactorDynamics:
    """How one factor changes; ``sizes`` are the numbers of values of every factor."""

    def __init__(self, factor: int, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings) -> None:
        self.factor = factor
        self.values = sizes[factor]
        self.settings = settings
        self._pseudo = settings.concentration * self.values
        self._others = max(1, self.values - 1)
        others = [other for other in range(len(sizes)) if other != factor]
        sets = [(factor, *more) for size in range(settings.parents) for more in itertools.combinations(others, size)]
        self.parents = [parents for parents in sets if table_size(parents, sizes) <= _LARGEST_TABLE] or [(factor,)]
        """Of each Dirichlet table the factors that the next value depends on; of the first, the factor alone."""
        rows = [table_size(parents, sizes) for parents in self.parents]
        self._first = np.cumsum(rows) - rows
        self._strides = np.zeros((len(sizes), len(rows)))
        for column, parents in zip(self._strides.T, self.parents, strict=True):
            column[list(parents)] = strides(parents, sizes)
        self.counts = np.zeros((sum(rows), n_actions, self.values))
        """Of the next values: a row for every setting of the parents of every table. Shape (R, A, K)."""
        of_size = Counter(map(len, self.parents))
        prior = np.array([settings.parent_decay ** (len(each) - 1) / of_size[len(each)] for each in self.parents])
        prior *= (1.0 - settings.persistence) / prior.sum()
        both = np.outer([1.0 - settings.alike, settings.alike], prior) * (1.0 - settings.by_itself)
        by_itself = (1.0 - settings.persistence) * settings.by_itself
        self.evidence = np.tile(np.log([settings.persistence, by_itself, *both.ravel()]), (n_actions, 1))
        """Log prior plus log evidence that the action leaves the factor alone, that it changes by itself, then of each
        table, then of each whose rows are alike. Shape (A, 2 + 2T)."""
        self.fails = settings.fails
        """How often any action that changes the factor is expected to leave it at its value."""
        self._pool_turns()

    def add(self, code: Codes, action: int, value: int) -> None:
        """Learn that ``action`` in ``code`` (P,) led to ``value``."""
        own = code[self.factor]
        stayed = value == own
        rows = self._rows(code[None])[0]
        seen = self.counts[rows, action]  # [T, K]
        total = seen.sum(axis=1)
        fails = self._fails()[action]
        goes = (1.0 - fails) * (seen[:, value] + self._pseudo / self._others) / (total - seen[:, own] + self._pseudo)
        likelihood = [
            [1.0 - self.settings.slip if stayed else self.settings.slip / self._others],
            [self._by_itself[own, value]],
            (seen[:, value] + self.settings.concentration) / (total + self._pseudo),
            np.full(len(rows), fails) if stayed else goes,
        ]
        self.evidence[action] += np.log(np.concatenate(likelihood))
        self.counts[rows, action, value] += 1.0

    def _tried(self) -> tuple[Floats, Floats]:
        """How often each action was tried, and left the factor at its value. Two arrays (A,)."""
        by_own_value = self.counts[: self.values]  # [K, A, K]
        return by_own_value.sum(axis=(0, 2)), np.einsum("kak->a", by_own_value)

    def weights(self) -> Floats:
        """Posterior probability of each structure, an action. Shape (A, 2 + 2 tables)."""
        weight = np.exp(self.evidence - self.evidence.max(axis=1, keepdims=True))
        return weight / weight.sum(axis=1, keepdims=True)

    def likeliest_parents(self) -> list[tuple[int, ...]]:
        """The factors that decide this one's change in the likeliest structure of each action; none if it stays."""
        structures = [(), (self.factor,), *self.parents, *self.parents]
        return [structures[best] for best in self.weights().argmax(axis=1)]

    def pool(self) -> Floats:
        """Learn how it changes by itself; how often actions that change it were tried, and left it as it was: (2,)."""
        self._pool_turns()
        tried, stayed = self._tried()
        changes = np.where(stayed < tried, 1.0 - self.weights()[:, 0], 0.0)
        return np.array([changes @ tried, changes @ stayed])

    def predict(self, codes: Codes) -> FactorPrediction:
        """Predict the next values after each action in ``codes`` (N, P)."""
        expected, unknown = self._average(codes, self._pseudo, self._fails(), self._by_itself)
        return FactorPrediction(expected, np.where(unknown < self.settings.least_unknown, 0.0, unknown))

    def seen(self, codes: Codes) -> Floats:
        """Frequencies of the next values without any prior; zeros for an action that was never tried. (N, A, K)."""
        tried, stayed = self._tried()
        turns = self._pooled / np.maximum(self._pooled.sum(axis=1, keepdims=True), 1.0)
        seen, _ = self._average(codes, 0.0, stayed / np.maximum(tried, 1.0), turns)
        return seen * (tried[:, None] > 0.0)

    def happens(self, codes: Codes, actions: Ints) -> tuple[Floats, Floats]:
        """How probable each value is after one action (N,) each, as it was seen to happen, or as expected where never.

        Returns these, (N, K), and the weight of the prior, (N,).
        """
        each = np.arange(len(codes))
        predicted = self.predict(codes)
        seen = self.seen(codes)[each, actions]
        unknown = predicted.unknown[each, actions]
        chance = np.where((seen.sum(axis=1) > unknown)[:, None], seen, predicted.expected[each, actions])
        return chance / chance.sum(axis=1, keepdims=True), unknown

    def _average(self, codes: Codes, pseudo: float, fails: Floats, by_itself: Floats) -> tuple[Floats, Floats]:
        """Average over the structures: the next values, (N, A, K), and the weight of the prior, (N, A).

        Args:
            codes: Codes (N, P).
            pseudo: Counts that the prior of each row of a table is worth.
            fails: How often each action leaves the factor at its value, where rows are alike. Shape (A,).
            by_itself: Next values of a factor that changes by itself. Shape (K, K).
        """
        if len(codes) > _AT_ONCE:
            some = (codes[first : first + _AT_ONCE] for first in range(0, len(codes), _AT_ONCE))
            means, priors = zip(*(self._average(few, pseudo, fails, by_itself) for few in some), strict=True)
            return np.concatenate(means), np.concatenate(priors)
        weight = self.weights()
        weight[weight <= _NEGLIGIBLE] = 0.0
        apart, alike = weight[:, _TABLES:].T.reshape(2, len(self.parents), -1)  # [T, A]
        matters = np.flatnonzero((apart + alike).any(axis=1))
        alike = alike[matters]
        each = np.arange(len(codes))
        own = codes[:, self.factor]
        counts = self.counts[self._rows(codes)[:, matters]]  # [N, T, A, K]
        total = counts.sum(axis=3)
        stayed = counts[each, ..., own]
        least = 0.0 if pseudo else 1.0
        tables = apart[matters] / np.maximum(total + pseudo, least)
        goes = alike * (1.0 - fails) / np.maximum(total - stayed + pseudo, least)
        unsure = fails * pseudo / np.maximum(self._tried()[0] + pseudo, least)
        expected = weight[None, :, :1] * np.eye(self.values)[own][:, None, :]
        expected = expected + weight[:, 1, None] * by_itself[own][:, None]
        expected += ((tables + goes)[..., None] * counts).sum(axis=1)
        expected += pseudo * (tables / self.values + goes / self._others).sum(axis=1)[..., None]
        expected[each, :, own] += (alike * fails).sum(axis=0) - (goes * (stayed + pseudo / self._others)).sum(axis=1)
        unknown = weight[:, 1] * self._unsure[own][:, None]
        return expected, unknown + ((tables + goes) * pseudo + alike * unsure).sum(axis=1)

    def _rows(self, codes: Codes) -> Ints:
        """The row of each table T that holds for each code (N, P). Shape (N, T)."""
        return np.asarray((codes @ self._strides).astype(np.int64) + self._first)  # floats are fast, and exact here

    def _pool_turns(self) -> None:
        """Learn how it changes by itself, from each value to each, (K, K), and the weight of the prior, (K,)."""
        self._pooled = self.counts[: self.values].sum(axis=1)
        total = self._pooled.sum(axis=1, keepdims=True) + self._pseudo
        self._by_itself = (self._pooled + self.settings.concentration) / total
        self._unsure = self._pseudo / total[:, 0]

    def _fails(self) -> Floats:
        """How often each action leaves the factor at its value, where rows are alike. Shape (A,)."""
        tried, stayed = self._tried()
        pseudo = self.settings.pseudo_fails
        return (stayed + pseudo * self.fails) / (tried + pseudo)


class Dynamics:
    """How every factor changes, or the first ``moving``; ``sizes`` are the numbers of values of all."""

    def __init__(
        self, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings, moving: int | None = None
    ) -> None:
        factors = range(len(sizes) if moving is None else moving)
        self.factors = [FactorDynamics(factor, sizes, n_actions, settings) for factor in factors]
        self.settings = settings
        self._seen = 0
        self._pooled_at = 0

    def add(self, code: Codes, action: int, following: Codes) -> None:
        """Learn from one transition from a code (P,) to values of those that move."""
        for factor, value in zip(self.factors, following.tolist(), strict=True):
            factor.add(code, action, value)
        self._seen += 1
        if self._seen >= _GROWTH * self._pooled_at:
            self._pool()

    def _pool(self) -> None:
        """Learn anew how factors change by themselves, and how often actions fail, of each factor and of all."""
        pseudo = self.settings.pseudo_fails
        self._pooled_at = self._seen
        each = [factor.pool() for factor in self.factors]
        tried, stayed = np.sum(each, axis=0)
        fails = (stayed + self.settings.fails) / (tried + 1.0)
        for factor, (own_tried, own_stayed) in zip(self.factors, each, strict=True):
            factor.fails = float((own_stayed + pseudo * fails) / (own_tried + pseudo))

    def predict(self, codes: Codes) -> list[FactorPrediction]:
        """The next value of each factor after each action in ``codes`` (N, P)."""
        return [factor.predict(codes) for factor in self.factors]
