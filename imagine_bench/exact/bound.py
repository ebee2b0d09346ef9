"""A lower bound of the transitions that any learner needs, on average over a class of worlds.

The class: actions that move the same coordinates and depend on the same ones are a *group*. In each *cell*, which is a
group and one setting of the coordinates that it depends on, the names of the group's actions are exchanged, each way
equally likely and independent of all other cells. The learner is told everything else: the task's rules, rewards, goals
and starts, and which names belong together. The worlds differ by names alone, so they are equally hard.

The proof: one transition is in one cell, and at most shows the names there (log2 n! bits of n names). So after T
transitions at most T cells are known. In an unknown cell all namings are equally likely, so every choice has the mean
effect of the group's actions; from then on the learner may even know everything. In a known cell no choice is better
than the best effect, or than the same guess with all known thereafter, which is allowed so that more knowledge is never
worth less. Backward induction gives with this the largest success that T known cells allow. The bound is the smallest T
for which it reaches a share of the optimum.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from imagine_bench.arrays import Bools, Floats, Ints
from imagine_bench.exact.factors import FactorGraph, Machine, Scope, keys, numbered

SHARE = 0.95
"""The share of the optimum that a policy must reach."""
_MOST = 3_000
"""Sets of cells that are tried at most."""
_EPS = 1e-9


def cells(machine: Machine, graph: FactorGraph) -> tuple[Ints, int]:
    """The cell of each action in each macrostate of play, -1 for an action alone in its group: (A, P); their number."""
    groups: dict[tuple[tuple[Scope, Scope], ...], list[int]] = {}
    for action in range(machine.n_actions):
        own = [factor for factor in graph.factors if factor.action == action]
        signature = tuple((factor.children, factor.parents) for factor in own)
        groups.setdefault(signature, []).append(action)
    found = np.full((machine.n_actions, machine.n_play), -1)
    count = 0
    for signature, actions in groups.items():
        if len(actions) == 1 or not signature:
            continue
        parents = sorted({each for factor in graph.factors if factor.action == actions[0] for each in factor.parents})
        cell = numbered(keys(machine.coordinates[: machine.n_play], parents))
        found[actions] = count + cell
        count += int(cell.max()) + 1
    return found, count


class _Success:
    """The success that a learner may expect at most, by the cells that it knows."""

    def __init__(self, machine: Machine, cell: Ints, count: int, horizon: int) -> None:
        self.machine = machine
        self.cell = cell
        self.first = np.searchsorted(machine.pair, np.arange(machine.n_actions * machine.n_play))
        self.success = np.array([success for *_, success in machine.classes])[machine.class_].astype(np.float64)
        self.goes_on = ~np.array([ended for _, ended, _ in machine.classes])[machine.class_]
        self.guessed: list[Floats] = []
        """In an unknown cell, the mean success of its actions, by the macro-actions that are left. Each (A, P)."""
        value = np.zeros(len(machine.coordinates))
        for _ in range(horizon):
            table = self._backed_up(value)
            self.guessed.append(self._mean_of_cells(table, count))
            value[: machine.n_play] = table.max(axis=0)
        self.optimum = float(value[machine.starts].mean())

    def _backed_up(self, value: Floats) -> Floats:
        """The expected success of each action. Shape (A, P)."""
        found = self.machine.probability * (self.success + self.goes_on * value[self.machine.after])
        return np.add.reduceat(found, self.first).reshape(self.cell.shape)

    def _mean_of_cells(self, table: Floats, count: int) -> Floats:
        column = np.broadcast_to(np.arange(self.machine.n_play), self.cell.shape)
        number = np.where(self.cell < 0, count, self.cell) * self.machine.n_play + column
        total = np.bincount(number.ravel(), table.ravel())
        return total[number] / np.bincount(number.ravel())[number]

    def at_most(self, known: Bools) -> float:
        """The largest mean success if these cells are known. Shape of ``known``: (cells,)."""
        knows = np.append(known, True)[self.cell]
        alone = self.cell < 0
        value = np.zeros(len(self.machine.coordinates))
        for guessed in self.guessed:
            best = self._backed_up(value)
            in_cells = np.where(knows, np.maximum(best, guessed), guessed)
            table = np.where(alone, best, in_cells)
            value[: self.machine.n_play] = table.max(axis=0)
        return float(value[self.machine.starts].mean())


def lower_bound(machine: Machine, graph: FactorGraph, horizon: int, share: float = SHARE) -> int:
    """Before so many transitions no learner solves ``share`` of the episodes that the optimum solves, on average."""
    cell, count = cells(machine, graph)
    success = _Success(machine, cell, count, horizon)

    def enough(unknown: tuple[int, ...]) -> bool:
        known = ~np.isin(np.arange(count), unknown)
        return success.at_most(known) >= share * success.optimum - _EPS

    spare = [each for each in range(count) if enough((each,))]
    left: set[tuple[int, ...]] = {(each,) for each in spare}
    tried = count
    fewest = count - bool(spare)
    while left:
        longer = {(*each, more) for each in left for more in spare if more > each[-1]}
        subsets = {each for each in longer if set(combinations(each, len(each) - 1)) <= left}
        tried += len(subsets)
        if tried > _MOST:
            return count - len(spare)  # every spare cell unknown at once: no set of them is larger
        left = {each for each in subsets if enough(each)}
        fewest -= bool(left)
    return fewest
