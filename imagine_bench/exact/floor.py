"""The information floor: how many transitions a learner needs that knows the factor graph, but none of its entries.

The learner sees macrostates and classes, plans exactly, and is told a local entry of the dynamics, probabilities and
all, by the first transition that shows it; a class that does not hold rules out its conditions there, one that holds
shows that at least one is true. What is unknown it takes for the best that is possible (optimism; Brafman and
Tennenholtz 2002): an unknown entry may lead anywhere in the coordinates that it decides, an unknown class may be any.
It goes to the nearest unknown fact that an optimistic plan from some start still rests on, and is done when from every
start the best imaginable is reached through known facts alone: its policy is then optimal whatever the rest is.
Probabilities would have to be estimated on top, so that with chance this is a floor of the certain part alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.exact.factors import FactorGraph, keys
from imagine_bench.exact.machine import Machine
from imagine_bench.interfaces import Floats

_SUCCESS = 10_000.0  # of return: success comes first
_EPS = 1e-6
_CELLS = 2_000_000  # combinations of values up to which all are looked at
_SWEEPS = 4  # times the horizon
MOST = 3_000
"""Transitions after which a learner gives up."""


@dataclass(frozen=True, kw_only=True)
class Lesson:
    """What one learner needed."""

    transitions: int
    episodes: int
    facts: int  #: entries of the dynamics seen, and conditions of classes found true
    done: bool  #: whether it knew an optimal policy when it stopped


class _Knowledge:
    """What is known of each local entry, and what that leaves possible. ``Q`` points, ``E`` dynamics entries."""

    def __init__(self, machine: Machine, graph: FactorGraph) -> None:
        self.machine = machine
        self.graph = graph
        shape = (machine.n_actions, machine.n_play)
        first = 0
        touched: list[list[NDArray[np.int64]]] = [[] for _ in range(machine.n_actions)]
        for factor in graph.factors:
            touched[factor.action].append(factor.entry + first)
            first += int(factor.entry.max()) + 1
        depth = max(map(len, touched))
        self.entries = np.full((*shape, depth), first)  # the last entry is always known
        for action, columns in enumerate(touched):
            for i, column in enumerate(columns):
                self.entries[action, :, i] = column
        self.known = np.zeros(first + 1, dtype=np.bool_)
        self.known[first] = True
        self.conditions: list[NDArray[np.int64]] = []  # of each claim: condition of each point and scope. (Q, scopes)
        count = 0
        for claim in graph.claims:
            columns = []
            for scope in claim.scopes:
                number = np.unique(keys(graph.points, scope), return_inverse=True)[1].reshape(-1)
                columns.append(number + count)
                count += int(number.max()) + 1
            self.conditions.append(np.stack(columns, axis=1))
        self.true = np.zeros(count, dtype=np.bool_)
        self.false = np.zeros(count, dtype=np.bool_)
        read = sorted({i for claim in graph.claims for scope in claim.scopes for i in scope})
        self.alike = np.unique(keys(graph.points, read), return_inverse=True)[1].reshape(-1)  # points that are one
        self.class_of = np.full(int(self.alike.max()) + 1, -1)  # what was observed
        self.clauses: list[tuple[int, int]] = []  # (claim, point): at least one condition is true

    def learn(self, outcome: int) -> bool:
        """Take in a transition; whether more than the absence of a condition was learned."""
        machine = self.machine
        point = int(self.graph.point[outcome])
        mine = self.entries[machine.action[outcome], machine.before[outcome]]
        news = not self.known[mine].all()
        self.known[mine] = True
        if self.class_of[self.alike[point]] < 0:
            self.class_of[self.alike[point]] = machine.class_[outcome]
            for index, (claim, conditions) in enumerate(zip(self.graph.claims, self.conditions, strict=True)):
                if claim.class_ == machine.class_[outcome]:
                    self.clauses.append((index, point))
                    break
                self.false[conditions[point]] = True
            news |= self._resolve()
        return news

    def _resolve(self) -> bool:
        """A clause of which one condition is left shows that it is true."""
        open_ = []
        news = False
        for index, point in self.clauses:
            conditions = self.conditions[index][point]
            left = np.unique(conditions[~self.false[conditions]])
            if len(left) == 1:
                news |= not self.true[left[0]]
                self.true[left] = True
            elif not self.true[left].any():
                open_.append((index, point))
        self.clauses = open_
        return news

    def possible(self) -> NDArray[np.bool_]:
        """Which classes each point may have. Shape (C, Q)."""
        found = np.zeros((len(self.machine.classes), len(self.alike)), dtype=np.bool_)
        free = np.ones(len(self.alike), dtype=np.bool_)  # of every claim above
        for claim, conditions in zip(self.graph.claims, self.conditions, strict=True):
            found[claim.class_] = free & ~self.false[conditions].all(axis=1)
            free &= ~self.true[conditions].any(axis=1)
        found[self.graph.usual] = free
        seen = self.class_of[self.alike]
        found[:, seen >= 0] = seen[seen >= 0] == np.arange(len(found))[:, None]
        return found

    def open_conditions(self, points: NDArray[np.int64]) -> NDArray[np.int64]:
        """The conditions that the class of some points still rests on."""
        every = np.concatenate([conditions[points].ravel() for conditions in self.conditions])
        return np.unique(every[~(self.true | self.false)[every]])


class _Learner:
    """One learner in the machine."""

    def __init__(self, machine: Machine, graph: FactorGraph, horizon: int) -> None:
        from scipy.sparse import csr_array  # noqa: PLC0415 - loads for long

        self.machine = machine
        self.graph = graph
        self.horizon = horizon
        self.knows = _Knowledge(machine, graph)
        n = machine.n_play * machine.n_actions
        columns = np.arange(len(machine.pair))
        self.outcomes = csr_array((machine.probability, (machine.pair, columns)), shape=(n, len(machine.pair)))
        self.any_outcome = csr_array((np.ones(len(columns)), (machine.pair, columns)), shape=self.outcomes.shape)
        self.first = np.searchsorted(machine.pair, np.arange(n + 1))
        self.shape = (machine.n_actions, machine.n_play)
        self.pay = np.array([reward + _SUCCESS * success for reward, _, success in machine.classes])
        self.ends = np.array([ended for _, ended, _ in machine.classes])
        self.box = tuple((machine.coordinates.max(axis=0) + 1).tolist())
        fits = graph.read == "next" and math.prod(self.box) <= _CELLS
        self.cell = np.ravel_multi_index(tuple(machine.coordinates.T), self.box) if fits else None
        self.moved = [
            tuple(i for factor in graph.factors if factor.action == action for i in factor.children)
            for action in range(machine.n_actions)
        ]

    def solve(self) -> bool:
        """Plan optimistically; whether every start is settled. Leaves the facts wanted and the plan."""
        machine = self.machine
        n = self.machine.n_play
        possible = self.knows.possible()[:, self.graph.point]  # [C, N]
        sure = possible.sum(axis=0) == 1
        alive = (possible & ~self.ends[:, None]).any(axis=0)
        entries_known = self.knows.known[self.knows.entries].all(axis=2)
        best = np.where(possible, self.pay[:, None], -np.inf)
        ended = np.where(self.ends[:, None], best, -np.inf).max(axis=0)  # [N]
        going = np.where(self.ends[:, None], -np.inf, best).max(axis=0)
        value = np.zeros(len(machine.coordinates))
        for _ in range(_SWEEPS * self.horizon):
            worth = np.maximum(ended, going + value[machine.after])
            through = (self.outcomes @ worth).reshape(self.shape)
            q = np.where(entries_known, through, self._imagined(worth, entries_known))
            change, value[:n] = np.abs(q.max(axis=0) - value[:n]).max(), q.max(axis=0)
            if change < _EPS:
                break
        optimal = (q >= q.max(axis=0) - _EPS) & np.isfinite(q)
        settled = np.ones(len(value), dtype=np.bool_)
        count = -1
        while settled.sum() != count:
            count = settled.sum()
            bad = ~sure | (alive & ~settled[machine.after])
            known = entries_known & ~((self.any_outcome @ bad).reshape(self.shape) > 0)
            settled[:n] = (optimal & known).any(axis=0)
        self.entries_known = entries_known
        self.sure = sure
        self.alive = alive
        self.plan = np.where((optimal & known).any(axis=0), (optimal & known).argmax(axis=0), optimal.argmax(axis=0))
        open_starts = machine.starts[~settled[machine.starts]]
        self._want(np.unique(open_starts), settled)
        return not len(open_starts)

    def _imagined(self, worth: Floats, entries_known: NDArray[np.bool_]) -> Floats:
        """The best that an unknown entry may lead to: any values of all the coordinates that the action moves."""
        found = np.full(self.shape, -np.inf)
        machine = self.machine
        if self.cell is not None:  # the worth of a macrostate reached is one whatever led there
            grid = np.full(int(np.prod(self.box)), -np.inf)
            np.maximum.at(grid, self.cell[machine.after], worth)
            grid = grid.reshape(self.box)
            for action in np.flatnonzero(~entries_known.all(axis=1)):
                widest = np.broadcast_to(grid.max(axis=self.moved[action], keepdims=True), self.box)
                found[action] = widest.reshape(-1)[self.cell[: machine.n_play]]
        else:
            found[:] = worth.max()
        return found

    def _want(self, starts: NDArray[np.int64], settled: NDArray[np.bool_]) -> None:
        """The unknown facts that the plans from some starts touch."""
        knows = self.knows
        machine = self.machine
        self.wanted = np.zeros(len(knows.known), dtype=np.bool_)
        self.wanted_conditions = np.zeros(len(knows.true), dtype=np.bool_)
        self.unsure = np.empty(0, dtype=np.int64)  # the points that those decide
        met = np.zeros(machine.n_play, dtype=np.bool_)
        front = starts
        while len(front):
            met[front] = True
            actions = self.plan[front]
            entries = knows.entries[actions, front].ravel()
            self.wanted[entries[~knows.known[entries]]] = True
            through = self.entries_known[actions, front]
            outcomes = self._outcomes_of(actions[through] * machine.n_play + front[through])
            unsure = outcomes[~self.sure[outcomes]]
            if len(unsure):
                points = self.graph.point[unsure]
                self.wanted_conditions[knows.open_conditions(points)] = True
                self.unsure = np.union1d(self.unsure, knows.alike[points])
            on = outcomes[self.sure[outcomes] & self.alive[outcomes]]
            front = np.unique(machine.after[on])
            front = front[~met[front] & ~settled[front]]

    def _outcomes_of(self, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
        if not len(pairs):
            return np.empty(0, dtype=np.int64)
        return np.concatenate([np.arange(self.first[pair], self.first[pair + 1]) for pair in pairs])

    def is_exhausted(self) -> bool:
        """Whether nothing that was wanted is unknown any more, or nothing unsure that it would decide unseen."""
        knows = self.knows
        left = self.wanted_conditions & ~knows.true & ~knows.false
        open_ = left.any() and (knows.class_of[self.unsure] < 0).any()
        return not (open_ or (self.wanted & ~knows.known).any())

    def novelty(self, row: int) -> NDArray[np.int64]:
        """How many wanted facts each action may show. Shape (A,)."""
        knows = self.knows
        found = np.zeros(self.machine.n_actions, dtype=np.int64)
        for action in range(self.machine.n_actions):
            entries = np.unique(knows.entries[action, row])
            found[action] = (self.wanted & ~knows.known)[entries].sum()
            if knows.known[entries].all() and knows.conditions:
                outcomes = self._outcomes_of(np.array([action * self.machine.n_play + row]))
                points = self.graph.point[outcomes]
                points = points[knows.class_of[knows.alike[points]] < 0]
                if len(points):
                    found[action] += self.wanted_conditions[knows.open_conditions(points)].sum()
        return found

    def choose(self, row: int, left: int, rng: np.random.Generator) -> int:
        """The first action toward the nearest wanted fact, at random among equals; the plan's where there is none."""
        paths: list[tuple[int, int]] = [(row, -1)]
        met = {row}
        for _ in range(left):
            shown = [(self.novelty(here), first) for here, first in paths]
            most = max(int(novelty.max()) for novelty, _ in shown)
            if most:
                ways = [(int(a), first) for novelty, first in shown for a in np.flatnonzero(novelty == most)]
                action, toward = ways[int(rng.integers(len(ways)))]
                return action if toward < 0 else toward
            reached = []
            for here, first in paths:
                for action in np.flatnonzero(self.knows.known[self.knows.entries[:, here]].all(axis=1)).tolist():
                    for outcome in self._outcomes_of(np.array([action * self.machine.n_play + here])):
                        after = int(self.machine.after[outcome])
                        class_ = self.knows.class_of[self.knows.alike[self.graph.point[outcome]]]
                        if after not in met and class_ >= 0 and not self.ends[class_]:
                            met.add(after)
                            reached.append((after, action if first < 0 else first))
            paths = reached
            if not paths:
                break
        return int(self.plan[row])


def learn(machine: Machine, graph: FactorGraph, horizon: int, rng: np.random.Generator) -> Lesson:
    """Let one learner learn until it is done."""
    learner = _Learner(machine, graph, horizon)
    transitions = 0
    episodes = 0
    done = learner.solve()
    while not done and transitions < MOST:
        row = int(rng.choice(machine.starts))
        episodes = episodes + 1
        for step in range(horizon):
            action = learner.choose(row, horizon - step, rng)
            first, last = learner.first[action * machine.n_play + row : action * machine.n_play + row + 2]
            outcome = first + int(rng.choice(last - first, p=machine.probability[first:last]))
            transitions += 1
            if learner.knows.learn(outcome) or learner.is_exhausted():
                done = learner.solve()
            if done or machine.classes[machine.class_[outcome]][1]:
                break
            row = int(machine.after[outcome])
    facts = int(learner.knows.known[:-1].sum() + learner.knows.true.sum())
    return Lesson(transitions=transitions, episodes=episodes, facts=facts, done=done)
