"""Answers to questions about a whole world are those of brute force; nothing but the world tells them."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from judged import STILL, judged_world, labelled

from imagine_bench.arrays import Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.exact.changed_rules import slipping
from imagine_bench.interfaces import State
from imagine_bench.interfaces.model import LearnedGraph, require_graph
from imagine_bench.judge.predictions import transition_table
from imagine_bench.judge.questions import about_whole_world
from imagine_bench.judge.worlds.families import (
    STREAM,
    YES,
    ChangedRule,
    FactorsChanged,
    LuckAlone,
    MaskedFrames,
    Reachability,
    ShortestPlans,
    SingleCausePairs,
    TwoWorlds,
)
from imagine_bench.judge.worlds.graph import edges_of_rules, hamming_distance
from imagine_bench.judge.worlds.making import LOOK, QUERIES, WorldQuestions, world_questions
from imagine_bench.judge.worlds.scores import GRAPH, MARGIN, graph_scores, scores_right, world_scores
from imagine_bench.judge.worlds.tables import Transitions, TransitionTable, likelihood
from imagine_bench.judge.worlds.words import NO, Named, Words
from imagine_bench.report.worlds import worlds_section
from imagine_bench.rules import Dynamics, Rules, states_of_play

SLIPS = "arrows:cubes=2,slip=0.2"
TASKS = pytest.mark.parametrize("task", [SLIPS, "pick_place"])
Law = Mapping[State, float]


@functools.cache
def asked_of(task: str, seed: int = 0) -> WorldQuestions:
    spec = labelled(task)
    return world_questions(spec, states_of_play(spec.rules), 2, np.random.default_rng(seed), frames_vary=True)


class ByHand:
    """The same answers from the rules' own outcomes, one question at a time."""

    def __init__(self, task: str) -> None:
        self.rules: Rules = labelled(task).rules
        self.asked = asked_of(task)
        self.names = self.asked.states
        self.alive = set(states_of_play(self.rules))
        self.slips = slipping(self.rules)

    def law(self, state: State, action: int, dynamics: Dynamics | None = None) -> Law:
        found = Counter[State]()
        for each in (dynamics or self.rules.outcomes)(state, action):
            found[each.macrostate] += each.probability  # type: ignore[assignment]
        return found

    def masked_frame(self, of: MaskedFrames, row: int) -> list[float]:
        first = self.law(self.names[of.first.states[row]], int(of.first.actions[row]))
        then, last = int(of.actions[row]), self.names[of.reached[row]]
        middles = [self.names[each] for each in of.options[row]]
        return [first[middle] * self.law(middle, then)[last] for middle in middles]

    def best_chance(self, state: State, goal: State, left: int) -> float:
        if left == 0 or state not in self.alive:
            return 0.0
        return max(
            sum(p * (1.0 if s == goal else self.best_chance(s, goal, left - 1)) for s, p in self.law(state, a).items())
            for a in range(self.rules.n_actions)
        )

    def shortest_plan(self, of: ShortestPlans, row: int) -> list[float]:
        pair = self.names[of.starts[row]], self.names[of.goals[row]]
        enough = next((n for n in (1, 2, 3) if self.best_chance(*pair, n) >= 0.5), None)
        assert enough or of.options[row].max() > 3
        return [float(option == enough) for option in of.options[row]] if enough else []

    def yes(self, chance: float, options: Ints) -> list[float]:
        return [chance if option == YES else 1.0 - chance for option in options]

    def reachability(self, of: Reachability, row: int) -> list[float]:
        if of.within[row] > 3:
            return []
        chance = self.best_chance(self.names[of.starts[row]], self.names[of.goals[row]], int(of.within[row]))
        return self.yes(chance, of.options[row])

    def steps(self, of: TwoWorlds | ChangedRule | LuckAlone, row: int) -> list[tuple[State, int, State]]:
        found = zip(of.shown.states[row], of.shown.actions[row], of.shown.reached[row], strict=True)
        return [(self.names[s], int(a), self.names[r]) for s, a, r in found]

    def which_of_two_worlds(self, of: TwoWorlds, row: int) -> list[float]:
        worlds = [
            math.prod(self.law(s, a, world)[r] for s, a, r in self.steps(of, row)) for world in (None, self.slips)
        ]
        return [worlds[option] for option in of.options[row]]

    def luck_alone(self, of: LuckAlone, row: int) -> list[float]:
        steps = self.steps(of, row)
        luck = [self.law(s, a, self.slips)[r] for s, a, r in steps]
        others = range(self.rules.n_actions)
        meddled = [np.mean([self.law(s, b)[r] for b in others if b != a]) for s, a, r in steps]
        once = [meddled[i] * math.prod(luck[:i] + luck[i + 1 :]) for i in range(len(steps))]
        return [math.prod(luck) if option == YES else float(np.mean(once)) for option in of.options[row]]

    def changed_rule(self, of: ChangedRule, row: int) -> list[float]:
        one, other = of.pair
        before, after = [], []
        for state, action, reached in self.steps(of, row):
            usual = self.law(state, action)
            both = [p * (self.law(s, other)[reached] if s in self.alive else s == reached) for s, p in usual.items()]
            before.append(usual[reached])
            after.append(sum(both) if action == one else before[-1])
        return [math.prod(before[:n] + after[n:]) for n in of.options[row]]

    def single_cause_pairs(self, of: SingleCausePairs, row: int) -> list[float]:
        law = self.law(self.names[of.shown.states[row, 1]], int(of.shown.actions[row, 1]))
        return [law[self.names[option]] for option in of.options[row, 1]]

    def must_it_change(self, of: FactorsChanged, row: int) -> list[float]:
        shown, values = of.pairs.shown, (Counter[int](), Counter[int]())
        for member, start in zip(values, shown.states[of.rows[row]], strict=True):
            for state, p in self.law(self.names[start], int(shown.actions[of.rows[row], 0])).items():
                member[state[of.factors[row]]] += p  # type: ignore[assignment]
        one, other = values
        return self.yes(0.5 * sum(abs(one[value] - other[value]) for value in {*one, *other}), of.options[row])


