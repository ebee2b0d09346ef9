"""The answers of a model are checked, and a fault is one sentence that names model and method."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_fakes import RulesImaginer
from fake_reader import BlindReader
from judged import Altered, asked_pairs, judged_world
from same_values import assert_same
from small_runs import context

from imagine_bench import registry
from imagine_bench.arrays import Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Frame, State
from imagine_bench.interfaces.capabilities import ImaginedRollout, planned_actions
from imagine_bench.interfaces.episodes import Episodes, joined
from imagine_bench.interfaces.model import Imagined, require_imagined, until_the_end, weights_of
from imagine_bench.judge import questions
from imagine_bench.judge.models import AgentModel
from imagine_bench.judge.predictions import Predictions, ask_together, evaluate
from imagine_bench.judge.questions import EvalSet

SHAPE = (3, 4, 2)
GOOD = Imagined(
    pictures=np.zeros((*SHAPE, 8, 8, 3), dtype=np.uint8),
    probabilities=np.full(SHAPE, 0.25),
    rewards=np.zeros(SHAPE),
    p_ended=np.zeros(SHAPE),
    epistemic=np.zeros((3, 2)),
)


def check(**changes: Any) -> Imagined:
    return require_imagined(dataclasses.replace(GOOD, **changes), name="theirs", rows=3, depth=2, samples=4)


def test_what_is_right_is_taken_as_it_is() -> None:
    assert np.array_equal(weights_of(check(probabilities=None)), np.full(SHAPE, 0.25))
    assert check(pictures=np.ones((*SHAPE, 20, 30), dtype=np.float32)).pictures.shape[3:] == (20, 30)


def test_what_is_wrong_is_one_sentence() -> None:
    wrong: tuple[tuple[str, dict[str, Any]], ...] = (
        ("gave pictures of shape (2, 4, 2, 8, 8, 3); give (3, 4, 2, H, W)", {"pictures": GOOD.pictures[:2]}),
        ("of shape (3, 3", {"pictures": GOOD.pictures[:, :3], "probabilities": None, "rewards": None, "p_ended": None}),
        ("give uint8, or floats from 0 to 1", {"pictures": np.full((*SHAPE, 8, 8), 2.0)}),
        ("gave pictures of str", {"pictures": "a picture"}),
        ("give uint8, or floats from 0 to 1", {"pictures": np.full((*SHAPE, 8, 8), -0.5)}),
        ("gave pictures of int64; give uint8", {"pictures": np.zeros((*SHAPE, 8, 8), dtype=np.int64)}),
        ("gave rewards with NaN", {"rewards": np.full(SHAPE, np.nan)}),
        ("gave epistemic with NaN or infinity", {"epistemic": np.full((3, 2), np.inf)}),
        ("gave p_ended outside of [0, 1]", {"p_ended": np.full(SHAPE, 1.5)}),
        ("sum to 0.8 over S; they must sum to 1", {"probabilities": np.full(SHAPE, 0.2)}),
        ("probabilities outside of [0, 1]", {"probabilities": np.full(SHAPE, -0.25)}),
        ("accepted of float64; give an array of bool", {"accepted": np.zeros((3, 2))}),
        ("gave epistemic of shape (3,); give (3, 2)", {"epistemic": np.zeros(3)}),
    )
    for words, changes in wrong:
        with pytest.raises(InvalidValueError, match=rf"^World model theirs: imagine\(\) .*{re.escape(words)}"):
            check(**changes)


def test_after_an_end_nothing_is_earned() -> None:
    rewards, ends = np.random.default_rng(0).random((2, 2, 3, 4))
    counted, p_ended = until_the_end(rewards, ends)
    for place in np.ndindex(2, 3):
        goes_on = 1.0
        for step in range(4):
            assert counted[place][step] == pytest.approx(goes_on * rewards[place][step])
            goes_on *= 1.0 - ends[place][step]
            assert p_ended[place][step] == pytest.approx(1.0 - goes_on)


def test_questions_to_an_imaginer_are_as_deep_as_asked() -> None:
    assert planned_actions(np.array([0, 4, 1]), 2, 5) == [0, 4]
    assert planned_actions(None, 2, 5) is None
    for actions, depth in ((None, 0), ([], 2), ([0, 5], 2), ([-1], 2)):
        with pytest.raises(InvalidValueError, match=r"give at least one|must lie in \[0, 5\)"):
            planned_actions(None if actions is None else np.array(actions), depth, 5)


def test_no_start_is_asked_about_twice_while_another_is_not_at_all() -> None:
    rules = registry.task("arrow_puzzle").rules
    for count in (len(rules.start_states) // 2, len(rules.start_states)):
        found = questions.some_starts(rules, count, np.random.default_rng(0))
        assert len(set(found)) == count and set(found) <= set(rules.start_states)


def test_questions_come_shuffled_and_each_answer_is_put_back() -> None:
    world = judged_world("pick_place")
    after = questions.after_the_end(world.spec, world.index.render)
    assert after is not None
    sets = {"one_step": world.one_step, "rollouts": world.rollouts, "after": after}
    batches: list[list[State]] = []
    imagined: list[int] = []

    def noted(found: Imagined, frames: Frame, actions: Ints) -> Imagined:
        """The model keeps its questions, and spoils them."""
        batches.append([state for state, _ in asked_pairs(world, frames, actions)])
        frames[...] = 0
        actions[...] = 0
        imagined.append(math.prod(found.pictures.shape[:3]))
        return found

    def answered(order: int | None) -> tuple[dict[str, Predictions], list[list[State]]]:
        batches.clear()
        clock_s = map(float, itertools.count())  # a second a batch
        given: dict[str, Any] = {"samples": 2, "reader": BlindReader(4), "index": world.index}
        given["cpu_clock"] = lambda: next(clock_s)

        def ask(asked: EvalSet, name: str) -> Predictions:
            drawn = None if order is None else np.random.default_rng(order)
            return evaluate(Altered(world, noted), name, asked, rng=np.random.default_rng(0), order=drawn, **given)

        return ask_together(ask, sets), [*batches]

    (first, _), steps = answered(None), sum(imagined)
    assert sum(each.steps for each in first.values()) == pytest.approx(steps, abs=1)
    assert sum(each.cpu_s for each in first.values()) == pytest.approx(len(batches))
    (plain, in_order), (one, shuffled), (again, repeated), (other, otherwise) = map(answered, (None, 0, 0, 1))
    assert in_order != shuffled == repeated != otherwise
    for name, answers in plain.items():
        assert len(answers.states) == len(sets[name].states)
        for each in (one, again, other):
            for field in ("states", "weights", "offered"):
                assert_same(getattr(answers, field), getattr(each[name], field))
    over = [world.spec.rules.is_terminal(state) for state in shuffled[0]]
    assert any(over) and not all(over), "a batch does not tell that it is about frames after an end"


def test_an_agents_rollouts_are_the_futures_of_a_world_model() -> None:
    """From the latest of three frames, by the two actions behind those between; each ends it with probability 0.1."""
    luck: list[float] = []

    def imagine(frame: Frame, *, rng: np.random.Generator, **asked: Any) -> ImaginedRollout:
        """Its frame, rewards that number actions, and a filter that keeps the first in half and the second in less."""
        rollout = RulesImaginer(context()).imagine(frame, rng=rng, **asked)
        kept = np.array([2, 1]) > len(luck) % 4
        luck.append(rng.random())
        images = np.full((2, 64, 64), frame[0, 0, 0] / 255)
        told = {"rewards": 1.0 * rollout.actions, "epistemic": np.full(2, luck[-1]), "aleatoric": np.zeros(2)}
        return dataclasses.replace(rollout, frames=images, accepted=kept, **told)

    frames = np.arange(6, dtype=np.uint8).reshape(2, 3, 1, 1, 1).repeat(64, 2).repeat(64, 3).repeat(3, 4)
    agent: Any = SimpleNamespace(imagine=imagine)
    asked = np.array([[5, 5, 1, 2], [4, 4, 3, 0]])
    found = vars(AgentModel(agent).imagine(frames, asked, 4, np.random.default_rng(0)))
    assert (found["pictures"].mean(axis=(3, 4)).T == [2, 5]).all() and len(set(luck)) == 8
    for row, rewards in enumerate(([1.0, 1.8], [3.0, 0.0])):
        assert found["rewards"][row] == pytest.approx(np.tile(rewards, (4, 1)))
        assert found["accepted"][row].tolist() == [True, False]
        assert found["epistemic"][row] == pytest.approx([np.mean(luck[4 * row : 4 * row + 4])] * 2)
    assert found["aleatoric"] is None, "an uncertainty that is 0 everywhere is not offered"


def test_the_first_transitions_are_the_same_ones() -> None:
    def episode(length: int) -> dict[str, Any]:
        frames = np.zeros((length + 1, 64, 64, 3), dtype=np.uint8)
        frames[:, 0, 0, 0] = np.arange(length + 1) + 10 * length
        ends = [False] * (length - 1) + [True]
        cut = [end and length > 2 for end in ends]  # at the time limit, too
        known = {"actions": [0] * length, "rewards": [float(length)] * length, "truncated": cut}
        masks = np.ones((length + 1, 2), dtype=np.int8)
        return {**known, "frames": frames, "action_masks": masks, "terminated": ends, "success": length != 3}

    def transitions(of: Episodes) -> list[list[Any]]:
        """The frame before and after each, its reward and end."""
        rows = of.rows[0]
        return [*zip(of.frames[rows, 0, 0, 0], of.frames[rows + 1, 0, 0, 0], of.rewards, of.terminated, strict=True)]

    whole = joined([episode(length) for length in (2, 3, 4)])
    for count in range(1, 10):
        part = whole.first(count)
        assert transitions(part) == transitions(whole)[:count]
        assert part.truncated.tolist() == [*whole.truncated[: count - 1], count != 2]
        assert part.success.tolist() == [count >= 2, False, count == 9][: len(part)], "lost where it is cut"
    assert whole.first(9).hash == whole.hash
    with pytest.raises(InvalidValueError, match="10 transitions of 9"):
        whole.first(10)
