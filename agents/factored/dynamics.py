"""What an action does to each part of a code: a factored, categorical dynamics model with learned structure.

Each part's next value depends on a few parts only (factored MDPs: Boutilier, Dearden & Goldszmidt 2000; Kearns &
Koller 1999). Which ones is learned, a part and an action, by Bayesian averaging over sets of parents that hold the part
itself, with Dirichlet tables whose evidence is closed (Cooper & Herskovits 1992; Heckerman et al. 1995), and over the
hypothesis that the action leaves the part alone. Outcomes that vary are simply tables with several entries.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .settings import DynamicsSettings

Codes = NDArray[np.int64]
_LARGEST_TABLE = 1 << 16
"""Parent sets whose table would have more rows are not considered."""


@dataclass(frozen=True, slots=True)
class PartPrediction:
    """What each action would make of one part in N codes.

    Attributes:
        expected: Predictive probability of each value. Shape (N, A, K).
        seen: The same from what was observed alone: that the action leaves the part as it is, if it was ever tried, and
            frequencies; zeros where nothing was. Shape (N, A, K).
        unknown: Weight of the prior in ``expected``. Shape (N, A).
    """

    expected: NDArray[np.float64]
    seen: NDArray[np.float64]
    unknown: NDArray[np.float64]


class Table:
    """A Dirichlet table: counts of a part's next values for every action and every setting of its parents.

    Args:
        parents: Indices of the parents.
        sizes: Values of every part of the code.
        n_actions: A.
        values: Values K of the part itself.
    """

    def __init__(self, parents: tuple[int, ...], sizes: tuple[int, ...], n_actions: int, values: int) -> None:
        self.parents = list(parents)
        self.strides = strides(parents, sizes)
        self.counts = np.zeros((n_actions, int(np.prod([sizes[part] for part in parents])), values))

    def row(self, codes: Codes) -> NDArray[np.int64]:
        """The row of each code (N, P). Shape (N,)."""
        rows: NDArray[np.int64] = codes[:, self.parents] @ self.strides
        return rows


def strides(parts: tuple[int, ...], sizes: tuple[int, ...]) -> NDArray[np.int64]:
    """Multipliers that number the joint values of ``parts``, the last one fastest."""
    return np.array([int(np.prod([sizes[part] for part in parts[i + 1 :]])) for i in range(len(parts))], dtype=np.int64)


class PartDynamics:
    """How one part changes.

    Args:
        part: Its index.
        sizes: Values of every part.
        n_actions: A.
        settings: Priors.
    """

    def __init__(self, part: int, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings) -> None:
        self.part, self.values, self.settings = part, sizes[part], settings
        sets = [
            parents
            for parents in _parent_sets(part, len(sizes), settings.parents)
            if _rows(parents, sizes) <= _LARGEST_TABLE
        ]
        self.tables = [Table(parents, sizes, n_actions, self.values) for parents in sets or [(part,)]]
        fewer = [sum(len(table.parents) == len(other.parents) for other in self.tables) for table in self.tables]
        prior = np.array(
            [
                settings.parent_factor ** (len(table.parents) - 1) / same
                for table, same in zip(self.tables, fewer, strict=True)
            ]
        )
        prior *= (1.0 - settings.persistence) / prior.sum()
        self.evidence = np.tile(np.log([settings.persistence, *prior]), (n_actions, 1))
        """Log prior plus log evidence that the action leaves the part alone, then of each table. Shape (A, 1 + T)."""
        self._tried = np.zeros(n_actions)

    def add(self, code: Codes, action: int, value: int) -> None:
        """Learn that ``action`` in ``code`` (P,) led to ``value``."""
        slip, concentration = self.settings.slip, self.settings.concentration
        stayed = value == code[self.part]
        self._tried[action] = 1.0
        self.evidence[action, 0] += np.log(1.0 - slip if stayed else slip / max(1, self.values - 1))
        for index, table in enumerate(self.tables):
            counts = table.counts[action, int(table.row(code[None])[0])]
            chance = (counts[value] + concentration) / (counts.sum() + concentration * self.values)
            self.evidence[action, 1 + index] += np.log(chance)
            counts[value] += 1.0

    def weights(self) -> NDArray[np.float64]:
        """Posterior probability of each structure, an action. Shape (A, 1 + tables)."""
        weight = np.exp(self.evidence - self.evidence.max(axis=1, keepdims=True))
        normalised: NDArray[np.float64] = weight / weight.sum(axis=1, keepdims=True)
        return normalised

    def predict(self, codes: Codes) -> PartPrediction:
        """What every action would lead to in ``codes`` (N, P)."""
        weight, prior = self.weights(), self.settings.concentration
        stay = weight[None, :, :1] * np.eye(self.values)[codes[:, self.part]][:, None, :]  # [N, A, K]
        expected, seen, unknown = stay, stay * self._tried[:, None], np.zeros(stay.shape[:2])
        for index, table in enumerate(self.tables):
            counts = table.counts[:, table.row(codes)].transpose(1, 0, 2)  # [N, A, K]
            total, own = counts.sum(axis=2, keepdims=True), weight[None, :, 1 + index, None]
            known = total + prior * self.values
            expected = expected + own * (counts + prior) / known
            seen = seen + own * counts / np.maximum(total, 1.0)
            unknown += (own * prior * self.values / known)[..., 0]
        return PartPrediction(expected, seen, unknown)


def _parent_sets(part: int, parts: int, largest: int) -> list[tuple[int, ...]]:
    others = [other for other in range(parts) if other != part]
    return [(part, *more) for size in range(largest) for more in itertools.combinations(others, size)]


def _rows(parents: tuple[int, ...], sizes: tuple[int, ...]) -> int:
    return int(np.prod([sizes[part] for part in parents]))


class Dynamics:
    """How every part changes.

    Args:
        sizes: Values of each of the P parts.
        n_actions: A.
        settings: Priors.
    """

    def __init__(self, sizes: tuple[int, ...], n_actions: int, settings: DynamicsSettings) -> None:
        self.parts = [PartDynamics(part, sizes, n_actions, settings) for part in range(len(sizes))]

    def add(self, code: Codes, action: int, following: Codes) -> None:
        """Learn from one transition between codes (P,)."""
        for part, value in zip(self.parts, following.tolist(), strict=True):
            part.add(code, action, value)

    def predict(self, codes: Codes) -> list[PartPrediction]:
        """What every action would make of each part in ``codes`` (N, P)."""
        return [part.predict(codes) for part in self.parts]
