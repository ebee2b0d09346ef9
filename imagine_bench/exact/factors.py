"""A macrostate machine as arrays, and its factor graph: which coordinates decide which.

The graph is found by exact tests over everything that is reached.

A coordinate's next value, given the action, depends on the smallest set of coordinates of which it is a function in
every macrostate of play (of equal sets, the one with the coordinate itself, then the first). Coordinates that are drawn
together are one factor. Reward and end are a list of classes, read from the top: a class holds where one of its local
conditions does, that is where some values of a few coordinates force it among all that no class above has claimed; the
class that needs the smallest conditions comes first, and the rest at the end is the usual case.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Floats, Ints
from imagine_bench.rules import Rules, every_outcome

Class = tuple[float, bool, bool]
"""The outcome of a macro-action: the reward, whether the episode ended, whether as a success."""


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Every macro-action out of every macrostate of play that is reached from the starts, and each of its outcomes.

    Shapes: ``S`` macrostates, those of play first, ``P`` of play, ``A`` actions, ``N`` outcomes, ``M`` coordinates.
    """

    coordinates: Ints  #: Shape (S, M).
    n_play: int  #: P
    n_actions: int  #: A
    starts: Ints  #: Rows an episode may start in.
    classes: tuple[Class, ...]
    pair: Ints  #: ``action * P + row`` of each outcome, ascending. Shape (N,).
    after: Ints  #: Row of its macrostate. Shape (N,).
    probability: Floats  #: Shape (N,).
    class_: Ints  #: Index in ``classes``. Shape (N,).

    @property
    def action(self) -> Ints:
        """The action of each outcome. Shape (N,)."""
        return self.pair // self.n_play

    @property
    def before(self) -> Ints:
        """The row that each outcome comes from. Shape (N,)."""
        return self.pair % self.n_play


Scope = tuple[int, ...]
"""Coordinates, ascending."""
_DIGITS = 9


@dataclass(frozen=True, kw_only=True)
class Factor:
    """Coordinates whose next values an action draws together, and the coordinates that this depends on."""

    action: int
    children: Scope
    parents: Scope
    entry: Ints  #: which local entry decides in each macrostate of play, from 0. Shape (P,).


@dataclass(frozen=True, kw_only=True)
class LocalClass:
    """A class that some values of a few coordinates force."""

    class_: int  #: index in the machine's classes
    scopes: tuple[Scope, ...]  #: the coordinates of its conditions
    conditions: int  #: assignments to scopes that force it


@dataclass(frozen=True, kw_only=True)
class FactorGraph:
    """Which coordinates decide which. An action leaves every coordinate alone that none of its factors has."""

    factors: tuple[Factor, ...]
    #: coordinates that decide reward and end: ``"next"``, the macrostate reached, ``"choice"``, the macrostate and the
    #: action, or ``"both"``
    read: str
    point: Ints  #: the distinct point that each outcome's class is read from. Shape (N,).
    points: Ints  #: the points' values. Shape (Q, F).
    claims: tuple[LocalClass, ...]  #: in order
    usual: int  #: the class of everything that none claims

    @property
    def width(self) -> int:
        """The most coordinates that decide one factor or make up one condition."""
        scopes = [scope for claim in self.claims for scope in claim.scopes]
        return max([len(scope) for scope in (*(factor.parents for factor in self.factors), *scopes)], default=0)

    @property
    def facts(self) -> int:
        """Local entries of the dynamics and conditions of classes: all that there is to know."""
        entries = sum(int(factor.entry.max()) + 1 for factor in self.factors)
        return entries + sum(claim.conditions for claim in self.claims)


def machine(rules: Rules) -> Machine:
    """Follow the rules from their starts."""
    found = every_outcome(rules.start_states, rules.n_actions, rules.outcomes, follow=True)
    states = np.array(list(found.index), dtype=np.int64)
    ends = np.setdiff1d(np.arange(len(states)), found.asked)
    order = np.concatenate([found.asked, ends])
    row = np.argsort(order)  # of each in this order
    pair = found.action * len(found.asked) + row[found.before]
    by_pair = np.argsort(pair, kind="stable")
    kinds = list(zip(found.reward.tolist(), found.terminated.tolist(), found.success.tolist(), strict=True))
    classes = {kind: number for number, kind in enumerate(dict.fromkeys(kinds))}
    return Machine(
        coordinates=states[order],
        n_play=len(found.asked),
        n_actions=rules.n_actions,
        starts=row[[found.index[state] for state in rules.start_states]],
        classes=tuple(classes),
        pair=pair[by_pair],
        after=row[found.after][by_pair],
        probability=found.probability[by_pair],
        class_=np.array([classes[kind] for kind in kinds])[by_pair],
    )


def keys(values: Ints, scope: Iterable[int]) -> Ints:
    """One number for the values of some columns in each row, equal where they are. Shape (N,)."""
    found = np.zeros(len(values), dtype=np.int64)
    for column in scope:
        found = found * (values[:, column].max(initial=0) + 1) + values[:, column]
    return found


def numbered(values: NDArray[np.generic]) -> Ints:
    """The number of each value among the distinct ones, ascending from 0. Shape (N,)."""
    return np.unique(values, return_inverse=True)[1].reshape(-1)


def factor_graph(machine: Machine) -> FactorGraph:
    """Compute it."""
    factors = tuple(each for action in range(machine.n_actions) for each in _factors(machine, action))
    read, point, points = _points(machine)
    label = np.empty(len(points), dtype=np.int64)
    label[point] = machine.class_
    claims, usual = _claims(points, label)
    return FactorGraph(factors=factors, read=read, point=point, points=points, claims=claims, usual=usual)


