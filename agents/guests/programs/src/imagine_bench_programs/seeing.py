"""Codes that the perception of the agent ``factored`` learns from the writer's own images, with no encoder.

The perception looks for factors in the images that were seen, again and again while the writer explores. Whenever it
finds others, all transitions so far get their new codes, and the writer begins again with these.

A value of a factor may say that the image hides the factor, as where the human points only once. There are two ways to
find it. It has contradictions: the same codes and macro-action have different outcomes, and hardly any do once the
value last seen stands in its place. Or the factor never changes once that stands there, and the laws become shorter by
more than it takes to say which images hide it. A factor of one value, and one that hides it, says nothing: the
one value stands in all of its codes. In the end a factor is left out that drifts and on which no law depends: such as
a shadow that the perception took for a thing. Nor does such a factor count when new factors are compared with those
before.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from imagine_bench_factored.perception import FrameFactors, LearnedPerception
from imagine_bench_factored.settings import LearnedPerceptionSettings
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, State, TaskSpec
from imagine_bench.rules import states_of

from .writing.delay import CodedRow, complete
from .writing.laws import Laws, simplest
from .writing.writer import Writer

_GROWTH = 1.1
_GROWTH_IF_KNOWN = 2.0
"""Factors are looked for again after so many times the images of the last time: if an image showed something that has
no known value, and if none did."""
_IMAGES = 3
"""New images of each macrostate that say which code it has."""
_CLEARER = 0.2
"""A hidden value leaves less than this share of the contradictions; so do former factors that are kept."""


class SeeingWriter:
    """A writer that sees images, through a perception that it learns.

    Args:
        spec: The task.
        appearance: How images vary, such as ``clean``.
        rng: Draws how each image looks.
        choices: Chooses among macro-actions that are equally good.
    """

    def __init__(self, spec: TaskSpec, appearance: str, rng: np.random.Generator, choices: np.random.Generator) -> None:
        self._spec = spec
        self._appearance = appearance
        self._rng = rng
        settings = LearnedPerceptionSettings(growth=_GROWTH, growth_if_known=_GROWTH_IF_KNOWN)
        self.perception = LearnedPerception(settings, factored=True)
        self.writer = Writer(self.perception.sizes, spec.n_actions, choices)
        self._hidden: Hidden | None = None
        self._images: list[Frame] = []
        self._codes: dict[int, State] = {}
        """The present codes of images, by their number."""
        self._rows: list[CodedRow] = []
        """Transitions between numbers of images."""

    def see(self, macrostate: State) -> State:
        """The number of a new image of a macrostate, whose hidden coordinates are -1."""
        self._images.append(self._drawn([macrostate])[0])
        return (len(self._images) - 1,)

    def explore(self, number: State) -> int:
        """The macro-action with which it explores from an image."""
        code = self._code(number[0])
        if self._hidden is not None:
            begins = not self.writer.rows or self._rows[-1].then != number
            code = self._hidden.fill(code, None if begins else self.writer.rows[-1].then)
        return self.writer.explore(code)

    def learn(self, row: CodedRow) -> None:
        """Take in a transition between images."""
        before, after = (self._images[number] for (number,) in (row.now, row.then))
        self._rows.append(row)
        coded = self._coded(self._rows[-1 - row.step :])[-1]
        frame_factors = self._perceived()
        if not self.perception.full:
            self.perception.remember(before, row.action, after, begins=row.step == 0)
            if self.perception.renew():
                self._begin_again(frame_factors)
                return
        self.writer.learn(coded)

    def begin_episode(self) -> None:
        """Forget the macro-actions so far."""
        self.writer.begin_episode()

    def write(self) -> None:
        """Look for factors a last time, and find the laws of all transitions."""
        frame_factors = self._perceived()
        if not self.perception.full:
            self.perception.look(len(self.perception.frames))
        self._begin_again(frame_factors)
        self._leave_out(self.writer.laws.superfluous)

    def codes(self) -> SeenCodes:
        """The codes that macrostates have by the present perception, each in new images."""
        found = {}
        for state in states_of(self._spec.rules):
            codes = self.perception.codes(self._drawn([state] * _IMAGES)).values
            found[state] = Counter(codes if self._hidden is None else (self._hidden.fill(code, None) for code in codes))
        return SeenCodes(found)

    def _drawn(self, macrostates: Sequence[State]) -> Frame:
        """An image of each of N macrostates. Shape (N, 64, 64, 3)."""
        return self._spec.render_macrostates(np.array(macrostates, dtype=np.int64), self._appearance, self._rng)

    def _perceived(self) -> tuple[FrameFactors, int, Sequence[int]]:
        """The present factors, in how many images they were found, and their numbers of values."""
        return self.perception.frame_factors, self.perception.found_in, self.perception.sizes

    def _begin_again(self, before: tuple[FrameFactors, int, Sequence[int]]) -> None:
        """Give all transitions their present codes, and write anew.

        The factors of before are kept if by them far fewer transitions contradict one another.
        """
        frame_factors, found_in, sizes = before
        kept = self._codes
        known = self._explained(sizes)
        codes = self.perception.codes(np.stack(self._images)).values
        self._codes = dict(enumerate(codes))
        found = self._explained(self.perception.sizes)
        if frame_factors.factors and self._is_clearer(known[1], found[1]):
            self.perception.take(frame_factors, found_in)
            self._codes = kept
            found = known
        self._hidden, rows = found
        self.writer.take_up(self.perception.sizes, rows)

    def _is_clearer(self, known: Sequence[CodedRow], found: Sequence[CodedRow]) -> bool:
        """Whether by the factors before far fewer transitions contradict one another than by those found now.

        Factors found now that drift, and on which no law depends, contradict nothing.
        """
        if _contradicting(known) >= _CLEARER * _contradicting(found):
            return False
        laws = Laws(self.perception.sizes, self._spec.n_actions, found)
        left = [place for place in range(len(laws.sizes)) if place not in laws.superfluous]
        if not left or len(left) == len(laws.sizes):
            return True
        return _contradicting(known) < _CLEARER * _contradicting([row.at(left) for row in found])

    def _leave_out(self, superfluous: Collection[int]) -> None:
        """See these factors no more, and write anew; all of them are seen if no other one would be left."""
        frame_factors = self.perception.frame_factors
        left = [place for place in range(len(frame_factors.factors)) if place not in superfluous]
        if not left or len(left) == len(frame_factors.factors):
            return
        factors = [frame_factors.factors[place] for place in left]
        self.perception.take(frame_factors._replace(factors=factors), self.perception.found_in)
        self._codes = {number: tuple(code[place] for place in left) for number, code in self._codes.items()}
        self._hidden, rows = self._explained(self.perception.sizes)
        self.writer.take_up(self.perception.sizes, rows)

    def _explained(self, sizes: Sequence[int]) -> tuple[Hidden | None, list[CodedRow]]:
        """The value of all codes that hides a factor, and the transitions in which the value last seen stands there."""
        self._hidden = None
        rows = self._coded(self._rows)
        hidden = hidden_value(rows, sizes) or still_value(rows, sizes, self._spec.n_actions)
        return hidden, rows if hidden is None else hidden.filled(rows)

    def _code(self, number: int) -> State:
        """The present code of an image."""
        if number not in self._codes:
            self._codes[number] = self.perception.code(self._images[number])  # which keeps it for `remember`
        return self._codes[number]

    def _coded(self, rows: Sequence[CodedRow]) -> list[CodedRow]:
        """Transitions between images as transitions between codes; the first one begins an episode."""
        coded = [row._replace(now=self._code(row.now[0]), then=self._code(row.then[0])) for row in rows]
        return coded if self._hidden is None else self._hidden.filled(coded)


class Hidden(NamedTuple):
    """A value of a factor with which an image says nothing about the factor."""

    factor: int
    value: int
    #: the only other value, if there is but one, -1 else: such a factor says nothing in any image
    only: int = -1

    def fill(self, code: State, before: State | None) -> State:
        """A code with the value that the factor had in the code before; without one, the only other value, or -1."""
        if code[self.factor] != self.value:
            return code
        last = self.only if before is None else before[self.factor]
        return (*code[: self.factor], last, *code[self.factor + 1 :])

    def filled(self, rows: Sequence[CodedRow]) -> list[CodedRow]:
        """Transitions with values filled in; the first one begins an episode."""
        found: list[CodedRow] = []
        for row in rows:
            now = self.fill(row.now, found[-1].then if row.step else None)
            found.append(row._replace(now=now, then=self.fill(row.then, now)))
        return found

    def nats(self, rows: Sequence[CodedRow]) -> float:
        """The length of saying in which images it stands, the first ones of episodes and the later ones apart."""
        first = [row.now[self.factor] == self.value for row in rows if not row.step]
        later = [row.then[self.factor] == self.value for row in rows]
        return sum(simplest(sum(stands), len(stands) - sum(stands))[1] for stands in (first, later))


def hidden_value(rows: Sequence[CodedRow], sizes: Sequence[int]) -> Hidden | None:
    """The value that leaves the fewest contradictions where the value last seen stands in its place, if there is one.

    The first transition begins an episode.
    """
    without = _contradicting(rows)
    left: dict[Hidden, float] = {}
    for each in _hiding(range(len(sizes)), sizes) if without else ():
        filled = each.filled(rows)
        if 2 * len(complete(filled)) > len(rows):  # else too much is left out to tell
            left[each] = _contradicting(filled)
    best = min(left, key=left.__getitem__, default=None)
    return best if best is not None and left[best] < _CLEARER * without else None


def _hiding(factors: Iterable[int], sizes: Sequence[int]) -> list[Hidden]:
    """The values of some factors that may say that an image hides the factor."""
    pairs = [(factor, value) for factor in factors for value in range(sizes[factor]) if sizes[factor] > 1]
    return [Hidden(factor, value, only=1 - value if sizes[factor] == 2 else -1) for factor, value in pairs]


def still_value(rows: Sequence[CodedRow], sizes: Sequence[int], n_actions: int) -> Hidden | None:
    """The value without which its factor never changes, if laws without these changes are shorter.

    The first transition begins an episode.
    """
    changed = [factor for factor in range(len(sizes)) if any(row.now[factor] != row.then[factor] for row in rows)]
    best = None
    nats = Laws(sizes, n_actions, rows).nats if changed else 0.0
    for each in _hiding(changed, sizes):
        filled = complete(each.filled(rows))
        if 2 * len(filled) <= len(rows) or any(row.now[each.factor] != row.then[each.factor] for row in filled):
            continue
        of_all = len(rows) / len(filled)  # those that are left out are no shorter than the others
        other = Laws(sizes, n_actions, each.filled(rows)).nats * of_all + each.nats(rows)
        if other < nats:
            best, nats = each, other
    return best


def _contradicting(rows: Sequence[CodedRow]) -> float:
    """Share of the complete transitions that had another result than the first of the same code and macro-action."""
    known = complete(rows)
    first = {(row.now, row.action): row for row in reversed(known)}
    other = sum(first[row.now, row.action][2:5] != row[2:5] for row in known)
    return other / len(known) if known else math.inf


class SeenCodes:
    """Codes of macrostates, from how many images of each macrostate have which code.

    A macrostate has the code of most of its images. A code is read as the macrostate of which most images have it.
    """

    def __init__(self, found: Mapping[State, Counter[State]]) -> None:
        self._code = {state: codes.most_common(1)[0][0] for state, codes in found.items()}
        times: defaultdict[State, Counter[State]] = defaultdict(Counter)
        for state, codes in found.items():
            for code, count in codes.items():
                times[code][state] += count
        self._state = {code: states.most_common(1)[0][0] for code, states in times.items()}
        self._none = (-1,) * len(next(iter(found)))
        """The reading of a code that no image has."""

    def of(self, macrostate: State) -> State:
        """The code of a macrostate."""
        return self._code[macrostate]

    def macrostates(self, codes: Sequence[State]) -> NDArray[np.int64]:
        """The macrostates of N codes, -1 everywhere for a code that no image has. Shape (N, M)."""
        return np.array([self._state.get(code, self._none) for code in codes], dtype=np.int64)
