"""The shortest laws that explain transitions between symbols, found by enumeration, without a network.

A program of laws has three parts, each the shortest that explains the data. Symbols may be some macro-actions late
(:mod:`.delay`); laws are about those that are not.

- *Effects*: "if at most two conditions hold, the macro-action makes a factor f(its value)". All effects of a
  macro-action come about together, with one probability; otherwise it changes nothing. Two macro-actions that undo
  each other on a factor, wherever both were seen, are taken to do so everywhere, unless one of them left a value as it
  was more often than chance explains.
- *Drifts*: whatever is done, a factor turns into another of its values with one probability, while the episode goes on.
  A misread image must become no law. So one with conditions explains two transitions, and a drift three.
- *Ends*: a list of "if at most two conditions hold, this reward, and whether the episode ends", read from the top.
  Laws of a class have one of four forms, and a form with fewer possible conditions makes each law shorter. The first
  form has conditions on the symbols after alone. So a law does not say by coincidence that two codes are alike.

Lengths are in nats. A law costs the logarithm of the number of laws of its form, data its negative log-likelihood. A
probability is counted and then rounded: to one decimal, unless two decimals pay for themselves. The idea is that of
OneLife (arXiv 2510.12088) and PoE-World (arXiv 2505.10819), whose laws a language model writes.

Shapes: ``N`` transitions, ``P`` factors.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Outcome, State

from ..symbol_rules import SymbolRules
from .delay import MOST_DELAY, CodedRow, changes, complete, too_early

_CONTRADICTED = 20.0
"""Nats that a transition costs which no law explains."""
_FORMS = 4
"""Forms of a function of a value: a step round the circle of its values, a constant, a permutation, a table."""
_TESTS = 2
"""Most conditions of a law."""
_MISREAD = 2
_FEW = 6
"""Transitions that one misread image changes, and those under an effect of which one alone may change something."""
BY_CHANCE = 0.001
"""All tries may have failed by chance if that is at least so probable."""


class Test(NamedTuple):
    """A condition on a tuple: place ``place`` holds ``value`` or, if ``alike``, the same as place ``value``."""

    place: int
    value: int
    alike: bool = False

    def holds(self, values: State) -> bool:
        """Whether it holds."""
        return values[self.place] == (values[self.value] if self.alike else self.value)


Tests = tuple[Test, ...]
Bools = NDArray[np.bool_]


class Effect(NamedTuple):
    """If all tests on the symbols hold, a factor becomes ``becomes[its value]``."""

    factor: int
    tests: Tests
    becomes: State


class End(NamedTuple):
    """If all tests on the symbols after, the action and the symbols before hold, this reward and end."""

    tests: Tests
    reward: float
    ended: bool


class Laws(SymbolRules):
    """The laws of N transitions between symbols of so many values each, -1 for a value that was not seen."""

    def __init__(self, sizes: Sequence[int], n_actions: int, rows: Sequence[CodedRow] = ()) -> None:
        super().__init__(n_actions)
        self.sizes = tuple(sizes)
        self._known: dict[tuple[State, int], tuple[Outcome, ...]] = {}
        found = _Dynamics(self.sizes, n_actions, complete(changes(rows, 0)))
        self.delay = 0
        """How many macro-actions symbols are late."""
        for delay in range(1, MOST_DELAY + 1 if found.is_odd else 1):
            late = _Dynamics(self.sizes, n_actions, complete(changes(rows, delay)))
            late.nats += _CONTRADICTED * too_early(rows, delay)
            if late.nats < found.nats:
                found = late
                self.delay = delay
        self.drifts = found.drifts
        """Probability with which each factor that drifts does so, by factor."""
        self.effects = found.effects
        """The effects of each macro-action."""
        self.happens = found.happening()
        """Probability with which they come about, by macro-action."""
        present = complete(self.present(rows))
        self.ends = ends_of(present, self.sizes, n_actions)
        wrong = sum(self.end(row.now, row.action, row.then)[1:] != (row.reward, row.ended) for row in present)
        each = _TESTS * math.log(len(_forms(self.sizes, n_actions)[-1]))
        self.nats = found.nats + len(self.ends) * each + _CONTRADICTED * wrong
        """The length of the explanation."""

    @property
    def count(self) -> int:
        """How many laws there are."""
        return sum(map(len, self.effects)) + len(self.drifts) + len(self.ends)

    @property
    def superfluous(self) -> set[int]:
        """Factors that drift, and on which no law depends."""
        tests = [test for laws in self.effects for law in laws for test in law.tests]
        count = len(self.sizes)
        used = {test.place for test in tests}
        for test in itertools.chain(*(law.tests for law in self.ends)):
            places = (test.place, test.value) if test.alike else (test.place,)
            used |= {place % (count + 1) for place in places}  # after, the action, before
        return self.drifts.keys() - used

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """The outcomes that the laws expect; none is called a success. Dynamics hold after an end, too."""
        key = (macrostate, action)
        if key not in self._known:
            expected: defaultdict[tuple[State, float, bool], float] = defaultdict(float)
            turned = self.turned(macrostate, action)
            share = self.happens[action]
            for then, chance in ((turned, share), (macrostate, 1.0 - share)):
                for reached, part in self._drifted(macrostate, action, then):
                    end = self.end(macrostate, action, reached)
                    expected[reached, end.reward, end.ended] += chance * part
            possible = {end: chance for end, chance in expected.items() if chance > 0.0}
            self._known[key] = tuple(Outcome(chance, *end, success=False) for end, chance in possible.items())
        return self._known[key]

    def turned(self, state: State, action: int) -> State:
        """The symbols after a macro-action whose effects come about, without drifts."""
        return _turned(self.effects, state, action)

    def after(self, state: State, actions: Sequence[int]) -> State:
        """The symbols after the last ``delay`` of some macro-actions, whose effects are not seen yet."""
        for action in actions[max(0, len(actions) - self.delay) :]:
            state = self.turned(state, action) if min(state) >= 0 else state
        return state

    def present(self, rows: Sequence[CodedRow]) -> list[CodedRow]:
        """Transitions between the symbols that were not seen yet, with the rewards that came at once.

        Each transition of an episode is to follow the one before it.
        """
        if not self.delay:
            return list(rows)
        found = []
        for place, row in enumerate(rows):
            before = [each.action for each in rows[place - row.step : place]]
            now = self.after(row.now, before)
            then = self.turned(now, row.action) if min(now) >= 0 else now
            found.append(row._replace(now=now, then=then))
        return found

    def end(self, now: State, action: int, then: State) -> End:
        """The first law for reward and end that holds."""
        values = (*then, action, *now)
        for law in self.ends:
            if all(test.holds(values) for test in law.tests):
                return law
        return End((), 0.0, False)

    def _drifted(self, now: State, action: int, then: State) -> list[tuple[State, float]]:
        """The symbols after drifts, with probabilities; none drifts once the episode has ended."""
        found = [(then, 1.0)]
        if self.drifts and self.end(now, action, then).ended:
            return found
        for factor, chance in self.drifts.items():
            others = self.sizes[factor] - 1
            parts = [chance / others] * self.sizes[factor]
            parts[then[factor]] = 1.0 - chance
            found = [
                ((*state[:factor], value, *state[factor + 1 :]), share * part)
                for state, share in found
                for value, part in enumerate(parts)
            ]
        return found


def _turned(effects: Sequence[Sequence[Effect]], state: State, action: int) -> State:
    then = list(state)
    for law in reversed(effects[action]):  # of several that hold the first counts
        if all(test.holds(state) for test in law.tests):
            then[law.factor] = law.becomes[state[law.factor]]
    return tuple(then)


class _Dynamics:
    """Drifts and effects of N transitions in which every value was seen, and the nats of all of them."""

    def __init__(self, sizes: Sequence[int], n_actions: int, rows: Sequence[CodedRow]) -> None:
        self.sizes = tuple(sizes)
        self.n_actions = n_actions
        self._rows = rows
        self._of_action = [[row for row in rows if row.action == action] for action in range(n_actions)]
        self.drifts: dict[int, float] = {}
        self.effects: list[list[Effect]] = [[] for _ in range(n_actions)]
        self.nats = 0.0
        for factor in range(len(sizes)):
            self._explain(factor)

    @property
    def is_odd(self) -> bool:
        """Whether something changed that no effect explains, which may be an earlier macro-action's."""
        return bool(self.drifts) or any(
            row.then not in (row.now, _turned(self.effects, row.now, row.action)) for row in self._rows
        )

    def _explain(self, factor: int) -> None:
        """Explain the changes of a factor by effects, or by a drift if that takes fewer nats."""
        changed = sum(row.now[factor] != row.then[factor] for row in self._rows)
        kept = sum(row.now[factor] == row.then[factor] and not row.ended for row in self._rows)
        chance, nats = simplest(changed, kept)
        nats += math.log(len(self.sizes)) + changed * math.log(max(1, self.sizes[factor] - 1))
        found = [self._effects(rows, factor) for rows in self._of_action]
        of_effects = sum(spent for _, spent in found)
        if changed > _MISREAD and nats < of_effects:
            self.nats += nats
            self.drifts[factor] = chance
            return
        self.nats += of_effects
        for laws, more in zip(self.effects, self._pooled(factor, [more for more, _ in found]), strict=True):
            laws.extend(more)

    def _pooled(self, factor: int, found: Sequence[list[Effect]]) -> list[list[Effect]]:
        """The effects of each macro-action on a factor; two that undo each other share the changes that were seen."""
        seen = {}
        for action, laws in enumerate(found):
            pairs = Counter((row.now[factor], row.then[factor]) for row in self._of_action[action])
            if len(laws) == 1 and not laws[0].tests and (changed := _injective(pairs)):
                seen[action] = changed
        pooled = list(found)
        for action, changed in seen.items():
            known = _with_others(changed, [other for each, other in seen.items() if each != action])
            becomes = _completed(known or changed, self.sizes[factor])
            if known is not None and all(becomes[value] == value for value in self._staying(action, factor, changed)):
                pooled[action] = [Effect(factor, (), becomes)]
        return pooled

    def _staying(self, action: int, factor: int, changed: Mapping[int, int]) -> list[int]:
        """The values that a macro-action left as they are more often than it may have failed by chance."""
        tries = Counter(row.now[factor] for row in self._of_action[action])
        came = sum(row.now[factor] != row.then[factor] for row in self._of_action[action])
        fails = 1.0 - came / sum(tries[value] for value in changed)
        return [value for value, times in tries.items() if value not in changed and fails**times < BY_CHANCE]

    def _effects(self, rows: Sequence[CodedRow], factor: int) -> tuple[list[Effect], float]:
        """The effects of one macro-action on one factor, and their nats: one after another, each saves the most."""
        laws: list[Effect] = []
        spent = 0.0
        left = list(rows)
        while True:
            staying = _CONTRADICTED * sum(row.now[factor] != row.then[factor] for row in left)
            nats, law = self._best(left, factor)
            if law is None:
                return laws, spent + staying
            laws.append(law)
            rest = [row for row in left if not all(test.holds(row.now) for test in law.tests)]
            spent += nats - _CONTRADICTED * sum(row.now[factor] != row.then[factor] for row in rest)
            left = rest

    def _best(self, rows: Sequence[CodedRow], factor: int) -> tuple[float, Effect | None]:
        """The law of the fewest nats on all ``rows``, by the number of conditions, as long as more may be shorter."""
        now = np.array([row.now for row in rows], dtype=np.int64).reshape(-1, len(self.sizes))
        then = np.array([row.then[factor] for row in rows], dtype=np.int64)
        changed = now[:, factor] != then
        best: tuple[float, Effect | None] = (_CONTRADICTED * float(changed.sum()), None)
        size = self.sizes[factor]
        tests = [Test(place, value) for place, values in enumerate(self.sizes) for value in range(values)]
        holds = np.array([now[:, test.place] == test.value for test in tests])
        for count in range(_TESTS + 1):
            form = math.log(_FORMS) + count * math.log(len(tests))
            if form >= best[0]:
                break
            for chosen in itertools.combinations(range(len(tests)), count):
                inside = holds[list(chosen)].all(axis=0)
                outside = _CONTRADICTED * float((changed & ~inside).sum())
                if form + outside >= best[0]:
                    continue
                pairs = Counter(zip(now[inside, factor].tolist(), then[inside].tolist(), strict=True))
                if (changed & inside).sum() < 2 and (count or inside.sum() > _FEW):
                    continue  # it may be a misread image
                for length, becomes in _functions(pairs, size):
                    nats = form + outside + length + _misfit(pairs, becomes)
                    if nats < best[0]:
                        best = (nats, Effect(factor, tuple(tests[place] for place in chosen), becomes))
        return best

    def happening(self) -> list[float]:
        """How often the effects of each macro-action come about: one probability for all, if that is shorter."""
        counts = []
        for action, rows in enumerate(self._of_action):
            pairs = [(self._steady(_turned(self.effects, row.now, action), row.then), row) for row in rows]
            moved = [(turned, row) for turned, row in pairs if turned != row.now]
            came = sum(turned == self._steady(row.then, row.then) for turned, row in moved)
            counts.append((came, sum(self._steady(row.now, row.then) == row.then for _, row in moved)))
        each = [_named(*pair) for pair in counts]
        together = _named(*(sum(column) for column in zip(*counts, strict=True)))
        if together[1] <= sum(nats for _, nats in each):
            return [together[0]] * self.n_actions
        return [chance for chance, _ in each]

    def _steady(self, state: State, then: State) -> State:
        """Symbols with those that drift as in ``then``."""
        return tuple(then[factor] if factor in self.drifts else value for factor, value in enumerate(state))


