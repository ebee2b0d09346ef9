"""Codes that an agent finds itself: factors that are kept or left out, and programs between such codes."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any
from unittest import mock

import numpy as np
import pytest
from imagine_bench_factored.perception import FrameCodes, FrameFactors, LearnedPerception
from imagine_bench_factored.seeing.appearance import SeenFactor
from imagine_bench_factored.seeing.standard import Standard
from imagine_bench_programs.__main__ import _explore, written
from imagine_bench_programs.scores import Codes, ReadRules, score
from imagine_bench_programs.seeing import Hidden, SeeingWriter, SeenCodes, hidden_value, still_value
from imagine_bench_programs.symbol_rules import SymbolRules
from imagine_bench_programs.writing.delay import CodedRow
from imagine_bench_programs.writing.writer import Writer
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.interfaces import Frame, Outcome, State, TaskSpec


def test_codes_are_read_by_most_images() -> None:
    codes = SeenCodes({(0,): Counter({(5,): 2, (6,): 1}), (1,): Counter({(6,): 3})})
    assert (codes.of((0,)), codes.of((1,))) == ((5,), (6,))
    np.testing.assert_array_equal(codes.macrostates([(6,), (5,), (7,)]), [[1], [0], [-1]])


class BytePerception(LearnedPerception):
    """Sees the first byte of a frame, or, once it has renewed its factors, only the half of it."""

    full = False
    found_in = 1
    sizes = (4,)

    def __init__(self, renews_at: int) -> None:
        self.frame_factors = FrameFactors([SeenFactor((), np.zeros((1, 0), dtype=np.int64))], Standard())
        self.fine = self.frame_factors
        self.left = renews_at

    def codes(self, frames: Frame) -> FrameCodes:
        values = frames[:, 0, 0, 0] // (1 if self.frame_factors is self.fine else 2)
        every = np.ones(len(frames), dtype=bool)
        return FrameCodes([(int(value),) for value in values], every[:, None], every)

    def code(self, frame: Frame) -> State:
        return self.codes(frame[None]).values[0]

    def remember(self, before: Frame, action: int, after: Frame, *, begins: bool = False) -> None:
        self.left -= 1

    def renew(self) -> bool:
        if self.left == 0:
            self.frame_factors = self.frame_factors._replace(standard=Standard())
        return self.left == 0

    def take(self, frame_factors: FrameFactors, found_in: int) -> None:
        self.frame_factors = frame_factors


def seeing(perception: LearnedPerception | None, rng: np.random.Generator) -> SeeingWriter:
    """One that sees by this, or by a new perception."""
    writer = SeeingWriter(registry.task("arrows:cubes=2"), "clean", rng, rng)
    if perception is not None:
        writer.perception = perception
        writer.writer.take_up(perception.sizes, [])
    return writer


@pytest.mark.parametrize(("unknown", "first"), [(True, 111), (False, 200)])
def test_unknown_values_bring_an_earlier_search_for_factors(unknown: bool, first: int) -> None:
    rng = np.random.default_rng(0)
    perception = seeing(None, rng).perception
    perception.looked_at = 100
    perception.unknown = unknown
    perception.frames = [np.zeros((64, 64, 3), dtype=np.uint8)] * 100
    with mock.patch.object(perception, "look") as look:
        while not perception.renew():
            perception.frames.append(perception.frames[0])
    assert look.call_args.args == (first,)


@pytest.mark.parametrize(("step", "keeps"), [(1, True), (2, False)])
def test_former_factors_are_kept_where_the_new_ones_contradict(step: int, keeps: bool) -> None:
    rng = np.random.default_rng(0)
    perception = BytePerception(renews_at=12)
    writer = seeing(perception, rng)
    for number in range(12):  # a dial of four values that turns by one or two
        for value in (number, number + step):
            writer._images.append(np.full((64, 64, 3), value % 4, dtype=np.uint8))
        writer.learn(CodedRow((2 * number,), 0, (2 * number + 1,), 0.0, False))
    assert (perception.frame_factors is perception.fine) == keeps
    values = (3, 0) if keeps else (1, 0)
    assert writer.writer.laws.turned(values[:1], 0) == values[1:]


class PixelPerception(LearnedPerception):
    """Sees of a frame the pixels that its factors name by the widths of their joint values."""

    full = True

    def __init__(self, sizes: Sequence[int]) -> None:
        factors = [SeenFactor((), np.zeros((size, place), dtype=np.int64)) for place, size in enumerate(sizes)]
        self._factored = True
        self.take(FrameFactors(factors, Standard()), 0)

    def codes(self, frames: Frame) -> FrameCodes:
        places = [factor.joint.shape[1] for factor in self.found]
        codes = [tuple(row) for row in frames[:, 0, places, 0].tolist()]
        known = np.ones((len(frames), len(places)), dtype=bool)
        return FrameCodes(codes, known, known.all(axis=1))

    def code(self, frame: Frame) -> State:
        return self.codes(frame[None]).values[0]


@pytest.mark.parametrize("matters", [False, True])
def test_a_factor_that_drifts_is_left_out_if_nothing_depends_on_it(matters: bool) -> None:
    rng = np.random.default_rng(0)
    writer = seeing(PixelPerception((3, 4)), rng)
    lights = rng.integers(3, size=81)
    for number in range(81):  # a light that flips by chance, and a dial that turns
        image = np.zeros((64, 64, 3), dtype=np.uint8)
        image[0, :2, 0] = lights[number], number % 4
        writer._images.append(image)
    for number in range(80):
        pays = number % 4 == 3 and (not matters or lights[number + 1] == 1)
        writer.learn(CodedRow((number,), 0, (number + 1,), float(pays), False, number % 4))
    assert writer.writer.laws.drifts.keys() == {0}
    writer.write()
    assert writer.writer.sizes == ((3, 4) if matters else (4,))
    assert writer.writer.laws.turned((1, 3) if matters else (3,), 0)[-1] == 0
    assert [len(row.now) for row in writer.writer.rows] == [len(writer.writer.sizes)] * 80


def test_a_superfluous_factor_is_no_reason_to_keep_those_before() -> None:
    rng = np.random.default_rng(0)
    perception = PixelPerception((3, 4, 2))
    every = perception.frame_factors
    perception.take(every._replace(factors=every.factors[1:2]), 0)
    perception.frames = []
    writer = seeing(perception, rng)
    for number in range(80):  # a light that flips by chance, a dial that turns, and a sign that few episodes have
        for step in range(2):
            image = np.zeros((64, 64, 3), dtype=np.uint8)
            image[0, :3, 0] = rng.integers(3), (number + step) % 4, number >= 64
            writer._images.append(image)
        pays = number % 4 == 3 and number >= 64
        writer.learn(CodedRow((2 * number,), 0, (2 * number + 1,), float(pays), False, number % 4))
    assert writer.writer.sizes == (4,)
    perception.full = False
    with mock.patch.object(perception, "look", lambda count: perception.take(every, count)):
        writer.write()
    assert writer.writer.sizes == (4, 2), "the light is left out, and the sign is new"


@pytest.mark.slow  # half a minute: a perception learns to see
def test_the_writer_is_exact_from_its_own_codes() -> None:
    found = written(registry.task("arrows:horizon=5,gesture=first"), 218, seed=1002, appearance="clean", own=True)
    assert found["total_variation"] < 0.005 and found["found"] == found["facts"]


class ShuffledCodes(Codes):
    """The codes of macrostates are here the macrostates with other names for the values of each coordinate."""

    def __init__(self, spec: TaskSpec, rng: np.random.Generator) -> None:
        self.sizes = [len(values) for values in spec.macrostate_values]
        self.symbols = self
        self._names = [rng.permutation(size) for size in self.sizes]

    def of(self, macrostate: State) -> State:
        return tuple(int(names[value]) for names, value in zip(self._names, macrostate, strict=True))

    def macrostates(self, codes: Sequence[State]) -> NDArray[np.int64]:
        return np.array([[int(np.argsort(n)[v]) for n, v in zip(self._names, code, strict=True)] for code in codes])


class ShuffledTruth(SymbolRules):
    def __init__(self, spec: TaskSpec, codes: ShuffledCodes) -> None:
        super().__init__(spec.n_actions)
        self.rules = spec.rules
        self.codes = codes

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        (true,) = self.codes.macrostates([macrostate]).tolist()
        outcomes = self.rules.outcomes(tuple(true), action)
        return tuple(dataclasses.replace(each, macrostate=self.codes.of(each.macrostate)) for each in outcomes)


def test_rules_between_codes_are_scored_as_a_probe_reads_them() -> None:
    spec = registry.task("arrows:cubes=2,slip=0.2")
    codes = ShuffledCodes(spec, np.random.default_rng(0))
    found = score(ReadRules(ShuffledTruth(spec, codes), codes), spec)
    assert (found.total_variation, found.ranking) == (0.0, 1.0) and found.found == found.facts > 0


class Attentive(Writer):
    """Notes before which of its transitions it is told that an episode begins, and that the first one does."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.begun = [0]

    def begin_episode(self) -> None:
        super().begin_episode()
        self.begun.append(len(self.rows))


