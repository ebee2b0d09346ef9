"""Families of questions about a whole world: the shown frames, possible answers, and the probability of each answer.

A question has C possible answers, in an order that was drawn. Its exact probabilities are the answer of the rules'
table, and a model's answer is that of the model's table, so a model that is exact in every single macro-action is exact
here. If a table excludes every possible answer of a question, all of them are equally likely.

Shapes: as in :mod:`.tables`; ``C`` answers, ``L`` transitions of a stream.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from imagine_bench.arrays import Floats, Ints
from imagine_bench.exact.changed_rules import SLIP
from imagine_bench.judge.worlds.tables import (
    Transitions,
    TransitionTable,
    fewest,
    likelihood,
    normalised,
    other_action,
    reaching,
    usual,
    with_coupling,
    with_slips,
)
from imagine_bench.judge.worlds.words import YES, Named, Shown, Words, yes_and_no

STREAM = 5  # transitions of a stream
_OF_STREAM = f"{STREAM} separate macro-actions, each before and after."


class Family(Protocol):
    """N questions of one kind."""

    name: ClassVar[str]  #: for tables and files

    @property
    def options(self) -> Ints:
        """The meaning of each answer, in the order that is shown. Shape (N, C)."""

    def answer(self, table: TransitionTable) -> Floats:
        """The probability of each answer by a table. Shape (N, C)."""

    def words(self, world: Named, row: int) -> list[Words]:
        """A question for a person; of a pair there are two."""


@dataclass(frozen=True, kw_only=True)
class MaskedFrames:
    """Two macro-actions, of which the frame between them is hidden: which macrostate does it show?"""

    name: ClassVar[str] = "masked frame"
    first: Transitions  #: the first macro-action; its result is hidden. Shapes (N,).
    actions: Ints  #: the second one. Shape (N,).
    reached: Ints  #: the macrostate after it. Shape (N,).
    options: Ints  #: rows of S

    def answer(self, table: TransitionTable) -> Floats:
        """By Bayes' rule: the option comes up after the first macro-action, and the last frame after the second."""
        weights = np.empty(self.options.shape)
        for column, middle in enumerate(self.options.T):
            second = Transitions(states=middle, actions=self.actions, frames=self.first.frames, reached=self.reached)
            weights[:, column] = likelihood(table, replace(self.first, reached=middle)) * likelihood(table, second)
        return normalised(weights)

    def words(self, world: Named, row: int) -> list[Words]:
        """The frame between is to be chosen."""
        first = world.actions[self.first.actions[row]]
        then = world.actions[self.actions[row]]
        images = [
            ("start", world.states[self.first.states[row]]),
            (f"1. {first}", None),
            (f"2. {then}", world.states[self.reached[row]]),
        ]
        text = f"First “{first}”, then “{then}”. Which image belongs between the two that are shown?"
        return [Words(text, images, answer_images=world.chosen(self.options[row]))]


@dataclass(frozen=True, kw_only=True)
class _OfGoals:
    """Questions about the best plan from a start to a goal."""

    starts: Ints  #: rows of S. Shape (N,).
    goals: Ints  #: rows of T. Shape (N,).

    def reached(self, table: TransitionTable, depth: int) -> Floats:
        """The best probability that the goal of each question has come up, by depth. Shape (D, N)."""
        different, which = np.unique(self.goals, return_inverse=True)
        return reaching(table, different, depth)[:, self.starts, which]

    def images(self, world: Named, row: int) -> list[Shown]:
        """The start and the goal of a question."""
        return [("start", world.states[self.starts[row]]), ("goal", world.states[self.goals[row]])]