def _functions(pairs: Counter[tuple[int, int]], size: int) -> Iterator[tuple[float, State]]:
    """Functions of a factor's value that explain some of the pairs of values, and the nats of each."""
    each = math.log(size)
    for step in {(after - before) % size for before, after in pairs} - {0}:
        yield each, tuple((value + step) % size for value in range(size))
    for constant in {after for before, after in pairs if before != after}:
        yield each, (constant,) * size
    table = list(range(size))
    for (before, after), _ in sorted(pairs.items(), key=lambda item: item[1]):  # the most frequent last
        table[before] = after if after != before else table[before]
    yield each * size, tuple(table)
    permutation = _permutation(pairs, size)
    if permutation is not None:
        yield math.lgamma(size + 1), permutation


def _permutation(pairs: Counter[tuple[int, int]], size: int) -> State | None:
    """The permutation of all changes among pairs of values, if there is one; see :func:`_completed`."""
    changed = _injective(pairs)
    return None if changed is None else _completed(changed, size)


def _injective(pairs: Iterable[tuple[int, int]]) -> dict[int, int] | None:
    """The value after each value that changed, None if these are no part of a permutation."""
    different = {(before, after) for before, after in pairs if before != after}
    changed = dict(different)
    return changed if len(different) == len(changed) == len({*changed.values()}) else None


