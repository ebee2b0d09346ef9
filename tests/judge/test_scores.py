"""The two ends of the scale have the scores of enumeration, and a planted mistake is charged exactly."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import pytest
from judged import STILL, Altered, JudgedWorld, asked_pairs, judged_world, shown

from imagine_bench.arrays import Ints
from imagine_bench.interfaces import Frame, Rules, State
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge import questions
from imagine_bench.judge.questions import FRAMES
from imagine_bench.judge.scores import (
    after_the_end_scores,
    by_depth,
    calibration_error,
    filter_scores,
    one_step_scores,
    ranking_scores,
)

ERRORS = (
    *("total_variation", "missed", "hallucinated", "unreadable", "outcome_ece", "outcome_brier", "reward_error"),
    *("reward_ece", "reward_brier", "end_error", "end_ece", "end_brier", "value_loss", "worst_value_loss", "unbiased"),
)
ARROWS, BOTH = "arrows:cubes=2", pytest.mark.parametrize("task", ["arrows:cubes=2", "pick_place"])


@BOTH
def test_exact_is_without_any_error(task: str) -> None:
    world = judged_world(task)
    scores = world.scores(world.exact)
    assert {name: scores[name] for name in ERRORS} == pytest.approx(dict.fromkeys(ERRORS, 0.0), abs=1e-12)
    assert scores["regret"] == scores["value_of_abstaining"] == 0.0
    assert math.isnan(scores["auroc_wrong"]) and math.isnan(scores["best_skill"])  # there is no error to find
    assert scores["perfect_sampler"] == scores["value_loss_ruled"] == 0.0
    if task == ARROWS:
        assert scores["regret_ruled"] == 0.0
    else:
        assert math.isnan(scores["regret_ruled"]), "of several images it does not say which follow which"
    for deep in by_depth(world.rollouts, world.predictions(world.exact, world.rollouts)).values():
        assert deep == pytest.approx([0.0] * 10, abs=1e-12)
    several = any(len(outcomes) > 2 for steps in world.rollouts.truth for outcomes in steps)
    assert several == (task == "pick_place"), "some of the truth is random"


def reached(rules: Rules, start: State, actions: list[int]) -> dict[State, float]:
    """The distribution after actions, one path after another."""
    if not actions:
        return {start: 1.0}
    found: dict[State, float] = {}
    for outcome in rules.outcomes(start, actions[0]):
        for state, share in reached(rules, outcome.macrostate, actions[1:]).items():
            found[state] = found.get(state, 0.0) + outcome.probability * share
    return found


@BOTH
def test_copy_scores_what_enumeration_says(task: str) -> None:
    world = judged_world(task)
    rules = world.spec.rules
    scores = world.scores(STILL)
    alive = [state for state in rules.states or () if not rules.is_terminal(state)]
    stays = [reached(rules, state, [action]).get(state, 0.0) for state in alive for action in range(rules.n_actions)]
    assert scores["total_variation"] == pytest.approx(1.0 - np.mean(stays))
    assert math.isnan(scores["reward_error"]) and math.isnan(scores["auroc_wrong"])
    deep = by_depth(world.rollouts, world.predictions(STILL, world.rollouts))["tv_by_depth"]
    for depth in (1, 4):
        pairs = zip(world.rollouts.states, world.rollouts.asked[:, :depth].tolist(), strict=True)
        away = [1.0 - reached(rules, state, actions).get(state, 0.0) for state, actions in pairs]
        assert deep[depth - 1] == pytest.approx(np.mean(away))


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


def losses(world: JudgedWorld, choose: Callable[[State], list[int]], horizon: int = 5) -> list[float]:
    """The value that a policy loses to the best one, for each start."""
    rules = world.spec.rules
    every = list(range(rules.n_actions))
    return [
        best(rules, start, horizon, lambda _: every) - best(rules, start, horizon, choose)
        for start in rules.start_states
    ]


def short(world: JudgedWorld, model: WorldModel) -> dict[str, Any]:
    """The scores of single transitions with a horizon of 5."""
    spec = dataclasses.replace(world.spec, horizon=5)
    return one_step_scores(spec, world.one_step, world.predictions(model, world.one_step), set())


def test_copy_loses_what_always_doing_the_same_loses() -> None:
    """It predicts no rewards: its own value loss is a dash, and by the rules' rewards all macro-actions are equal."""
    world = judged_world(ARROWS)
    found = short(world, STILL)
    assert found["value_loss_ruled"] == pytest.approx(np.mean(losses(world, lambda _: [0])))
    ranked = ranking_scores(world.spec, world.ranked, world.predictions(STILL, world.ranked))
    assert math.isnan(found["value_loss"]) and math.isnan(found["worst_value_loss"])
    assert math.isnan(ranked["regret"]), "so the first sequence of each start is taken"
    earned = []
    for state, actions in zip(world.ranked.states, world.ranked.asked.tolist(), strict=True):
        earned.append(earning(world.spec.rules, state, actions))
    of_starts = np.reshape(earned, (-1, questions.RANKED))
    assert ranked["regret_ruled"] == pytest.approx(np.mean(of_starts.max(axis=1) - of_starts[:, 0]))