def _factors(machine: Machine, action: int) -> Iterator[Factor]:
    first, last = np.searchsorted(machine.pair, [action * machine.n_play, (action + 1) * machine.n_play])
    before = machine.before[first:last]
    after = machine.coordinates[machine.after[first:last]]
    now = machine.coordinates[: machine.n_play]
    weight = machine.probability[first:last]
    moved = [i for i in range(now.shape[1]) if (after[:, i] != now[before, i]).any()]
    for children in _drawn_together(moved, before, after, weight):
        law = _laws(before, numbered(keys(after, children)), weight, machine.n_play)
        parents = _smallest(now, law, children)
        entry = numbered(keys(now, parents))
        yield Factor(action=action, children=children, parents=parents, entry=entry)


def _laws(before: Ints, value: Ints, weight: Floats, n: int) -> Ints:
    """A number for the distribution of a value after each macrostate, equal where they are. Shape (P,)."""
    share = np.zeros((n, int(value.max()) + 1))
    np.add.at(share, (before, value), weight)
    return np.unique(share.round(_DIGITS), axis=0, return_inverse=True)[1].reshape(-1)


def _drawn_together(moved: list[int], before: Ints, after: Ints, weight: Floats) -> list[Scope]:
    """Partition of the coordinates that an action moves: two are together if their joint law is no product."""
    groups = {each: {each} for each in moved}
    if (np.bincount(before) > 1).any():
        for one, other in combinations(moved, 2):
            if groups[one] is not groups[other] and not _independent(before, after[:, [one, other]], weight):
                groups[one] |= groups[other]
                groups.update(dict.fromkeys(groups[other], groups[one]))
    return sorted({tuple(sorted(group)) for group in groups.values()})


def _independent(before: Ints, after: Ints, weight: Floats) -> bool:
    shape = (int(before.max()) + 1, *(after.max(axis=0) + 1))
    joint = np.zeros(shape)
    np.add.at(joint, (before, after[:, 0], after[:, 1]), weight)
    product = joint.sum(axis=2, keepdims=True) * joint.sum(axis=1, keepdims=True)
    return bool(np.abs(joint - product).max() < 10.0**-_DIGITS)


def _smallest(now: Ints, law: Ints, children: Scope) -> Scope:
    columns = range(now.shape[1])
    for size in range(now.shape[1] + 1):
        for scope in sorted(combinations(columns, size), key=lambda each: (-len({*each} & {*children}), each)):
            key = keys(now, scope)
            first = np.empty(int(key.max()) + 1, dtype=np.int64)
            first[key] = law
            if (first[key] == law).all():
                return scope
    raise AssertionError("the whole macrostate decides")


def _points(machine: Machine) -> tuple[str, Ints, Ints]:
    now = machine.coordinates[machine.before]
    then = machine.coordinates[machine.after]
    choice = np.hstack([now, machine.action[:, None]])
    for read, values in (("next", then), ("choice", choice), ("both", np.hstack([choice, then]))):
        key = keys(values, range(values.shape[1]))
        _, first, point = np.unique(key, return_index=True, return_inverse=True)
        point = point.reshape(-1)
        if (machine.class_[first][point] == machine.class_).all():
            return read, point, values[first]
    raise AssertionError("everything together decides")


def _claims(points: Ints, label: Ints) -> tuple[tuple[LocalClass, ...], int]:
    claims: list[LocalClass] = []
    while len(left := np.unique(label)) > 1:
        claim = _next_claim(points, label, left)
        claims.append(claim)
        points = points[label != claim.class_]
        label = label[label != claim.class_]
    return tuple(claims), int(left[0])


def _next_claim(points: Ints, label: Ints, left: Ints) -> LocalClass:
    """The class that the smallest conditions force everywhere; of those, the one with the fewest."""
    forced: dict[int, list[tuple[Scope, Ints]]] = {int(each): [] for each in left}
    for size in range(points.shape[1] + 1):
        scopes = list(combinations(range(points.shape[1]), size))
        found = []
        for class_, so_far in forced.items():
            is_it = label == class_
            for scope in scopes:
                key = numbered(keys(points, scope))
                total = np.bincount(key)
                of_it = np.bincount(key, weights=is_it)
                forces = (total == of_it)[key]
                if forces.any():
                    so_far.append((scope, np.where(forces, key, -1)))
            if so_far and np.logical_or.reduce([key >= 0 for _, key in so_far])[is_it].all():
                found.append(_cover(class_, so_far))
        if found:
            return min(found, key=lambda claim: (claim.conditions, claim.class_))
    raise AssertionError("the whole point decides")


def _cover(class_: int, forced: list[tuple[Scope, Ints]]) -> LocalClass:
    """A small set of scopes: again and again the one that covers most of the remaining ones."""
    covered = np.zeros(len(forced[0][1]), dtype=bool)
    scopes = []
    conditions = 0
    wanted = np.logical_or.reduce([key >= 0 for _, key in forced])
    while not (covered == wanted).all():
        scope, key = max(forced, key=lambda each: int(((each[1] >= 0) & ~covered).sum()))
        scopes.append(scope)
        conditions += len(np.unique(key[key >= 0]))
        covered |= key >= 0
    return LocalClass(class_=class_, scopes=tuple(sorted(scopes)), conditions=conditions)