def _with_others(changed: dict[int, int], others: Iterable[dict[int, int]]) -> dict[int, int] | None:
    """The changes of a macro-action and of those that undo it, or do the same, wherever both were seen; None alone."""
    known = None
    for other in others:
        back = {after: before for before, after in other.items()}
        for each in (other, back):
            own = known or changed
            joint = _injective([*own.items(), *each.items()])
            if joint is not None and own.items() & each.items():
                known = joint
    return known


def _completed(changed: dict[int, int], size: int) -> State:
    """The permutation with these changes that makes one cycle of all values whose own cycle is not seen whole."""
    becomes = dict(changed)
    first = [value for value in range(size) if value not in changed.values()]
    last = []
    for begin in first:
        end = begin
        while end in changed:
            end = changed[end]
        last.append(end)
    becomes.update(zip(last, [*first[1:], *first[:1]], strict=True))
    return tuple(becomes[value] for value in range(size))


def _misfit(pairs: Counter[tuple[int, int]], becomes: State) -> float:
    """The nats of pairs of values of a factor under a function."""
    came = failed = contradicted = 0
    for (before, after), times in pairs.items():
        if after == becomes[before]:
            came += times * (after != before)
        elif after == before:
            failed += times
        else:
            contradicted += times
    return simplest(came, failed)[1] + _CONTRADICTED * contradicted