def earning(rules: Rules, state: State, actions: list[int]) -> float:
    """The return of macro-actions that leave nothing to chance."""
    total = 0.0
    for action in actions:
        (outcome,) = rules.outcomes(state, action)
        total += outcome.reward
        if outcome.terminated:
            break
        state = outcome.macrostate
    return total


@pytest.mark.parametrize("task", [ARROWS, "arrows:cubes=2,slip=0.2", "pick_place"])
def test_rollouts_follow_a_real_history_and_end_as_seldom_as_may_be(task: str) -> None:
    world = judged_world(task)
    rules, asked = world.spec.rules, world.rollouts
    first, expected, spread = 0, 0.0, 0.0
    for frames, actions, state, steps in zip(asked.frames, asked.actions, asked.states, asked.truth, strict=True):
        history = [tuple(shown(frame, world.spec).tolist()) for frame in frames]
        assert len(history) == questions.HISTORY + 1 and history[-1] == state
        for (before, after), action in zip(itertools.pairwise(history), actions.tolist(), strict=False):
            outcomes = rules.outcomes(before, action)
            assert after in [each.macrostate for each in outcomes]
            first += after == outcomes[0].macrostate
            expected += outcomes[0].probability
            spread += outcomes[0].probability * (1.0 - outcomes[0].probability)
        assert task != ARROWS or not any(over for outcomes in steps for _, over in outcomes), "it can always go on"
    assert abs(first - expected) <= 4.0 * math.sqrt(spread), "chance decides as the rules say"


def test_after_the_end_is_what_no_training_contains() -> None:
    world = judged_world(ARROWS)
    rules = world.spec.rules
    asked = questions.after_the_end(world.spec, world.index.render)
    assert asked is not None and all(rules.is_terminal(state) for state in asked.states)
    assert not set(asked.states) & set(world.one_step.states)
    for state, steps in zip(asked.states, asked.truth, strict=True):
        ((after, _),) = steps[0]
        assert sum(a != b for a, b in zip(state, after, strict=True)) == 1, "a macro-action still turns a cube"
    exact, still = (
        after_the_end_scores(asked, world.predictions(model, asked), world.predictions(model, world.one_step))
        for model in (world.exact, STILL)
    )
    assert (exact["after_the_end"], still["after_the_end"]) == (0.0, 1.0)
    assert exact["auroc_after_the_end"] == 0.5 and math.isnan(still["auroc_after_the_end"])
    assert all(map(math.isnan, after_the_end_scores(None, None, world.predictions(STILL, world.one_step)).values()))

    def unsure(found: Imagined, frames: Frame, actions: Ints) -> Imagined:
        over = [[float(rules.is_terminal(state))] for state, _ in asked_pairs(world, frames, actions)]
        return dataclasses.replace(found, epistemic=np.array(over))

    there, before = (world.predictions(Altered(world, unsure), each) for each in (asked, world.one_step))
    assert after_the_end_scores(asked, there, before)["auroc_after_the_end"] == 1.0


def test_skill_is_what_is_discarded_rightly_less_what_wrongly() -> None:
    away = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
    epistemic = np.array([0.9, 0.3, 0.5, 0.1, 0.1])
    found = filter_scores(epistemic, epistemic <= 0.4, away)
    assert found["filter_keeps"] == pytest.approx(3 / 5) and found["filter_error"] == pytest.approx(1 / 3)
    assert found["filter_skill"] == pytest.approx(1 / 2 - 1 / 3)
    assert found["best_skill"] == pytest.approx(1 - 1 / 3)  # between 0.1 and 0.3
    assert filter_scores(-epistemic, None, away)["best_skill"] == 0.0  # to discard nothing
    assert math.isnan(filter_scores(epistemic, None, np.zeros(5))["best_skill"])


