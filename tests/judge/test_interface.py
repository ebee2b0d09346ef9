"""The answers of a model are checked, and a fault is one sentence that names model and method."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from fake_reader import BlindReader
from imagine_bench.agents.world_models.limits import Exact
from judged import JudgedWorld, judged_world, shown

from imagine_bench import registry
from imagine_bench.arrays import Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Frame, State
from imagine_bench.interfaces.episodes import joined
from imagine_bench.interfaces.model import Imagined, require_imagined, weights_of
from imagine_bench.judge import questions
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


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pictures": GOOD.pictures[:2]}, "gave pictures of shape (2, 4, 2, 8, 8, 3); give (3, 4, 2, H, W)"),
        ({"pictures": GOOD.pictures[:, :3], "probabilities": None, "rewards": None, "p_ended": None}, "of shape (3, 3"),
        ({"pictures": np.full((*SHAPE, 8, 8), 2.0)}, "give uint8, or floats from 0 to 1"),
        ({"pictures": "a picture"}, "gave pictures of str"),
        ({"rewards": np.full(SHAPE, np.nan)}, "gave rewards with NaN"),
        ({"probabilities": np.full(SHAPE, 0.2)}, "sum to 0.8 over S; they must sum to 1"),
        ({"probabilities": np.full(SHAPE, -0.25)}, "probabilities outside of [0, 1]"),
        ({"accepted": np.zeros((3, 2))}, "accepted of float64; give an array of bool"),
        ({"epistemic": np.zeros(3)}, "gave epistemic of shape (3,); give (3, 2)"),
    ],
)
def test_what_is_wrong_is_one_sentence(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError) as found:
        check(**changes)
    assert str(found.value).startswith("World model theirs: imagine() gave") and words in str(found.value)


class Records(Exact):
    """The exact model, which keeps its questions."""

    def __init__(self, world: JudgedWorld) -> None:
        super().__init__(world.spec, world.index)
        self.batches: list[list[State]] = []

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        found = super().imagine(frames, actions, samples, rng)
        self.batches.append([tuple(shown(frame, judged_world(TASK).spec).tolist()) for frame in frames[:, -1]])
        frames[...] = 0
        actions[...] = 0
        return found


TASK = "pick_place"


def test_no_start_is_asked_about_twice_while_another_is_not_at_all() -> None:
    rules = registry.task("arrow_puzzle").rules
    for count in (len(rules.start_states) // 2, len(rules.start_states)):
        found = questions.some_starts(rules, count, np.random.default_rng(0))
        assert len(set(found)) == count and set(found) <= set(rules.start_states)


def test_questions_come_shuffled_and_each_answer_is_put_back() -> None:
    world = judged_world(TASK)
    after = questions.after_the_end(world.spec, world.index.render)
    assert after is not None
    sets = {"one_step": world.one_step, "rollouts": world.rollouts, "after": after}

    def answered(order: int | None) -> tuple[dict[str, Predictions], list[list[State]]]:
        model = Records(world)
        given: dict[str, Any] = {"samples": 2, "reader": BlindReader(4), "index": world.index}

        def ask(asked: EvalSet, name: str) -> Predictions:
            drawn = None if order is None else np.random.default_rng(order)
            return evaluate(model, name, asked, rng=np.random.default_rng(0), order=drawn, **given)

        return ask_together(ask, sets), model.batches

    (plain, in_order), (one, shuffled), (again, repeated), (other, otherwise) = map(answered, (None, 0, 0, 1))
    assert in_order != shuffled == repeated != otherwise
    for name, answers in plain.items():
        for each in (one, again, other):
            assert np.array_equal(answers.states, each[name].states) and len(answers.states) == len(sets[name].states)
            assert np.array_equal(answers.weights, each[name].weights)
            assert all(np.array_equal(array, each[name].offered[key]) for key, array in answers.offered.items())
    over = [world.spec.rules.is_terminal(state) for state in shuffled[0]]
    assert any(over) and not all(over), "a batch does not tell that it is about frames after an end"


def test_the_first_transitions_are_the_same_ones() -> None:
    def episode(length: int) -> dict[str, Any]:
        frames = np.zeros((length + 1, 64, 64, 3), dtype=np.uint8)
        frames[:, 0, 0] = np.arange(length + 1)[:, None] + [0, length, 0]
        ends = [False] * (length - 1) + [True]
        known = {"actions": [0] * length, "rewards": [float(length)] * length, "truncated": [False] * length}
        masks = np.ones((length + 1, 2), dtype=np.int8)
        return {**known, "frames": frames, "action_masks": masks, "terminated": ends, "success": True}

    whole = joined([episode(length) for length in (2, 3, 4)])
    for count in range(1, 10):
        part = whole.first(count)
        before = part.rows[0]
        every = whole.rows[0][:count]
        assert len(part.actions) == count and np.array_equal(part.rewards, whole.rewards[:count])
        assert np.array_equal(part.frames[before], whole.frames[every])
        assert np.array_equal(part.frames[before + 1], whole.frames[every + 1])
        assert np.array_equal(part.terminated, whole.terminated[:count])
    assert whole.first(9).hash == whole.hash
    assert whole.first(4).truncated.tolist() == [False, False, False, True]
    assert whole.first(4).success.tolist() == [True, False]
    with pytest.raises(InvalidValueError, match="10 transitions of 9"):
        whole.first(10)