def simplest(came: int, failed: int) -> tuple[float, float]:
    """The probability that describes counts in the fewest nats, of 0, 1 and those with one or two decimals, and these.

    Without counts it is 1.
    """
    if not came or not failed:
        return float(came >= failed), 0.0
    found = (1.0, math.inf)
    for parts in (10, 100):
        near = round(came / (came + failed) * parts)
        for part in range(max(1, near - 5), min(parts - 1, near + 5) + 1):
            chance = part / parts
            nats = math.log(parts) - came * math.log(chance) - failed * math.log(1.0 - chance)
            if nats < found[1]:
                found = (chance, nats)
    return found


def _named(came: int, failed: int) -> tuple[float, float]:
    """The same, where 0 and 1 also take the nats of the name of one probability in ten."""
    chance, nats = simplest(came, failed)
    return chance, nats + math.log(10) * ((came > 0) != (failed > 0))


def ends_of(rows: Sequence[CodedRow], sizes: Sequence[int], n_actions: int) -> list[End]:
    """A list of laws for reward and end: first the class that the shortest conditions tell from all others."""
    if not rows:
        return []
    values = np.array([(*row.then, row.action, *row.now) for row in rows])
    kinds = sorted({(row.reward, row.ended) for row in rows})
    label = np.array([kinds.index((row.reward, row.ended)) for row in rows])
    forms = _forms(sizes, n_actions)
    tests = forms[-1]
    holds = np.array([values[:, t.place] == (values[:, t.value] if t.alike else t.value) for t in tests])
    laws: list[End] = []
    while len(left := np.unique(label)) > 1:
        claims = [(_shortest_cover(holds, label == kind, list(map(len, forms))), int(kind)) for kind in left]
        (_, conditions), kind = min(claims, key=lambda claim: claim[0][0])
        if not conditions:
            break
        laws += [End(tuple(tests[place] for place in chosen), *kinds[kind]) for chosen in conditions]
        holds, label = holds[:, label != kind], label[label != kind]
    usual = Counter(label.tolist()).most_common(1)[0][0]
    return [*laws, End((), *kinds[usual])]