# Models with planted mistakes --------------------------------------------------------------------------------------


def changed(world: JudgedWorld, **changes: float | None) -> Altered:
    """Exact, but for the fields that are changed."""

    def alter(found: Imagined, *_: object) -> Imagined:
        shape = found.pictures.shape[:3]
        return dataclasses.replace(
            found, **{name: None if value is None else np.full(shape, value) for name, value in changes.items()}
        )

    return Altered(world, alter)


def test_a_model_that_expects_ends_everywhere_is_charged() -> None:
    """Its own probability of an end decides its plans: it takes the largest reward at once."""
    world = judged_world(ARROWS)
    rules = world.spec.rules

    def hasty(state: State) -> list[int]:
        rewards = [sum(o.probability * o.reward for o in rules.outcomes(state, a)) for a in range(rules.n_actions)]
        return [int(np.argmax(rewards))]

    found = short(world, changed(world, p_ended=1.0))
    lost = losses(world, hasty)
    assert found["value_loss_by_start"] == pytest.approx(lost)
    assert found["worst_value_loss"] == pytest.approx(max(lost))
    assert found["value_loss"] == pytest.approx(np.mean(lost)) and found["value_loss"] > 1.0
    assert found["value_loss_ruled"] == 0.0, "it imagines the right macrostates"


@pytest.mark.parametrize("left_out", ["rewards", "p_ended"])
def test_what_is_left_out_is_a_dash_and_the_rules_stand_in_beside_it(left_out: str) -> None:
    world = judged_world(ARROWS)
    scores = world.scores(changed(world, **{left_out: None}))
    assert math.isnan(scores["value_loss"]) and scores["value_loss_by_start"] == []
    assert math.isnan(scores["value_of_abstaining"])
    assert math.isnan(scores["regret"]) == (left_out == "rewards")
    assert scores["value_loss_ruled"] == scores["regret_ruled"] == 0.0


def giving(world: JudgedWorld, mistaken: float) -> Altered:
    """Says with probability ``mistaken`` that nothing happens, else what the rules allow."""

    def alter(found: Imagined, frames: Frame, _: Ints) -> Imagined:
        assert found.probabilities is not None
        still = np.broadcast_to(frames[:, None, -1:], (len(frames), 1, *found.pictures.shape[2:]))
        weights = np.insert(found.probabilities * (1.0 - mistaken), found.pictures.shape[1], mistaken, axis=1)
        return Imagined(pictures=np.concatenate([found.pictures, still], axis=1), probabilities=weights)

    return Altered(world, alter)


class Drawing:
    """Draws its futures from those that another model gives with their probabilities."""

    def __init__(self, given: WorldModel, seed: int) -> None:
        self.given = given
        self.rng = np.random.default_rng(seed)

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        held = self.given.imagine(frames, actions, 1, rng)
        upto = np.asarray(held.probabilities).cumsum(axis=1)[:, None]  # [N, 1, F, D]
        draws = self.rng.random((len(frames), samples, 1, upto.shape[3])) * upto[:, :, -1:]
        chosen = (draws >= upto).sum(axis=2)  # [N, S, D]
        rows, _, steps = np.ix_(*map(np.arange, chosen.shape))
        return Imagined(pictures=held.pictures[rows, chosen, steps])


@pytest.mark.parametrize("mistaken", [0.0, 0.3])
def test_drawing_and_probabilistic_models_are_comparable(mistaken: float) -> None:
    """Without bias: total variation tells them apart, the unbiased score does not."""
    world = judged_world("arrows:cubes=2,slip=0.2")
    whole = world.rollouts
    upto = whole.frames.shape[1] + 2
    asked = dataclasses.replace(whole, actions=whole.actions[:, :upto], truth=tuple(each[:3] for each in whole.truth))
    model = giving(world, mistaken)
    given = by_depth(asked, world.predictions(model, asked))
    drawing: Any = [by_depth(asked, world.predictions(Drawing(model, seed), asked, 8)) for seed in range(8)]
    mean = {name: np.mean([each[name] for each in drawing], axis=0) for name in given}
    assert mean["unbiased_by_depth"] == pytest.approx(given["unbiased_by_depth"], abs=0.01)
    assert min(mean["tv_by_depth"] - given["tv_by_depth"]) > 0.01
    assert given["perfect_by_depth"] == [0.0] * 3
    if not mistaken:
        assert mean["tv_by_depth"] == pytest.approx(mean["perfect_by_depth"], abs=0.01)
        assert given["tv_by_depth"] == pytest.approx([0.0] * 3, abs=1e-12)
        assert mean["perfect_by_depth"][0] == pytest.approx(0.117, abs=0.001)


