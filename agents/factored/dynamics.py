"""What an action does to each factor of a code: a factored, categorical dynamics model with learned structure.

Each factor's next value depends on a few factors only (factored MDPs: Boutilier, Dearden & Goldszmidt 2000; Kearns &
Koller 1999). Which ones is learned, a factor and an action, by Bayesian averaging over sets of parents that hold the
factor itself, with Dirichlet tables whose evidence is closed (Cooper & Herskovits 1992; Heckerman et al. 1995), and
over the hypothesis that the action leaves the factor alone. Stochastic results are tables with several entries.
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
_AT_ONCE = 64
"""Codes whose counts are read at once, so that tables of many values need little memory."""
EVERY = slice(None)
"""All actions."""


@dataclass(frozen=True, slots=True)
class FactorPrediction:
    """What each action would make of one factor in N codes."""

    expected: Floats  #: predictive probability of each value. Shape (N, A, K).
    unknown: Floats  #: weight of the prior in ``expected``. Shape (N, A).


class FactorDynamics:
    """How one factor changes; ``sizes`` are the numbers of values of every factor."""

    def __init__(self, factor: int, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings) -> None:
        self.factor, self.values, self.settings = factor, sizes[factor], settings
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
        self.evidence = np.tile(np.log([settings.persistence, *prior]), (n_actions, 1))
        """Log prior plus log evidence that the action leaves the factor alone, then of each table. Shape (A, 1 + T)."""
        self._tried = np.zeros(n_actions)

    def add(self, code: Codes, action: int, value: int) -> None:
        """Learn that ``action`` in ``code`` (P,) led to ``value``."""
        slip, concentration = self.settings.slip, self.settings.concentration
        stayed = value == code[self.factor]
        self._tried[action] = 1.0
        self.evidence[action, 0] += np.log(1.0 - slip if stayed else slip / max(1, self.values - 1))
        rows = self._rows(code[None])[0]
        counts, total = self.counts[rows, action, value], self._total[rows, action]
        self.evidence[action, 1:] += np.log((counts + concentration) / (total + concentration * self.values))
        self.counts[rows, action, value] += 1.0
        self._total[rows, action] += 1.0

    def weights(self) -> Floats:
        """Posterior probability of each structure, an action. Shape (A, 1 + tables)."""
        weight = np.exp(self.evidence - self.evidence.max(axis=1, keepdims=True))
        return weight / weight.sum(axis=1, keepdims=True)

    def predict(self, codes: Codes, actions: slice = EVERY) -> FactorPrediction:
        """What some actions would lead to in ``codes`` (N, P)."""
        weight, prior = self._weights(actions), self.settings.concentration
        expected = self._stays(weight, codes)
        unknown = np.zeros(expected.shape[:2])
        for some, own, counts, total in self._counted(weight, codes, actions):
            share = own / (total + prior * self.values)
            expected[some] += (share[..., None] * (counts + prior)).sum(axis=1)
            unknown[some] = (share * prior * self.values).sum(axis=1)
        return FactorPrediction(expected, unknown)

    def seen(self, codes: Codes) -> Floats:
        """The same from observations alone: staying, if ever tried, and frequencies; 0 of none. Shape (N, A, K)."""
        weight = self._weights(EVERY)
        seen = self._stays(weight, codes) * self._tried[:, None]
        for some, own, counts, total in self._counted(weight, codes, EVERY):
            seen[some] += ((own / np.maximum(total, 1.0))[..., None] * counts).sum(axis=1)
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

    def _counted(self, weight: Floats, codes: Codes, actions: slice) -> Iterator[tuple[slice, Floats, Floats, Floats]]:
        """A few codes at a time, of T tables that matter: which; weights (T, A), counts (n, T, A, K) and their sums."""
        matters = np.flatnonzero(weight[:, 1:].any(axis=0))
        if not len(matters):
            return
        rows, own = self._rows(codes)[:, matters], weight[:, 1 + matters].T
        for first in range(0, len(codes), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            yield some, own, self.counts[rows[some], actions], self._total[rows[some], actions]


class Dynamics:
    """How every factor changes; ``sizes`` are their numbers of values."""

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings) -> None:
        self.factors = [FactorDynamics(factor, sizes, n_actions, settings) for factor in range(len(sizes))]

    def add(self, code: Codes, action: int, following: Codes) -> None:
        """Learn from one transition between codes (P,)."""
        for factor, value in zip(self.factors, following.tolist(), strict=True):
            factor.add(code, action, value)

    def predict(self, codes: Codes, actions: slice = EVERY) -> list[FactorPrediction]:
        """What some actions would make of each factor in ``codes`` (N, P)."""
        return [factor.predict(codes, actions) for factor in self.factors]
