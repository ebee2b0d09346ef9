"""A cautious learner: how many transitions it needs if it knows the factor graph, but none of its entries.

The learner sees macrostates and classes, plans exactly, and is told a local entry of the dynamics, probabilities and
all, by the first transition that shows it; a class that does not hold rules out its conditions there, one that holds
shows that at least one is true. It takes an unknown outcome for the best that is possible (optimism; Brafman and
Tennenholtz 2002): an unknown entry may lead anywhere in the coordinates that it decides, an unknown class may be any.
It goes to the nearest unknown fact that an optimistic plan from some start still rests on, and is done when from every
start the best imaginable is reached through known facts alone: its policy is then optimal whatever the rest is.
Probabilities would have to be estimated on top, so that with chance this is the cost of the certain part alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from imagine_bench.arrays import Bools, Floats, Ints
from imagine_bench.exact.factors import FactorGraph, Machine, keys, numbered

_SUCCESS = 10_000.0  # of return: success comes first
_EPS = 1e-6
_CELLS = 2_000_000  # combinations of values up to which all are looked at
_SWEEPS = 4  # times the horizon
MOST = 3_000
"""Transitions after which a learner gives up."""


@dataclass(frozen=True, kw_only=True)
class LearnerRun:
    """The experience that one learner needed."""

    transitions: int
    episodes: int
    facts: int  #: entries of the dynamics seen, and conditions of classes found true
    done: bool  #: whether it knew an optimal policy when it stopped


class CautiousLearner:
    """One learner in the machine. ``E`` dynamics entries, of which the first is always known; ``Q`` points."""

    def __init__(self, machine: Machine, graph: FactorGraph, horizon: int) -> None:
        self.machine = machine
        self.graph = graph
        self.sweeps = _SWEEPS * horizon
        self.shape = (machine.n_actions, machine.n_play)
        self.moved: list[list[int]] = [[] for _ in range(machine.n_actions)]
        entries: list[list[Ints]] = [[] for _ in range(machine.n_actions)]
        count = 1
        for factor in graph.factors:
            self.moved[factor.action] += factor.children
            entries[factor.action].append(factor.entry + count)
            count += int(factor.entry.max()) + 1
        self.known = np.arange(count) == 0  # [E]
        self.entries = np.zeros((*self.shape, max(map(len, entries))), dtype=np.int64)
        for action, columns in enumerate(entries):
            self.entries[action, :, : len(columns)] = np.transpose(columns) if columns else 0
        self.conditions: list[Ints] = []  # of each claim: condition of each point and scope. (Q, scopes)
        count = 0
        for claim in graph.claims:
            numbers = []
            for scope in claim.scopes:
                numbers.append(numbered(keys(graph.points, scope)) + count)
                count = int(numbers[-1].max()) + 1
            self.conditions.append(np.stack(numbers, axis=1))
        self.true = np.zeros(count, dtype=bool)
        self.false = np.zeros(count, dtype=bool)
        self.clauses: list[Ints] = []  # conditions of which one at least is true
        read = sorted({i for claim in graph.claims for scope in claim.scopes for i in scope})
        self.alike = numbered(keys(graph.points, read))  # points that are one
        self.class_of = np.full(int(self.alike.max()) + 1, -1)  # the observations
        self.first = np.searchsorted(machine.pair, np.arange(machine.n_actions * machine.n_play + 1))
        self.pay = np.array([reward + _SUCCESS * success for reward, _, success in machine.classes])
        self.ends = np.array([ended for _, ended, _ in machine.classes])
        self.box = tuple((machine.coordinates.max(axis=0) + 1).tolist())

    def learn(self, outcome: int) -> bool:
        """Take in a transition; whether more than the absence of a condition was learned."""
        point = self.graph.point[outcome]
        class_ = self.machine.class_[outcome]
        action, row = divmod(int(self.machine.pair[outcome]), self.machine.n_play)
        entries = self.entries[action, row]
        learned = not self.known[entries].all()
        self.known[entries] = True
        if self.class_of[self.alike[point]] >= 0:
            return learned
        self.class_of[self.alike[point]] = class_
        for claim, conditions in zip(self.graph.claims, self.conditions, strict=True):
            if claim.class_ == class_:
                self.clauses.append(conditions[point])
                break
            self.false[conditions[point]] = True
        open_ = []
        for clause in self.clauses:  # one of which one condition is left shows that it is true
            left = np.unique(clause[~self.false[clause]])
            if len(left) == 1:
                learned |= not self.true[left[0]]
                self.true[left] = True
            elif not self.true[left].any():
                open_.append(clause)
        self.clauses = open_
        return learned

    def possible(self) -> Bools:
        """Which classes each point may have. Shape (C, Q)."""
        found = np.zeros((len(self.machine.classes), len(self.alike)), dtype=bool)
        free = np.ones(len(self.alike), dtype=bool)  # of every claim above
        for claim, conditions in zip(self.graph.claims, self.conditions, strict=True):
            found[claim.class_] = free & ~self.false[conditions].all(axis=1)
            free &= ~self.true[conditions].any(axis=1)
        found[self.graph.usual] = free
        seen = self.class_of[self.alike]
        found[:, seen >= 0] = seen[seen >= 0] == np.arange(len(found))[:, None]
        return found

    def solve(self) -> bool:
        """Plan optimistically; whether every start is settled. Leaves the facts wanted and the plan."""
        machine = self.machine
        n = machine.n_play
        possible = self.possible()[:, self.graph.point]  # [C, N]
        sure = possible.sum(axis=0) == 1
        alive = possible[~self.ends].any(axis=0)
        known = self.known[self.entries].all(axis=2)
        best = np.where(possible, self.pay[:, None], -np.inf)
        ended = best[self.ends].max(axis=0, initial=-np.inf)  # [N]
        going = best[~self.ends].max(axis=0, initial=-np.inf)
        value = np.zeros(len(machine.coordinates))
        for _ in range(self.sweeps):
            worth = np.maximum(ended, going + value[machine.after])
            q = np.where(known, self._expected(worth), self._imagined(worth, known))
            change = np.abs(q.max(axis=0) - value[:n]).max()
            value[:n] = q.max(axis=0)
            if change < _EPS:
                break
        optimal = (q >= q.max(axis=0) - _EPS) & np.isfinite(q)
        settled = np.ones(len(value), dtype=bool)
        count = -1
        while settled.sum() != count:
            count = settled.sum()
            bad = ~sure | (alive & ~settled[machine.after])
            safe = optimal & known & (self._expected(bad) == 0)
            settled[:n] = safe.any(axis=0)
        self.plan = np.where(settled[:n], safe.argmax(axis=0), optimal.argmax(axis=0))
        open_starts = machine.starts[~settled[machine.starts]]
        self._want(np.unique(open_starts), known, settled, sure, sure & alive)
        return not len(open_starts)

    def _expected(self, values: Floats | Bools) -> Floats:
        """The mean of the values of outcomes (N,) of each macro-action in each macrostate of play. Shape (A, P)."""
        return np.add.reduceat(self.machine.probability * values, self.first[:-1]).reshape(self.shape)

    def _imagined(self, worth: Floats, known: Bools) -> Floats:
        """The best that an unknown entry may lead to: any values of all the coordinates that the action moves."""
        machine = self.machine
        if self.graph.read != "next" or math.prod(self.box) > _CELLS:
            return np.full(self.shape, worth.max())
        cell = np.ravel_multi_index(tuple(machine.coordinates.T), self.box)
        grid = np.full(math.prod(self.box), -np.inf)
        np.maximum.at(grid, cell[machine.after], worth)  # the worth of a macrostate is one whatever led there
        grid = grid.reshape(self.box)
        found = np.full(self.shape, -np.inf)
        for action in np.flatnonzero(~known.all(axis=1)):
            widest = np.broadcast_to(grid.max(axis=tuple(self.moved[action]), keepdims=True), self.box)
            found[action] = widest.reshape(-1)[cell[: machine.n_play]]
        return found

    def _want(
        self,
        front: Ints,
        known: Bools,
        settled: Bools,
        sure: Bools,
        goes_on: Bools,
    ) -> None:
        """Find the unknown facts that the plans from some rows touch."""
        self.wanted = np.zeros(len(self.known), dtype=bool)
        self.wanted_conditions = np.zeros(len(self.true), dtype=bool)
        self.unsure = np.empty(0, dtype=np.int64)  # the points that those decide
        met = settled.copy()
        while len(front):
            met[front] = True
            actions = self.plan[front]
            self.wanted[self.entries[actions, front]] = True
            through = known[actions, front]
            outcomes = self._outcomes_of(actions[through], front[through])
            points = self.graph.point[outcomes[~sure[outcomes]]]
            self.wanted_conditions[self._open_conditions(points)] = True
            self.unsure = np.union1d(self.unsure, self.alike[points])
            front = np.unique(self.machine.after[outcomes[goes_on[outcomes]]])
            front = front[~met[front]]

    def _open_conditions(self, points: Ints) -> Ints:
        """The conditions that the class of some points still rests on."""
        every = [np.empty(0, dtype=np.int64), *(conditions[points].ravel() for conditions in self.conditions)]
        found = np.unique(np.concatenate(every))
        return found[~(self.true | self.false)[found]]

    def _outcomes_of(self, actions: Ints | int, rows: Ints | int) -> Ints:
        pairs = np.atleast_1d(actions * self.machine.n_play + rows)
        ranges = [np.arange(self.first[pair], self.first[pair + 1]) for pair in pairs]
        return np.concatenate([np.empty(0, dtype=np.int64), *ranges])

    def is_exhausted(self) -> bool:
        """Whether nothing that was wanted is unknown any more, or nothing unsure that it would decide unseen."""
        if (self.wanted & ~self.known).any():
            return False
        left = self.wanted_conditions & ~self.true & ~self.false
        return not (left.any() and (self.class_of[self.unsure] < 0).any())

    def _novelty(self, action: int, row: int) -> int:
        """How many wanted facts an action may show."""
        entries = self.entries[action, row]
        if not self.known[entries].all():
            return int((self.wanted & ~self.known)[entries].sum())
        points = self.graph.point[self._outcomes_of(action, row)]
        unseen = points[self.class_of[self.alike[points]] < 0]
        return int(self.wanted_conditions[self._open_conditions(unseen)].sum())

    def choose(self, row: int, left: int, rng: np.random.Generator) -> int:
        """The first action toward the nearest wanted fact, at random among equals; the plan's where there is none."""
        paths: list[tuple[int, int | None]] = [(row, None)]
        met = {row}
        for _ in range(left):
            ways = [
                (self._novelty(action, here), action if first is None else first)
                for here, first in paths
                for action in range(self.machine.n_actions)
            ]
            most = max((novelty for novelty, _ in ways), default=0)
            if most:
                best = [first for novelty, first in ways if novelty == most]
                return best[int(rng.integers(len(best)))]
            paths = [
                (after, action if first is None else first)
                for here, first in paths
                for action, after in self._ways_on(here, met)
            ]
        return int(self.plan[row])

    def _ways_on(self, here: int, met: set[int]) -> list[tuple[int, int]]:
        """Actions of known effect, each with a macrostate that it may lead to and that was not met, which is now."""
        found = []
        for action in np.flatnonzero(self.known[self.entries[:, here]].all(axis=1)).tolist():
            for outcome in self._outcomes_of(action, here):
                after = int(self.machine.after[outcome])
                class_ = self.class_of[self.alike[self.graph.point[outcome]]]
                if after not in met and class_ >= 0 and not self.ends[class_]:
                    met.add(after)
                    found.append((action, after))
        return found


def learn(machine: Machine, graph: FactorGraph, horizon: int, rng: np.random.Generator) -> LearnerRun:
    """Let one learner learn until it is done."""
    learner = CautiousLearner(machine, graph, horizon)
    transitions = 0
    episodes = 0
    done = learner.solve()
    while not done and transitions < MOST:
        row = int(rng.choice(machine.starts))
        episodes += 1
        for step in range(horizon):
            action = learner.choose(row, horizon - step, rng)
            first, last = learner.first[action * machine.n_play + row :][:2]
            outcome = first + int(rng.choice(last - first, p=machine.probability[first:last]))
            transitions += 1
            if learner.learn(outcome) or learner.is_exhausted():
                done = learner.solve()
            if done or learner.ends[machine.class_[outcome]]:
                break
            row = int(machine.after[outcome])
    facts = int(learner.known[1:].sum() + learner.true.sum())
    return LearnerRun(transitions=transitions, episodes=episodes, facts=facts, done=done)