@dataclass(frozen=True, kw_only=True)
class ShortestPlans(_OfGoals):
    """How many macro-actions does the best plan need until the goal's frame has probably come up?"""

    name: ClassVar[str] = "shortest plan"
    options: Ints  #: numbers of macro-actions

    def answer(self, table: TransitionTable) -> Floats:
        """The fewest after which the goal has come up with a probability of at least one half."""
        reached = self.reached(table, int(self.options.max()))
        return normalised((fewest(reached)[:, None] == self.options).astype(np.float64))

    def words(self, world: Named, row: int) -> list[Words]:
        """The number is to be chosen."""
        text = "How many macro-actions, the best ones, does it take until the goal has probably come up?"
        return [Words(text, self.images(world, row), list(map(str, self.options[row])))]


@dataclass(frozen=True, kw_only=True)
class Reachability(_OfGoals):
    """Has the goal's frame come up within k macro-actions, the best ones?"""

    name: ClassVar[str] = "reachability"
    within: Ints  #: k of each. Shape (N,).
    options: Ints  #: YES and NO

    def answer(self, table: TransitionTable) -> Floats:
        """The best policy's probability, and the rest to 1."""
        reached = self.reached(table, int(self.within.max()))
        return _yes_or_no(reached[self.within - 1, np.arange(len(self.within))], self.options)

    def words(self, world: Named, row: int) -> list[Words]:
        """Yes or no."""
        text = f"Does the goal come up within {self.within[row]} macro-actions, if they are the best ones?"
        return [Words(text, self.images(world, row), yes_and_no(self.options[row]))]


def _yes_or_no(yes: Floats, options: Ints) -> Floats:
    return np.where(options == YES, yes[:, None], 1.0 - yes[:, None])


# Streams -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _OfStream:
    """Transitions of which some rule is to be told. The possible rules are equally likely beforehand."""

    shown: Transitions  #: shapes (N, L)
    options: Ints

    def by_rule(self, *likelihoods: Floats) -> Floats:
        """Bayes' rule for the likelihoods (N,) of the stream by each rule, in the order of the options' numbers."""
        return normalised(np.take_along_axis(np.stack(likelihoods, axis=1), self.options, axis=1))


@dataclass(frozen=True, kw_only=True)
class TwoWorlds(_OfStream):
    """Does the stream come from the usual world (NO), or from one in which macro-actions slip (YES)?"""

    name: ClassVar[str] = "which of two worlds"

    def answer(self, table: TransitionTable) -> Floats:
        """By Bayes' rule."""
        worlds = [likelihood(table, self.shown, world).prod(axis=1) for world in (usual, with_slips)]
        return self.by_rule(*worlds)

    def words(self, world: Named, row: int) -> list[Words]:
        """The world is to be chosen."""
        slips = f"the world in which a macro-action does nothing with probability {SLIP}"
        answers = [slips if option == YES else "the usual world" for option in self.options[row]]
        text = f"{_OF_STREAM} Which world are they from?"
        return [Words(text, world.of_stream(self.shown, row), answers)]


@dataclass(frozen=True, kw_only=True)
class ChangedRule(_OfStream):
    """After how many transitions was one macro-action coupled with another? After L: not at all."""

    name: ClassVar[str] = "changed rule"
    pair: tuple[int, int]  #: the macro-action that changes, and the one whose effect it then has too

    def answer(self, table: TransitionTable) -> Floats:
        """By Bayes' rule."""
        before = likelihood(table, self.shown)
        after = likelihood(table, self.shown, with_coupling(*self.pair))
        changes = range(STREAM + 1)
        return self.by_rule(*(before[:, :at].prod(axis=1) * after[:, at:].prod(axis=1) for at in changes))

    def words(self, world: Named, row: int) -> list[Words]:
        """The moment is to be chosen."""
        one, other = (world.actions[action] for action in self.pair)
        text = f"From some moment on “{one}” also has the effect of “{other}”. After how many of them?"
        answers = ["never" if option == STREAM else str(option) for option in self.options[row]]
        return [Words(f"{_OF_STREAM} {text}", world.of_stream(self.shown, row), answers)]


