"""Counts of transitions between numbered states, and value iteration on them (Sutton & Barto 2018, 4.4)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Arrays, Floats

Row = tuple[int, int, int, float, bool]
"""State, action, following state, reward, and whether the episode ended there."""
_ACCURACY = 1e-6
"""Value iteration stops when no value changes by more, relative to the largest."""


class CountTable:
    """How often each action in each of the S states seen led where, with which reward and whether it ended there.

    States are any integers; rows are kept in the order in which they were first seen, so equal rows give equal bits.
    """

    def __init__(self, n_actions: int) -> None:
        self._n_actions = n_actions
        self._index: dict[int, int] = {}
        self._rows: dict[Row, int] = {}
        self._branches: dict[tuple[int, int], list[Row]] = {}
        self.largest_reward = 0.0  #: of those seen, at least 0

    @property
    def states(self) -> int:
        """How many states are known, S."""
        return len(self._index)

    @property
    def pairs(self) -> int:
        """How many pairs of state and action were tried."""
        return len(self._branches)

    def add(self, state: int, action: int, following: int, reward: float, terminated: bool) -> bool:
        """Count one transition; returns whether that changed the table's predictions."""
        for each in (state, following):
            self._index.setdefault(each, len(self._index))
        row = (state, action, following, reward, terminated)
        seen = row in self._rows
        self._rows[row] = self._rows.get(row, 0) + 1
        self.largest_reward = max(self.largest_reward, reward)
        if not seen:
            self._branches.setdefault((state, action), []).append(row)
        return not seen or len(self._branches[state, action]) > 1

    def recall(self, count: int, rng: np.random.Generator) -> Iterator[Row]:
        """Transitions of ``count`` tried pairs, each pair equally likely; of several of a pair one by its counts."""
        branches = list(self._branches.values())
        for drawn in rng.integers(len(branches), size=count):
            rows = branches[drawn]
            counts = np.array([self._rows[row] for row in rows]) if len(rows) > 1 else np.ones(1)
            yield rows[rng.choice(len(rows), p=counts / counts.sum()) if len(rows) > 1 else 0]

    def expected(self, state: int, action: int) -> tuple[list[tuple[int, float]], float]:
        """States that follow a pair and how probably the episode goes on there; and the expected reward."""
        rows = self._branches.get((state, action), [])
        total = sum(self._rows[row] for row in rows)
        shares = [(row, self._rows[row] / total) for row in rows]
        return [(row[2], share) for row, share in shares if not row[4]], sum(row[3] * share for row, share in shares)

    def action_values(self, discount: float, untried: float) -> dict[int, Floats]:
        """Optimal values (A,) of each known state in the model of the counts; an untried pair is worth ``untried``.

        ``discount`` lies in [0, 1]. At 1 a value may grow without bound; iteration stops after 10,000 sweeps.
        """
        return self._optimal(*self._columns(), discount, untried) if self._rows else {}

    def sampled_values(self, discount: float, concentration: float, rng: np.random.Generator) -> dict[int, Floats]:
        """The same in one model that is drawn from the posterior of the outcomes of each pair of known state and
        action.

        The prior of a pair is a Dirichlet process (Ferguson 1973): ``concentration``, above 0, is how many counts it
        weighs, and its mean is over the outcomes that any pair was seen to have, all kinds of outcome, reward and end,
        equally likely. Unseen outcomes of a pair are one draw from that.
        """
        if not self._rows:
            return {}
        pair, following, reward, going_on, count = self._columns()
        size = len(self._index) * self._n_actions
        outcomes = np.stack([reward, going_on], axis=1)
        kind = np.unique(outcomes, axis=0, return_inverse=True)[1].ravel()
        p = count / np.bincount(kind, count)[kind]
        prior = rng.choice(len(count), size, p=p / p.sum())  # of each pair one row
        rows = np.concatenate([np.arange(len(count)), prior])
        weight = rng.gamma(np.concatenate([count, np.full(size, concentration)]))
        own = np.concatenate([pair, np.arange(size)])
        tiny = np.finfo(np.float64).tiny  # the gamma of a small shape may be 0
        return self._optimal(own, following[rows], reward[rows], going_on[rows], weight + tiny, discount, untried=0.0)

    def _columns(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, NDArray[np.bool_], Floats]:
        """Of each of N rows: pair, index of the state that follows, reward, whether the episode goes on, counts."""
        state, action, following, reward, ended = (np.array(column) for column in zip(*self._rows, strict=True))
        index = np.array([[self._index[each] for each in column.tolist()] for column in (state, following)])
        count = np.array(list(self._rows.values()), dtype=np.float64)
        return index[0] * self._n_actions + action, index[1], reward.astype(np.float64), ~ended, count

    def _optimal(
        self, pair: NDArray[np.int64], following: NDArray[np.int64], reward: Floats, going_on: NDArray[np.bool_],
        weight: Floats, discount: float, untried: float,
    ) -> dict[int, Floats]:  # fmt: skip
        """Value iteration where each of N rows follows its pair in proportion to its weight, above 0."""
        size = len(self._index) * self._n_actions
        total = np.bincount(pair, weight, size)  # [S * A]
        share = weight / total[pair]
        expected = np.bincount(pair, share * reward, size)
        follows = discount * share * going_on
        values: Floats = np.zeros(len(self._index))
        for _ in range(10_000):
            q = expected + np.bincount(pair, follows * values[following], size)
            q[total == 0.0] = untried
            table = q.reshape(-1, self._n_actions)
            before = values
            values = table.max(axis=1)
            if np.abs(values - before).max() <= _ACCURACY * max(1.0, np.abs(values).max()):
                break
        return dict(zip(self._index, table, strict=True))

    def arrays(self) -> Arrays:
        """Copies of all rows, by column, and the states in their order."""
        kinds = {"state": np.int64, "action": np.int64, "following": np.int64, "reward": np.float64, "ended": np.bool_}
        columns = zip(*self._rows, strict=True) if self._rows else [()] * len(kinds)
        found: Arrays = {
            name: np.array(column, dtype=kind) for (name, kind), column in zip(kinds.items(), columns, strict=True)
        }
        return found | {"count": np.array(list(self._rows.values()), dtype=np.int64)}

    def clear(self) -> None:
        """Forget everything."""
        self._index = {}
        self._rows = {}
        self._branches = {}
        self.largest_reward = 0.0

    def load(self, arrays: Arrays) -> None:
        """Take up the rows of :meth:`arrays`."""
        self.clear()
        for *row, count in zip(*(arrays[name].tolist() for name in self.arrays()), strict=True):
            self.add(*row)
            self._rows[tuple(row)] = count
