"""Counts of transitions between numbered states, and value iteration on them (Sutton & Barto 2018, 4.4)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imagine_bench.interfaces import Floats

from ..snapshot import Arrays

Row = tuple[int, int, int, float, bool]
"""State, action, following state, reward, and whether the episode ended there."""
_ACCURACY = 1e-6
"""Value iteration stops when no value changes by more, relative to the largest."""


class CountTable:
    """How often each action in each of the S states seen led where, with what reward and whether it ended there.

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
        """Count one transition; whether that changed what the table predicts."""
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
        if not self._rows:
            return {}
        rows = list(self._rows)
        state = np.array([self._index[row[0]] for row in rows])
        following = np.array([self._index[row[2]] for row in rows])
        reward, going_on = np.array([row[3] for row in rows]), np.array([not row[4] for row in rows])
        count, size = np.array(list(self._rows.values()), dtype=np.float64), len(self._index) * self._n_actions
        pair = state * self._n_actions + np.array([row[1] for row in rows])
        tests = np.bincount(pair, count, size)  # [S * A]
        share = count / tests[pair]
        expected = np.bincount(pair, share * reward, size)
        follows = discount * share * going_on
        values: Floats = np.zeros(len(self._index))
        for _ in range(10_000):
            q = expected + np.bincount(pair, follows * values[following], size)
            q[tests == 0.0] = untried
            table = q.reshape(-1, self._n_actions)
            before, values = values, table.max(axis=1)
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

    def load(self, arrays: Arrays) -> None:
        """Take up the rows of :meth:`arrays`."""
        self._index, self._rows, self._branches, self.largest_reward = {}, {}, {}, 0.0
        for *row, count in zip(*(arrays[name].tolist() for name in self.arrays()), strict=True):
            self.add(*row)
            self._rows[tuple(row)] = count