@dataclass(frozen=True, kw_only=True)
class LuckAlone(_OfStream):
    """In a world that slips: is all of it luck (YES), or was one macro-action, any, another than the named one (NO)?"""

    name: ClassVar[str] = "luck alone"

    def answer(self, table: TransitionTable) -> Floats:
        """By Bayes' rule."""
        luck = likelihood(table, self.shown, with_slips)
        meddled = likelihood(table, self.shown, other_action)
        once = [meddled[:, at] * np.delete(luck, at, axis=1).prod(axis=1) for at in range(STREAM)]
        return self.by_rule(np.mean(once, axis=0), luck.prod(axis=1))

    def words(self, world: Named, row: int) -> list[Words]:
        """Yes or no."""
        luck = f"Each does nothing with probability {SLIP}. Does that explain all of them (yes), or was one in truth"
        text = f"{_OF_STREAM} {luck} another macro-action (no)?"
        return [Words(text, world.of_stream(self.shown, row), yes_and_no(self.options[row]))]


# Single causes -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SingleCausePairs:
    """P pairs of starts that differ in one cause, and one macro-action: which macrostate follows each of them?

    Wrong answers leave a factor as it is that must change, or change one that must not.
    """

    name: ClassVar[str] = "single-cause pairs"
    shown: Transitions  #: results are not shown. Shapes (P, 2).
    causes: tuple[str, ...]  #: of each pair. Length P.
    options: Ints  #: rows of T. Shape (P, 2, C).

    def answer(self, table: TransitionTable) -> Floats:
        """The probability of each option, given that it is one of them. Shape (P, 2, C)."""
        return normalised(np.take_along_axis(usual(table, self.shown), self.options, axis=2))

    def words(self, world: Named, row: int) -> list[Words]:
        """One question for each of the two starts."""
        action = world.actions[self.shown.actions[row, 0]]
        text = f"Two starts differ only in the {self.causes[row]}. What follows “{action}” from the"
        members = zip(("first", "second"), self.shown.states[row], self.options[row], strict=True)
        return [
            Words(f"{text} {which} one?", [("start", world.states[start])], answer_images=world.chosen(mine))
            for which, start, mine in members
        ]


@dataclass(frozen=True, kw_only=True)
class FactorsChanged:
    """The same pairs: is a factor of the outcome another one because of the cause?

    It must be if its two distributions share no value, and must not be if they are equal. Else it may be, and the
    probability is the total variation of the two: the least share of luck in which the values differ.
    """

    name: ClassVar[str] = "must it change"
    pairs: SingleCausePairs
    rows: Ints  #: the pair of each question. Shape (N,).
    factors: Ints  #: shape (N,)
    coordinates: Ints  #: of the T macrostates. Shape (T, M).
    options: Ints  #: YES and NO

    def answer(self, table: TransitionTable) -> Floats:
        """The total variation, and the rest to 1."""
        return _yes_or_no(self.distances(table), self.options)

    def words(self, world: Named, row: int) -> list[Words]:
        """Yes or no."""
        pair = self.rows[row]
        one, other = world.chosen(self.pairs.shown.states[pair])
        action = world.actions[self.pairs.shown.actions[pair, 0]]
        factor = world.factors[self.factors[row]]
        cause = self.pairs.causes[pair]
        text = f"Two starts differ only in the {cause}. After “{action}”: does the {factor} differ?"
        return [Words(text, [("one start", one), ("other", other)], yes_and_no(self.options[row]))]

    def distances(self, table: TransitionTable) -> Floats:
        """Total variation of the two distributions of each question's factor. Shape (N,)."""
        laws = usual(table, self.pairs.shown)  # [P, 2, T + 1]
        differ = (laws[:, 0] - laws[:, 1])[self.rows]
        found = np.abs(differ[:, -1])
        for factor in np.unique(self.factors):
            rows = self.factors == factor
            for value in np.unique(self.coordinates[:, factor]):
                with_it = self.coordinates[:, factor] == value
                found[rows] += np.abs(differ[rows][:, :-1] @ with_it)
        return 0.5 * found