@pytest.mark.parametrize("task", [SLIPS, "pick_place", "arrows:cubes=3"])
def test_half_of_the_factors_change(task: str) -> None:
    asked = asked_of(task)
    (family,) = (each for each in asked.families if isinstance(each, FactorsChanged))
    changed = family.distances(asked.truth) >= 0.5
    assert (changed.sum(), (~changed).sum()) == (QUERIES // 2, QUERIES // 2)


class Reader:
    """A person who knows the rules, and of a question only its words and images."""

    def __init__(self, named: Named) -> None:
        self.named = named

    def quoted(self, words: Words) -> list[int]:
        """The macro-actions that the text names, in its order."""
        return [self.named.actions.index(name) for name in re.findall("“(.*?)”", words.text)]

    def rows(self, states: Sequence[State]) -> Ints:
        return np.array([self.named.states.index(state) for state in states])

    def understand(self, family: str, words: Words, other: Words) -> SimpleNamespace:
        """The question as a family of one; ``other`` is of the second member of a pair."""
        answers = list(words.answers)
        shown = [(title, state) for title, state in words.images if state is not None]
        rows = self.rows([state for _, state in shown])
        options = self.rows(words.answer_images)
        if set(answers) == {"yes", "no"}:
            options = np.array([YES if answer == "yes" else NO for answer in answers])
        elif family == "which of two worlds":
            options = np.array([NO if answer == "the usual world" else YES for answer in answers])
        elif answers:
            options = np.array([STREAM if answer == "never" else int(answer) for answer in answers])
        found = SimpleNamespace(options=options[None], starts=rows[:1], goals=rows[1:])
        actions = self.quoted(words)
        if family == "masked frame":
            assert [title for title, _ in words.images][1:] == [
                f"{n}. {self.named.actions[action]}" for n, action in enumerate(actions, 1)
            ]
            first = SimpleNamespace(states=rows[:1], actions=actions[:1])
            return SimpleNamespace(**vars(found), first=first, actions=actions[1:], reached=rows[1:])
        if family == "reachability":
            return SimpleNamespace(**vars(found), within=[int(*re.findall("within ([0-9]+)", words.text))])
        if len(rows) == 2 * STREAM:
            taken = [self.named.actions.index(title.removeprefix("after: ")) for title, _ in shown[1::2]]
            steps = SimpleNamespace(states=rows[None, ::2], actions=np.array([taken]), reached=rows[None, 1::2])
            return SimpleNamespace(**vars(found), shown=steps, pair=actions)
        if family == "single-cause pairs":
            found.options = np.stack([options, self.rows(other.answer_images)])[None]
            rows = np.append(rows, self.rows([state for _, state in other.images if state is not None]))
        if len(actions) == 1:
            pair = SimpleNamespace(states=rows[None], actions=np.array([actions + self.quoted(other)]))
            factors = [self.named.factors.index(name) for name in re.findall("does the (.*) differ", words.text)]
            pairs = SimpleNamespace(shown=pair)
            return SimpleNamespace(**vars(found), shown=pair, pairs=pairs, rows=[0], factors=factors)
        return found


@TASKS
def test_every_family_is_answered_as_by_brute_force(task: str) -> None:
    """By what it asks for in numbers, and by what its words ask for."""
    by_hand = ByHand(task)
    reader = Reader(by_hand.asked.named)
    seen = set()
    for family in by_hand.asked.families:
        answers = family.answer(by_hand.asked.truth)
        answers = answers[:, 1] if answers.ndim == 3 else answers  # of the second members of pairs
        count: Callable[..., list[float]] = getattr(by_hand, family.name.replace(" ", "_").replace("-", "_"))
        for row in range(0, len(answers), 8):
            words = family.words(by_hand.asked.named, row)
            for asked in ((family, row), (reader.understand(family.name, words[0], words[-1]), 0)):
                expected = np.array(count(*asked))
                if len(expected):
                    seen.add(family.name)
                    np.testing.assert_allclose(answers[row], expected / expected.sum(), atol=1e-12, err_msg=family.name)
    assert len(seen) == 8


@pytest.mark.parametrize("task", ["arrow_puzzle", SLIPS, "pick_place", "arrow_puzzle_easy", "arrows:cubes=4"])
def test_a_thousand_questions_cost_less_than_ten_cpu_seconds(task: str) -> None:
    begun_s = time.process_time()
    asked = asked_of(task, 1)
    scores = world_scores(asked, asked.truth)
    assert sum(math.prod(family.options.shape[:-1]) for family in asked.families) >= 1_000
    assert time.process_time() - begun_s < 10.0
    assert all(each["right"] == each["exact"] for each in scores.values())


@TASKS
def test_the_position_of_an_answer_tells_nothing(task: str) -> None:
    asked = asked_of(task)
    for family, again in zip(asked.families, asked_of(task, 1).families, strict=True):
        exact = family.answer(asked.truth)
        exact = exact.reshape(-1, exact.shape[-1])
        share = 1.0 / exact.shape[1]
        spread = 5.0 * math.sqrt(share * (1.0 - share) / len(exact))
        assert np.abs(exact.mean(axis=0) - share).max() < spread, family.name
        assert not np.array_equal(family.options, again.options), "another generator, another order"
        assert all(len({*options}) == len(options) for options in family.options.reshape(exact.shape).tolist())
        np.testing.assert_allclose(exact.sum(axis=1), 1.0)
    repeated = world_questions(
        labelled(task), asked.states[: len(asked.truth.mean)], 2, np.random.default_rng(0), frames_vary=True
    )
    for family, again in zip(asked.families, repeated.families, strict=True):
        np.testing.assert_array_equal(family.options, again.options)


def test_chance_and_exact_are_what_enumeration_says() -> None:
    """Outcomes are drawn anew: the rules' choice is right as often as its probability says."""
    asked = asked_of(SLIPS)
    (masked,) = (each for each in asked.families if isinstance(each, MaskedFrames))
    exact = masked.answer(asked.truth)
    hidden = masked.options == masked.first.reached[:, None]
    right = scores_right(hidden.astype(float), exact).mean()
    sure = scores_right(exact, exact)
    assert abs(right - sure.mean()) < 4.0 * math.sqrt((sure * (1.0 - sure)).sum()) / len(sure) + 1e-12
    assert sure.mean() < 1.0
    assert scores_right(exact, np.full_like(exact, 0.25)).mean() == pytest.approx(0.25)


@pytest.mark.parametrize("task", ["arrows:cubes=2", SLIPS, "pick_place"])
def test_models_answer_through_their_one_step_predictions(task: str) -> None:
    there = judged_world(task)
    whole = about_whole_world(there.spec, there.one_step)
    scores = {}
    for name, model in (("exact", there.exact), ("copy", STILL)):
        table = transition_table(there.one_step, there.predictions(model, there.one_step), whole.states)
        scores[name] = world_scores(whole, table)
        for family, score in scores[name].items():
            assert score["right"] == pytest.approx(score[name]), family
    assert all(each.get("brier", 0.0) == pytest.approx(0.0) for each in scores["exact"].values())
    above = {family for family, each in scores["copy"].items() if each["copy"] > each["chance"] + MARGIN}
    assert above == ({"must it change"} if task != "pick_place" else set()), "a family that copying answers"


def test_a_perfect_sampler_nearly_answers_as_the_rules_do() -> None:
    asked = asked_of(SLIPS)
    exact = asked.truth.by_frame
    drawn = np.random.default_rng(0).multinomial(64, exact) / 64
    table = TransitionTable(by_frame=drawn, drawn=np.full(exact.shape[:3], 64))
    scores = world_scores(asked, table)
    columns = np.arange(exact.shape[3])
    one = Transitions(states=0 * columns, actions=0 * columns, frames=0 * columns, reached=columns)
    assert likelihood(table, one).min() > 0.0 == likelihood(asked.truth, one).min(), "not drawn is not impossible"
    assert likelihood(table, one).sum() == pytest.approx(1.0)
    assert all(each["right"] > each["exact"] - 0.1 for each in scores.values())


@TASKS
def test_members_of_a_pair_differ_in_one_cause_and_both_must_be_right(task: str) -> None:
    asked = asked_of(task)
    names = labelled(task).macrostate_names
    (pairs,) = (each for each in asked.families if isinstance(each, SingleCausePairs))
    states = np.array(asked.states)[pairs.shown.states]
    for cause, (one, other) in zip(pairs.causes, states, strict=True):
        assert [name for name, a, b in zip(names, one, other, strict=True) if a != b] == [cause] * (cause != LOOK)
    assert (pairs.shown.frames[np.array(pairs.causes) == LOOK] == [0, 1]).all()
    half_blind = asked.truth.by_frame.copy()
    half_blind[:, :, 1] = np.roll(half_blind[:, :, 1], 1, axis=-1)  # wrong in every second frame
    scores = world_scores(asked, dataclasses.replace(asked.truth, by_frame=half_blind))
    assert scores["only the look"]["right"] < 0.2 < scores["only the look"]["exact"]


def test_a_family_that_copying_answers_is_marked_and_each_graph_counted() -> None:
    def cell(right: float, **graph: dict[str, float]) -> dict[str, Any]:
        plan = {"right": right, "copy": 0.53, "chance": 0.5, "exact": 0.9}
        return {"worlds": {"shortest plan": plan, "only the look": {**plan, "copy": 0.51}, **graph}}

    learned = {GRAPH: {"edges_wrong": 3.0, "edges": 7.0}}
    cells = {"exact": [cell(0.9)], "mine": [cell(right, **learned) for right in (0.4, 0.5, 0.6, 1.0)]}
    section = worlds_section({**cells, "theirs": [cell(0.2)], "older": [{}]}, {"mine": "my model", "theirs": "theirs"})
    (table,) = section.tables  # type: ignore[union-attr]
    assert [table.header, *table.rows] == [
        ["family", "chance", "copy", "exact", "my model", "theirs"],
        ["shortest plan *", "50.0", "53.0", "90.0", "55.0", "20.0"],
        ["  only the look", "50.0", "51.0", "90.0", "55.0", "20.0"],
        ["factor graph: wrong edges", "–", "7", "0", "3", "–"],
    ]


def test_the_hamming_distance_counts_edges_under_any_names() -> None:
    rules = labelled("pick_place").rules
    edges = edges_of_rules(rules)
    states = np.array(states_of_play(rules))
    order = [2, 0, 3, 1]
    renamed = 7 - 2 * states[:, order]
    learned = LearnedGraph(values=renamed, edges=edges[:, order][:, :, order])
    assert edges.any() and hamming_distance(learned, edges, states) == 0
    other = learned.edges.copy()
    other[0, 0, 0] ^= True
    assert hamming_distance(dataclasses.replace(learned, edges=other), edges, states) == 1
    nothing = dataclasses.replace(learned, edges=np.zeros_like(edges))
    assert hamming_distance(nothing, edges, states) == edges.sum()
    assert graph_scores(nothing, edges, states)[GRAPH] == {"edges_wrong": edges.sum(), "edges": edges.sum()}
    wide = np.zeros((len(edges), 5, 5), dtype=bool)
    wide[:, :4, :4] = learned.edges
    wide[1, 4, 4] = True  # a factor that shows nothing of the macrostate
    more = LearnedGraph(values=np.column_stack([renamed, np.ones(len(states), dtype=np.int64)]), edges=wide)
    assert hamming_distance(more, edges, states) == 1
    blank = LearnedGraph(values=np.ones((8 * len(states), 1), dtype=np.int64), edges=np.ones((len(edges), 1, 1), bool))
    assert hamming_distance(blank, edges, np.repeat(states, 8, axis=0)) == edges.sum() + len(edges), "no coordinate"
    assert require_graph(learned, name="it", rows=len(states), n_actions=rules.n_actions) is learned
    for wrong in (dataclasses.replace(learned, edges=wide), dataclasses.replace(learned, values=states[:3])):
        with pytest.raises(InvalidValueError, match=r"World model it: factor_graph\(\) gave .*; give "):
            require_graph(wrong, name="it", rows=len(states), n_actions=rules.n_actions)