@pytest.mark.parametrize("seed", [1003, 1005])
def test_a_program_of_codes_has_every_fact(seed: int) -> None:
    spec = registry.task("arrow_puzzle")
    starts, choices, names = (np.random.default_rng([seed, each]) for each in range(3))
    codes = ShuffledCodes(spec, names)
    writer = Attentive(codes.sizes, spec.n_actions, choices)
    _explore(writer, spec, 224, starts, codes.of)
    assert [each for each in writer.begun if each < 224] == [n for n, row in enumerate(writer.rows) if row.step == 0]
    found = score(ReadRules(writer.laws, codes), spec)
    assert (found.total_variation, found.found) == (0.0, found.facts)


def shown(values: Sequence[int | None], hidden: int, episodes: int = 20) -> list[CodedRow]:
    """A dial of three values, which the image hides where ``values`` says so, and a button that pays where it is 1."""
    rng = np.random.default_rng(5)
    rows = []
    for _ in range(episodes):
        dial = int(rng.integers(3))
        for step, (before, after) in enumerate(itertools.pairwise(values)):
            now, then = (hidden if each is None else dial for each in (before, after))
            rows.append(CodedRow((now, 0), 0, (then, 0), float(dial == 1), False, step))
    return rows


def test_a_value_that_hides_a_factor_is_found_by_its_contradictions() -> None:
    hidden = hidden_value(shown((1, None, 1, None), hidden=3), (4, 1))
    assert hidden is not None and hidden[:2] == (0, 3)
    filled = hidden.filled(shown((1, None, None), hidden=3))
    assert all(each.now == each.then and min(each.now) >= 0 for each in filled)
    assert hidden_value(shown((1, 1, 1), hidden=3), (4, 1)) is None, "nothing is hidden, and nothing contradicts"
    (first, *_) = Hidden(0, 3).filled(shown((None, 1, 1), hidden=3))
    assert first.now == (-1, 0), "nothing was seen before"