def _shortest_cover(holds: Bools, wanted: Bools, forms: Sequence[int]) -> tuple[float, list[tuple[int, ...]]]:
    """The cover of the fewest nats, and these nats; empty if there is none.

    Args:
        holds: Which condition holds in which of N transitions. Shape (conditions, N).
        wanted: Shape (N,).
        forms: How many of the conditions, from the first on, laws of each form may have.
    """
    found: tuple[float, list[tuple[int, ...]]] = (math.inf, [])
    for count in forms:
        cover = _cover(holds[:count], wanted)
        possible = sum(math.comb(count, size) for size in range(1, _TESTS + 1))
        nats = len(cover) * math.log(possible)
        if cover and nats < found[0]:
            found = (nats, cover)
    return found


def _forms(sizes: Sequence[int], n_actions: int) -> list[list[Test]]:
    """Conditions of four forms of laws, each with those of the form before.

    They are on the symbols after; on two of these that are alike; on the action; and on the symbols before.
    """
    count = len(sizes)
    places = (*sizes, n_actions, *sizes)
    each = [[Test(place, value) for value in range(size)] for place, size in enumerate(places)]
    pairs = [pair for pair in itertools.combinations(range(count), 2) if sizes[pair[0]] == sizes[pair[1]]]
    added = [
        list(itertools.chain(*each[:count])),
        [Test(*pair, alike=True) for pair in pairs],
        each[count],
        list(itertools.chain(*each[count + 1 :])),
    ]
    return list(itertools.accumulate(added, list.__add__))


def _cover(holds: Bools, wanted: Bools) -> list[tuple[int, ...]]:
    """Few sets of at most two conditions that hold wherever it is wanted, and nowhere else; none if there are none.

    Args:
        holds: Which condition holds in which of N transitions. Shape (conditions, N).
        wanted: Shape (N,).
    """
    count = len(holds)
    sets = [chosen for size in range(1, _TESTS + 1) for chosen in itertools.combinations(range(count), size)]
    first, last = np.array([(chosen[0], chosen[-1]) for chosen in sets]).T
    each = holds[first] & holds[last]
    pure = np.flatnonzero(each.any(axis=1) & ~(each & ~wanted).any(axis=1))
    each = each[pure]
    shorter = np.array([1.0 / len(sets[place]) for place in pure])
    found = []
    missing = wanted
    while missing.any():
        gains = (each & missing).sum(axis=1) * shorter
        if not gains.any():
            return []
        best = int(gains.argmax())
        found.append(best)
        missing = missing & ~each[best]
    for best in list(found):  # the first ones may be superfluous by now
        others = [other for other in found if other != best]
        if not (wanted & ~each[others].any(axis=0)).any():
            found = others
    return [sets[pure[best]] for best in found]
