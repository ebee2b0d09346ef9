"""The two ends of the scale score what enumeration says they must, and a planted mistake is charged exactly."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fake_reader import BlindReader
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.interfaces import Frame, Rules, State, TaskSpec
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge.models.asking import FRAMES, Answers, after_the_end, ask, one_step, ranked, rollouts
from imagine_bench.judge.models.ends import Copy, Exact, Gallery
from imagine_bench.judge.models.scores import after_the_end as scores_after_the_end
from imagine_bench.judge.models.scores import by_depth, filter_scores, one_step_scores, ranking_scores
from imagine_bench.judge.models.truth import Questions

ERRORS = (
    "total_variation", "missed", "invented", "nothing", "outcome_ece", "outcome_brier", "reward_error", "end_error",
    "end_ece", "end_brier", "reward_ece", "reward_brier", "value_loss", "worst_value_loss",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Asked:
    spec: TaskSpec
    gallery: Gallery
    one_step: Questions
    rollouts: Questions
    ranked: Questions

    def answers(self, model: WorldModel, questions: Questions) -> Answers:
        reader = BlindReader(len(self.spec.macrostate_names))
        rng = np.random.default_rng(0)
        return ask(model, "it", questions, samples=2, reader=reader, gallery=self.gallery, rng=rng)

    def scores(self, model: WorldModel) -> dict[str, Any]:
        found = one_step_scores(self.spec, self.one_step, self.answers(model, self.one_step), set())
        return found | ranking_scores(self.spec, self.ranked, self.answers(model, self.ranked))


@functools.cache
def asked(task: str) -> Asked:
    spec = registry.task(task)
    gallery = Gallery(spec, "clean")
    return Asked(spec, gallery, one_step(spec, gallery), rollouts(spec, gallery), ranked(spec, gallery))


@pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])
def test_exact_is_without_any_error(task: str) -> None:
    world = asked(task)
    model = Exact(world.spec, world.gallery)
    scores = world.scores(model)
    assert {name: scores[name] for name in ERRORS} == pytest.approx(dict.fromkeys(ERRORS, 0.0), abs=1e-12)
    assert scores["regret"] == 0.0 and scores["worth_of_refusing"] == 0.0
    assert math.isnan(scores["auroc_wrong"]) and math.isnan(scores["best_skill"])  # there is no error to find
    deep = by_depth(world.rollouts, world.answers(model, world.rollouts))
    assert deep["tv_by_depth"] == pytest.approx([0.0] * 10, abs=1e-12)


def test_some_of_the_truth_is_random() -> None:
    assert any(len(outcomes) > 2 for steps in asked("pick_place").rollouts.truth for outcomes in steps)


def reached(rules: Rules, start: State, actions: list[int]) -> dict[State, float]:
    """The distribution after actions, one path after another."""
    if not actions:
        return {start: 1.0}
    found: dict[State, float] = {}
    for outcome in rules.outcomes(start, actions[0]):
        for state, share in reached(rules, outcome.macrostate, actions[1:]).items():
            found[state] = found.get(state, 0.0) + outcome.probability * share
    return found


def best(rules: Rules, state: State, left: int, choose: Callable[[State], list[int]]) -> float:
    """The expected return of the best of the actions that may be chosen, by recursion."""
    if not left:
        return 0.0
    return max(
        sum(
            o.probability * (o.reward + (0.0 if o.terminated else best(rules, o.macrostate, left - 1, choose)))
            for o in rules.outcomes(state, action)
        )
        for action in choose(state)
    )


@pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])
def test_copy_scores_what_enumeration_says(task: str) -> None:
    world = asked(task)
    rules = world.spec.rules
    scores = world.scores(Copy())
    alive = [state for state in rules.states if not rules.is_terminal(state)]
    stays = [reached(rules, state, [action]).get(state, 0.0) for state in alive for action in range(rules.n_actions)]
    assert scores["total_variation"] == pytest.approx(1.0 - np.mean(stays))
    assert math.isnan(scores["reward_error"]) and math.isnan(scores["auroc_wrong"])
    deep = by_depth(world.rollouts, world.answers(Copy(), world.rollouts))["tv_by_depth"]
    pairs = list(zip(world.rollouts.states, world.rollouts.asked.tolist(), strict=True))
    for depth in (1, 2, 5):
        away = [1.0 - reached(rules, state, actions[:depth]).get(state, 0.0) for state, actions in pairs]
        assert deep[depth - 1] == pytest.approx(np.mean(away))


def test_copy_loses_what_always_doing_the_same_loses() -> None:
    world = asked("arrow_puzzle")
    rules = world.spec.rules
    every = list(range(rules.n_actions))
    losses = [
        best(rules, state, 5, lambda _: every) - best(rules, state, 5, lambda _: [0]) for state in rules.start_states
    ]
    short = dataclasses.replace(world.spec, horizon=5)
    found = one_step_scores(short, world.one_step, world.answers(Copy(), world.one_step), set())
    assert found["value_loss"] == pytest.approx(np.mean(losses))
    assert found["worst_value_loss"] == pytest.approx(max(losses))
    assert found["value_loss_by_start"] == pytest.approx(losses)


def test_after_the_end_is_what_no_training_contains() -> None:
    world = asked("arrow_puzzle")
    questions = after_the_end(world.spec, world.gallery)
    assert questions is not None and len(questions.states) == 200
    rules = world.spec.rules
    assert all(rules.is_terminal(state) for state in questions.states)
    assert not set(questions.states) & set(world.one_step.states)
    for state, steps in zip(questions.states, questions.truth, strict=True):
        ((after, _),) = steps[0]
        assert sum(a != b for a, b in zip(state, after, strict=True)) == 1, "a macro-action still turns a cube"
    exact, still = Exact(world.spec, world.gallery), Copy()
    found = [
        scores_after_the_end(questions, world.answers(model, questions), world.answers(model, world.one_step))
        for model in (exact, still)
    ]
    assert [each["after_the_end"] for each in found] == [0.0, 1.0]
    assert found[0]["auroc_after_the_end"] == 0.5 and math.isnan(found[1]["auroc_after_the_end"])
    assert math.isnan(scores_after_the_end(None, None, world.answers(still, world.one_step))["after_the_end"])


class Mistaken(Exact):
    """Exact, but for some transitions, of which it says that nothing changes; it is unsure of those alone."""

    def __init__(self, world: Asked, wrong: set[tuple[State, int]]) -> None:
        super().__init__(world.spec, world.gallery)
        self.wrong = wrong

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        right, still = super().imagine(frames, actions, samples, rng), Copy().imagine(frames, actions, samples, rng)
        shown = [self.gallery.shows(frame) for frame in frames[:, -1]]
        wrong = np.array([pair in self.wrong for pair in zip(shown, actions[:, 0].tolist(), strict=True)])
        pictures = np.where(wrong[:, None, None, None, None, None], still.pictures, right.pictures)
        return dataclasses.replace(right, pictures=pictures, epistemic=np.where(wrong[:, None], 1.0, right.epistemic))


def test_known_mistakes_are_charged_exactly() -> None:
    world = asked("arrow_puzzle")
    pairs = list(dict.fromkeys(zip(world.one_step.states, world.one_step.asked[:, 0].tolist(), strict=True)))
    wrong = {pairs[index] for index in (3, 50, 171, 300)}
    scores = world.scores(Mistaken(world, wrong))
    share = len(wrong) / len(pairs)
    for name in ("total_variation", "missed", "invented", "outcome_ece"):
        assert scores[name] == pytest.approx(share)
    assert scores["outcome_brier"] == pytest.approx(2 * share)
    charged = {pairs[row // FRAMES] for row, away in enumerate(scores["by_question"]) if away}
    assert charged == wrong == {pairs[row // FRAMES] for row in scores["worst"][: FRAMES * len(wrong)]}
    assert (
        scores["auroc_wrong"] == scores["best_skill"] == 1.0
        and scores["risk"][0] == 0.0
        and scores["risk"][-1] == pytest.approx(share)
    )
    assert 0.0 < scores["where"]["coordinate"]["left arrow"] < share
    assert scores["where"]["coordinate"]["pointed cube"] == 0.0
    assert math.isnan(scores["filter_keeps"]) and math.isnan(scores["worth_of_filter"])  # it offers no filter


class Filtered(Mistaken):
    """Its filter discards what it has wrong."""

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        found = super().imagine(frames, actions, samples, rng)
        assert found.epistemic is not None
        return dataclasses.replace(found, accepted=found.epistemic < 0.5)


def test_a_filter_is_worth_what_its_mistakes_would_cost() -> None:
    world = asked("arrow_puzzle")
    rules = world.spec.rules
    goals = {
        (state, action)
        for state, action in zip(world.one_step.states, world.one_step.asked[:, 0].tolist(), strict=True)
        if any(o.terminated and not o.success for o in rules.outcomes(state, action))
    }
    scores = world.scores(Filtered(world, set(sorted(goals)[::3])))
    assert scores["filter_skill"] == scores["best_skill"] == 1.0 and scores["filter_error"] == 0.0
    assert scores["filter_keeps"] == pytest.approx(1.0 - scores["total_variation"])
    assert scores["worth_of_filter"] <= scores["value_loss"] + 1e-9


def test_skill_is_what_is_discarded_rightly_less_what_wrongly() -> None:
    away = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
    epistemic = np.array([[0.9], [0.3], [0.5], [0.1], [0.1]])
    found = filter_scores(epistemic, epistemic <= 0.4, away)
    assert found["filter_keeps"] == pytest.approx(3 / 5) and found["filter_error"] == pytest.approx(1 / 3)
    assert found["filter_skill"] == pytest.approx(1 / 2 - 1 / 3)
    assert found["best_skill"] == pytest.approx(1 - 1 / 3)  # between 0.1 and 0.3
    assert filter_scores(-epistemic, None, away)["best_skill"] == 0.0  # to discard nothing
    assert math.isnan(filter_scores(epistemic, None, np.zeros(5))["best_skill"])


def test_rewards_are_judged_as_outcomes() -> None:
    world = asked("pick_place")

    class Greedy(Exact):
        def imagine(self, *given: Any) -> Imagined:
            found = super().imagine(*given)
            return dataclasses.replace(found, rewards=np.full(found.pictures.shape[:3], 4.9))

    scores = world.scores(Greedy(world.spec, world.gallery))
    wrong = [not any(reward == 5.0 for _, reward in steps[0].values()) for steps in world.one_step.truth]
    assert scores["reward_ece"] == pytest.approx(np.mean(wrong))
    assert scores["reward_brier"] == pytest.approx(2.0 * np.mean(wrong))