def mistaken(world: JudgedWorld, wrong: Collection[tuple[State, int]]) -> Altered:
    """Says of some transitions that nothing comes; it is unsure of those alone."""

    def alter(right: Imagined, frames: Frame, actions: Ints) -> Imagined:
        missed = np.array([pair in wrong for pair in asked_pairs(world, frames, actions)])
        images = right.pictures.copy()
        images[missed] = frames[missed, -1][:, None, None]
        unsure = np.broadcast_to(missed[:, None], (len(frames), images.shape[2]))
        assert right.rewards is not None and right.p_ended is not None
        known = ~missed[:, None, None]
        return dataclasses.replace(
            right, pictures=images, rewards=right.rewards * known, p_ended=right.p_ended * known,
            epistemic=unsure.astype(np.float64), accepted=~unsure,
        )  # fmt: skip

    return Altered(world, alter)


def test_known_mistakes_are_charged_exactly() -> None:
    world = judged_world(ARROWS)
    pairs = list(dict.fromkeys(world.one_step.pairs))
    wrong = {pairs[index] for index in (3, 11, 20)}
    scores = world.scores(mistaken(world, wrong))
    share = len(wrong) / len(pairs)
    for name in ("total_variation", "missed", "hallucinated", "outcome_ece"):
        assert scores[name] == pytest.approx(share)
    assert scores["outcome_brier"] == scores["unbiased"] == pytest.approx(2 * share), "a mean over questions"
    assert wrong == {pairs[row // FRAMES] for row in scores["worst"][: FRAMES * len(wrong)]}
    assert scores["auroc_wrong"] == scores["best_skill"] == scores["filter_skill"] == 1.0
    rows, count = FRAMES * len(wrong), FRAMES * len(pairs)
    uncertain = [(k - count + rows) / k for k in range(count - rows + 1, count + 1)]
    assert scores["risk_coverage"] == pytest.approx(sum(uncertain) / count)
    assert (scores["filter_keeps"], scores["filter_error"]) == (pytest.approx(1.0 - share), 0.0)
    answers = world.predictions(mistaken(world, wrong), world.one_step)
    never = {pairs[index] for index in (3, 5)}  # it is unsure of the first of them alone, and of two that were seen
    some = one_step_scores(world.spec, world.one_step, answers, set(pairs) - never)
    others = len(pairs) - 4
    assert some["auroc_never"] == pytest.approx((others + 2 / 2 + others / 2) / (2 * (others + 2)))
    assert some["auroc_either"] == pytest.approx((3 + 1 / 2) / 4)
    unknown = one_step_scores(world.spec, world.one_step, answers, None)
    assert unknown["auroc_wrong"] == 1.0
    assert math.isnan(unknown["auroc_never"]) and math.isnan(unknown["auroc_either"]), "its data are not known"


def test_the_value_of_a_filter_is_the_cost_of_mistakes() -> None:
    """A model that expects nothing bad of breaking a rule; its filter discards just that."""
    world = judged_world(ARROWS)
    ends = {
        pair
        for pair in world.one_step.pairs
        if any(o.terminated and not o.success for o in world.spec.rules.outcomes(*pair))
    }
    scores = world.scores(mistaken(world, ends))
    assert scores["value_of_filter"] == pytest.approx(scores["value_loss"]) and scores["value_loss"] > 1.0
    assert scores["value_of_abstaining"] == pytest.approx(scores["value_of_filter"])

    few = set(sorted(ends)[: len(set(world.one_step.pairs)) // 20])  # what is best is next in its doubts
    best = {(state, world.spec.rules.optimal_action(state)) for state, _ in world.one_step.pairs}

    def doubtful(right: Imagined, frames: Frame, actions: Ints) -> Imagined:
        found = mistaken(world, few).alter(right, frames, actions)
        doubts = [2.0 * (pair in few) + (pair in best) for pair in asked_pairs(world, frames, actions)]
        assert found.epistemic is not None
        noise = np.random.default_rng(0).random(len(frames))
        return dataclasses.replace(found, epistemic=np.broadcast_to((doubts + noise)[:, None], found.epistemic.shape))

    scores = world.scores(Altered(world, doubtful))
    assert scores["value_of_abstaining"] > 0.9 * scores["value_loss"] > 0.0

    def half(right: Imagined, frames: Frame, actions: Ints) -> Imagined:
        """Its filter keeps the first frame of each macrostate."""
        found = mistaken(world, ends).alter(right, frames, actions)
        return dataclasses.replace(found, accepted=found.accepted | (np.arange(len(frames)) % FRAMES == 0)[:, None])

    assert world.scores(Altered(world, half))["value_of_filter"] == 0.0, "half of its frames keep a transition"


def test_probabilities_too_large_and_too_small_do_not_cancel() -> None:
    """Ten bins: 0.05 and 0.09 share the first, 0.15 and 0.95 have one each, and so has 1 with 0.95."""
    held = np.array([0.05, 0.09, 0.15, 0.95, 1.0])
    true = np.array([0.15, 0.01, 0.65, 0.35, 1.0])
    weights = np.array([1.0, 1.0, 2.0, 3.0, 3.0])
    expected = (abs(-0.10 + 0.08) + 2.0 * 0.50 + 3.0 * 0.60) / 10.0
    assert calibration_error(held, true, weights) == pytest.approx(expected)


def test_rewards_and_ends_are_judged_as_outcomes() -> None:
    world = judged_world("pick_place")
    scores = world.scores(changed(world, rewards=4.9, p_ended=0.75))
    outcomes = [steps[0] for steps in world.one_step.truth]
    wrong = [not any(reward == 5.0 for _, reward in each.values()) for each in outcomes]
    ended = np.array([sum(share for (_, over), (share, _) in each.items() if over) for each in outcomes])
    assert scores["end_error"] == pytest.approx(np.mean(np.abs(0.75 - ended)))
    assert scores["end_brier"] == pytest.approx(np.mean((0.75 - ended) ** 2))
    assert scores["end_ece"] == pytest.approx(abs(0.75 - ended.mean()))
    assert scores["reward_ece"] == pytest.approx(np.mean(wrong))
    assert scores["reward_brier"] == pytest.approx(2.0 * np.mean(wrong))


def test_rewards_of_a_later_step_are_judged_from_where_it_began() -> None:
    """Of a model that imagines one possible future: the rules' rewards for its macrostates are its own."""
    world = judged_world("pick_place")

    def one_future(found: Imagined, frames: Frame, actions: Ints) -> Imagined:
        shape = (len(frames), 1, actions.shape[1])
        images, rewards = np.zeros((*shape, *frames.shape[2:]), dtype=np.uint8), np.zeros(shape)
        for row, (start, _) in enumerate(asked_pairs(world, frames, actions)):
            state, over = start, False
            for step, action in enumerate(actions[row].tolist()):
                outcome = world.spec.rules.outcomes(state, action)[-1]
                state = outcome.macrostate
                images[row, 0, step] = world.index.frame(state)
                rewards[row, 0, step] = 0.0 if over else outcome.reward
                over = over or outcome.terminated
        return Imagined(pictures=images, probabilities=np.ones(shape), rewards=rewards)

    found = ranking_scores(world.spec, world.ranked, world.predictions(Altered(world, one_future), world.ranked))
    assert found["regret"] == found["regret_ruled"] > 0.0


def test_noise_is_told_apart_where_most_of_the_world_is_certain() -> None:
    """By uncertainties that are 1 where several macrostates may follow, and 0 elsewhere; it imagines one future."""
    world = judged_world("pick_place")

    def knowing(_: Imagined, frames: Frame, actions: Ints) -> Imagined:
        pairs = asked_pairs(world, frames, actions)
        noisy = np.array([len(world.spec.rules.outcomes(*pair)) > 1 for pair in pairs], dtype=np.float64)
        still = STILL.imagine(frames, actions, 1, np.random.default_rng(0))
        known = np.repeat(noisy[:, None], actions.shape[1], axis=1)
        return dataclasses.replace(still, aleatoric=known, modal=known)

    random = [len(steps[0]) > 1 for steps in world.one_step.truth]
    assert 0.0 < np.mean(random) < 0.5
    scores = world.scores(Altered(world, knowing))
    assert scores["auroc_noisy"] == scores["auroc_several"] == 1.0
