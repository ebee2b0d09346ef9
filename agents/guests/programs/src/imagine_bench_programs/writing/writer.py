"""The agent ``laws:given``: it writes a program of laws from its own transitions, and searches in it for plans.

It explores with optimism: a macro-action whose result it does not know is worth the largest reward that it has seen
(R-max, Brafman & Tennenholtz 2002). Known is a macro-action with each value of each factor under which it was tried,
once if it changed anything, and reward and end wherever every two of the values reached were met together before.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from imagine_bench.interfaces import Outcome, State

from .delay import CodedRow, changes, complete
from .laws import BY_CHANCE, Laws

_DEPTH = 20
"""Macro-actions that are planned ahead."""
_MOST = 400
"""Symbols that one plan visits."""
_DISCOUNT = 0.95
_TRIES = 6
_MOST_TRIES = 12
"""Tries that changed nothing after which a macro-action is known to change nothing: between these, so many that all of
them slip with a probability below ``BY_CHANCE``."""
_GROWTH = 1.1
"""Laws are found anew once so many times the transitions of the last time were seen, or one was unexpected."""


class Writer:
    """A writer of laws between symbols of so many values each, -1 where one is not seen."""

    def __init__(self, sizes: Sequence[int], n_actions: int, rng: np.random.Generator) -> None:
        self.sizes = tuple(sizes)
        self.n_actions = n_actions
        self.rng = rng
        self.rows: list[CodedRow] = []
        self.laws = Laws(self.sizes, n_actions)
        """The newest laws, of the first ``_learned`` transitions."""
        self._learned = 0
        self._tried: Counter[tuple[int, int, int]] = Counter()
        """How often each macro-action was tried with a value of a factor; one that changed anything is enough."""
        self._taken: list[int] = []
        """The macro-actions of this episode."""
        self._met: set[tuple[tuple[int, int], ...]] = set()
        """Values, with their places, that met in a transition: those of the law that held; if none, all pairs."""

    def learn(self, row: CodedRow) -> None:
        """Take in a transition; one with a value that was not seen teaches nothing."""
        self.rows.append(row)
        if min(*row.now, *row.then) < 0:
            return
        episode = self.rows[len(self.rows) - 1 - row.step :]
        changed = changes(episode, self.laws.delay)[-1:]
        *_, present = self.laws.present(episode)
        for each in changed:
            self._count_try(each)
        expected = self._likeliest(present.now, present.action)
        as_expected = (expected.reward, expected.terminated) == (row.reward, row.ended)
        as_expected &= all(self._likeliest(each.now, each.action).macrostate == each.then for each in changed)
        if not as_expected or len(self.rows) >= _GROWTH * self._learned:
            self.write()
        else:
            self._met |= set(self._claims(present))

    def begin_episode(self) -> None:
        """Forget the macro-actions so far."""
        self._taken = []

    def _count_try(self, row: CodedRow) -> None:
        for factor, value in enumerate(row.now):
            self._tried[row.action, factor, value] += 1 if row.then == row.now else _MOST_TRIES

    def _likeliest(self, state: State, action: int) -> Outcome:
        return max(self.laws.outcomes(state, action), key=lambda each: each.probability)

    def write(self) -> None:
        """Find the laws of all transitions so far."""
        self.laws = Laws(self.sizes, self.n_actions, self.rows)
        self._learned = len(self.rows)
        self._met = {claim for row in self.laws.present(self.rows) for claim in self._claims(row)}
        self._tried.clear()
        for row in complete(changes(self.rows, self.laws.delay)):
            self._count_try(row)

    def take_up(self, sizes: Sequence[int], rows: Sequence[CodedRow]) -> None:
        """Begin again with transitions whose symbols have so many values each."""
        self.sizes = tuple(sizes)
        self.rows = list(rows)
        self.write()

    def _claims(self, row: CodedRow) -> list[tuple[tuple[int, int], ...]]:
        """The values whose meeting decides a transition's reward and end, as far as the laws say; else all pairs."""
        tests = self.laws.end(row.now, row.action, row.then).tests
        if not tests:
            return list(itertools.combinations_with_replacement(enumerate(row.then), 2))
        values = (*row.then, row.action, *row.now)
        places = {place for test in tests for place in ((test.place, test.value) if test.alike else (test.place,))}
        return [tuple((place, values[place]) for place in sorted(places))]

    def _tries(self, action: int) -> int:
        """Tries after which it is known what a macro-action does."""
        fails = 1.0 - self.laws.happens[action]
        if not 0.0 < fails < 1.0:
            return _TRIES
        return int(np.clip(math.ceil(math.log(BY_CHANCE) / math.log(fails)), _TRIES, _MOST_TRIES))

    def _is_unknown(self, now: State, action: int, expected: Outcome) -> bool:
        row = CodedRow(now, action, expected.macrostate, expected.reward, expected.terminated)
        tried = all(self._tried[action, factor, value] >= self._tries(action) for factor, value in enumerate(now))
        return not tried or not self._met.issuperset(self._claims(row))

    def explore(self, state: State) -> int:
        """The macro-action with which it explores."""
        return self.choose(state, explore=True)

    def choose(self, state: State, *, explore: bool) -> int:
        """The first macro-action of the best plan from the newest symbols, along the likeliest outcomes."""
        action = self._planned(self.laws.after(state, self._taken), explore=explore)
        self._taken.append(action)
        return action

    def _planned(self, state: State, *, explore: bool) -> int:
        if min(state) < 0:
            return int(self.rng.integers(self.n_actions))
        unknown = max((row.reward for row in self.rows), default=0.0)
        unknown = max(unknown, 1.0) / (1.0 - _DISCOUNT)
        values = np.full(self.n_actions, -np.inf)
        paths: list[tuple[State, int | None, float]] = [(state, None, 0.0)]
        met = {state}
        for depth in range(_DEPTH):
            weight = _DISCOUNT**depth
            further: list[tuple[State, int | None, float]] = []
            for (now, first, so_far), action in itertools.product(paths, range(self.n_actions)):
                begun = action if first is None else first
                likeliest = self._likeliest(now, action)
                then = likeliest.macrostate
                earned = so_far + weight * likeliest.reward
                if explore and self._is_unknown(now, action, likeliest):
                    values[begun] = max(values[begun], so_far + weight * unknown)
                elif likeliest.terminated or depth == _DEPTH - 1:
                    values[begun] = max(values[begun], earned)
                elif then not in met and len(met) < _MOST:
                    met.add(then)
                    further.append((then, begun, earned))
            paths = further
        if not explore:
            return int(values.argmax())
        return int(self.rng.choice(np.flatnonzero(values >= values.max() - 1e-9)))