def dials(then: Sequence[int], later: Sequence[int]) -> list[CodedRow]:
    """Three episodes of two steps along a counter, none of which meets the counter's values of another one.

    Each episode has a dial, whose value after both steps is in ``then`` and ``later``; a counter of 8 pays where it is
    the dial's first value, and ends.
    """
    rows = []
    for dial, (middle, last) in enumerate(zip(then, later, strict=True)):
        count = 3 * dial
        rows.append(CodedRow((dial, count), 0, (middle, count + 1), 0.0, False, 0))
        rows.append(CodedRow((middle, count + 1), 0, (last, (count + 2) % 8), float(dial == 2), False, 1))
    return rows


def test_a_value_that_hides_a_factor_is_found_without_contradictions() -> None:
    rows = dials((3, 3, 3), (3, 3, 3))
    assert hidden_value(rows, (4, 8)) is None, "no code comes twice"
    assert still_value(rows, (4, 8), 1) == (0, 3, -1)
    assert still_value(dials((0, 1, 2), (0, 1, 2)), (4, 8), 1) is None, "nothing changes"
    assert still_value(dials((1, 2, 0), (2, 0, 1)), (4, 8), 1) is None, "a dial that turns is not hidden"


def test_transitions_that_are_left_out_make_an_explanation_no_shorter() -> None:
    """A macro-action turns a dial from 3 to 0; without 3 the dial never changes, and 40 noisy transitions are gone."""
    rng = np.random.default_rng(0)
    noise = rng.integers(8, size=(100, 2)).tolist()
    rows = [
        CodedRow((3 * turns, before), int(not turns), (0, after), 0.0, False)
        for turns, (before, after) in zip([True] * 40 + [False] * 60, noise, strict=True)
    ]
    filled = Hidden(0, 3).filled(rows)
    assert sum(min(*each.now, *each.then) >= 0 for each in filled) == 60
    assert still_value(rows, (4, 8), 2) is None


def test_a_light_that_flips_by_chance_is_not_hidden() -> None:
    rng = np.random.default_rng(0)
    lights = np.cumsum(rng.random(201) < 0.2) % 2
    rows = [
        CodedRow((int(now), step % 3), 0, (int(then), (step + 1) % 3), 0.0, False, step)
        for step, (now, then) in enumerate(itertools.pairwise(lights))
    ]
    assert not any(each.now[0] != each.then[0] for each in Hidden(0, 1).filled(rows)), "it would never change"
    assert still_value(rows, (2, 3), 1) is None, "to say which images hide it takes longer"


def test_a_factor_of_one_value_that_images_hide_says_nothing() -> None:
    rng = np.random.default_rng(0)
    hides = (rng.random(121) < 0.1).astype(int).tolist()
    rows = [
        CodedRow((before, step % 3), 0, (after, (step + 1) % 3), float(step == 1), False, step % 3)
        for step, (before, after) in enumerate(itertools.pairwise(hides))
    ]
    hidden = hidden_value(rows, (2, 3)) or still_value(rows, (2, 3), 1)
    assert hidden is not None and hidden.only == 1 - hidden.value
    starts = [each for each in hidden.filled(rows) if not each.step]
    assert {each.now[0] for each in starts} == {hidden.only}, "also in an image that is the first of an episode"
    assert any(each.now[0] == hidden.value for each in rows if not each.step), "some of them hide it"
