"""Scores of a model's predictions against the exact truth; 0 is best in every error.

The names of scores are columns of kept files; :data:`FORMER` has those of older files. NaN stands where a model does
not offer a prediction, and where there is nothing to tell apart.

A model that draws futures is charged for their number by every score of probabilities: by total variation, calibration
errors and Brier scores. Two columns make it comparable with a model that gives probabilities: the total variation that
a perfect sampler would have, and :func:`.truth.squared_distance`, which is free of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from imagine_bench.arrays import Bools, Floats, State
from imagine_bench.exact.values import TIE, Model, rows_of, true_model, values_of_planning
from imagine_bench.interfaces import Rules, TaskSpec
from imagine_bench.interfaces.model import WorldModel, require_graph
from imagine_bench.judge.models import graph_of
from imagine_bench.judge.policies import acceptance
from imagine_bench.judge.policies.agreement import dense
from imagine_bench.judge.policies.exploit import Exploit
from imagine_bench.judge.policies.fidelity import fidelity
from imagine_bench.judge.policies.film import Expected, Film, course
from imagine_bench.judge.policies.levels import SCORES, level_scores, without_model
from imagine_bench.judge.policies.policy_set import PolicyWorld
from imagine_bench.judge.predictions import Predictions, transition_table
from imagine_bench.judge.questions import FRAMES, RANKED, EvalSet
from imagine_bench.judge.truth import (
    Value,
    added_up,
    expected_reward,
    hallucinated_modes,
    missed_modes,
    p_ended,
    sampling_noise_floor,
    shares,
    squared_distance,
    total_variation,
)
from imagine_bench.judge.worlds.making import WorldQuestions
from imagine_bench.judge.worlds.scores import FamilyScores, graph_scores, world_scores
from imagine_bench.seeding import SeedTree
from imagine_bench.statistics import auroc

_BINS = 10
_MOST = 0.5  # share of a transition's frames in which a filter keeps it; probability from which an episode goes on
_AVOIDED = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)  # shares of the transitions, those that a model knows least of
_WRONG = 0.5  # total variation from which a transition counts as imagined wrongly
FORMER = {
    "invented": "hallucinated",
    "nothing": "unreadable",
    "worth_of_refusing": "value_of_abstaining",
    "worth_of_filter": "value_of_filter",
}
"""Today's name of each score that files kept before 2026-11-30 name otherwise."""
Scores = dict[str, float]
CellScores = dict[str, Any]
"""Scores of one model, seed and size of data with everything else that is kept beside them, or a part, as in JSON."""
T = TypeVar("T")
Pairs = Sequence[tuple[Mapping[Value, float], Mapping[Value, float]]]
"""Exact and imagined probabilities of each question."""


def today(scores: Mapping[str, T]) -> dict[str, T]:
    """Kept scores by today's names."""
    return {FORMER.get(name, name): value for name, value in scores.items()}


def by_depth(questions: EvalSet, predictions: Predictions) -> dict[str, list[float]]:
    """Mean distances to the exact distribution, by depth.

    Returns:
        ``tv_by_depth``, the total variation; ``perfect_by_depth``, that of a perfect sampler with as many futures;
        ``unbiased_by_depth``, the squared distance. D numbers each.
    """
    away, perfect, squared = np.zeros((3, *questions.asked.shape))
    for row, steps in enumerate(questions.truth):
        drawn = int(predictions.drawn[row])
        for step, outcomes in enumerate(steps):
            exact = shares(outcomes)
            imagined = predictions.distribution(row, step)
            away[row, step] = total_variation(exact, imagined)
            perfect[row, step] = sampling_noise_floor(exact, drawn)
            squared[row, step] = squared_distance(exact, imagined, drawn)
    found = {"tv_by_depth": away, "perfect_by_depth": perfect, "unbiased_by_depth": squared}
    return {name: values.mean(axis=0).tolist() for name, values in found.items()}


def one_step_scores(
    spec: TaskSpec, questions: EvalSet, predictions: Predictions, visited: set[tuple[State, int]] | None
) -> CellScores:
    """Every score of single transitions. ``visited`` are the (macrostate, action) pairs in its data, or None."""
    pairs = _distributions(questions, predictions)
    away = _away(pairs)
    unseen = None if visited is None else np.array([pair not in visited for pair in questions.pairs])
    distances = by_depth(questions, predictions)
    return {
        "total_variation": float(away.mean()),
        "perfect_sampler": distances["perfect_by_depth"][0],
        "unbiased": distances["unbiased_by_depth"][0],
        "missed": float(np.mean([missed_modes(*pair) for pair in pairs])),
        "hallucinated": float(np.mean([hallucinated_modes(*pair) for pair in pairs])),
        "unreadable": float(np.mean([sum(p for state, p in each.items() if state[0] < 0) for _, each in pairs])),
        **_calibration("outcome", pairs),
        **_reward_scores(questions, predictions),
        **_end_scores(questions, predictions),
        **_costs(spec, questions, predictions),
        **_uncertainty_scores(pairs, predictions, away, unseen),
        "worst": np.argsort(-away, kind="stable")[:10].tolist(),
    }


def _distributions(questions: EvalSet, predictions: Predictions) -> Pairs[State]:
    """Exact and imagined probabilities of the macrostates after each first macro-action."""
    return [(shares(steps[0]), predictions.distribution(row, 0)) for row, steps in enumerate(questions.truth)]


def _away(pairs: Pairs[State]) -> Floats:
    """Total variation of each pair."""
    return np.array([total_variation(*pair) for pair in pairs])


def after_the_end_scores(asked: EvalSet | None, predictions: Predictions | None, before: Predictions) -> Scores:
    """Total variation of transitions that no training contains, and whether its uncertainty tells them from others.

    ``before`` are the predictions of transitions that training can contain.
    """
    found = dict.fromkeys(("after_the_end", "auroc_after_the_end"), math.nan)
    if asked is None or predictions is None:
        return found
    found["after_the_end"] = by_depth(asked, predictions)["tv_by_depth"][0]
    known = before.of_one_step("epistemic")
    unknown = predictions.of_one_step("epistemic")
    if known is not None and unknown is not None:
        never_seen = np.repeat([False, True], [len(known), len(unknown)])
        found["auroc_after_the_end"] = auroc(np.concatenate([known, unknown]), never_seen)
    return found


def ranking_scores(spec: TaskSpec, questions: EvalSet, predictions: Predictions) -> Scores:
    """Mean regret: the exact return of the best of each start's sequences, less that of the one ranked first.

    ``regret`` ranks by the model's own rewards, ``regret_ruled`` by the rules' rewards for the imagined macrostates.
    The latter is NaN for a model that gives probabilities of several images: it does not say which of them follow
    which.
    """
    exact = np.array([sum(map(expected_reward, steps)) for steps in questions.truth]).reshape(-1, RANKED)

    def regret(rewards: Floats) -> float:
        imagined = (predictions.weights * rewards).sum(axis=(1, 2)).reshape(-1, RANKED)
        first = (imagined >= imagined.max(axis=1, keepdims=True) - TIE).argmax(axis=1)
        return float((exact.max(axis=1) - exact[np.arange(len(exact)), first]).mean())

    own = predictions.offered.get("rewards")
    found = {"regret": math.nan if own is None else regret(own), "regret_ruled": math.nan}
    if predictions.drawn.all() or predictions.weights.shape[1] == 1:
        found["regret_ruled"] = regret(_ruled(questions, predictions, spec.rules)[0])
    return found


def _ruled(questions: EvalSet, predictions: Predictions, rules: Rules) -> tuple[Floats, Floats]:
    """Rewards, and whether the episode is over, that the rules give for imagined futures. Each of shape (N, S, D).

    An unreadable image earns nothing and ends the episode.
    """
    rewards = np.zeros(predictions.weights.shape)
    over = np.ones(rewards.shape)
    for row, futures in enumerate(predictions.states.tolist()):
        for slot, steps in enumerate(futures):
            state = questions.states[row]
            for step, action in enumerate(questions.asked[row].tolist()):
                reached = tuple(steps[step])
                if reached[0] < 0:
                    break
                ruled = rules.judge(state, action, reached)
                rewards[row, slot, step] = ruled.reward
                if ruled.terminated:
                    break
                over[row, slot, step] = 0.0
                state = reached
    return rewards, over


def imagined_models(questions: EvalSet, predictions: Predictions, rules: Rules) -> dict[str, Model]:
    """A model's predictions for every macro-action in the macrostates of :func:`.questions.one_step`.

    Returns:
        ``ruled``, with the rules' rewards and ends for the imagined macrostates; and ``own``, with the rewards and ends
        that the model predicts, where it predicts both.
    """
    states = questions.macrostates
    shape = (len(states), rules.n_actions, -1)
    weights = predictions.weights[:, :, 0] / FRAMES
    following = rows_of(predictions.states[:, :, 0], states).reshape(shape)

    def model(rewards: Floats, over: Floats) -> Model:
        continues = (weights * (1.0 - over)).reshape(shape)
        return Model(following, continues, (weights * rewards).reshape(shape).cumsum(axis=2)[:, :, -1])

    rewards, over = _ruled(questions, predictions, rules)
    found = {"ruled": model(rewards[:, :, 0], over[:, :, 0])}
    own_rewards = predictions.of_one_step("rewards")
    own_over = predictions.of_one_step("p_ended")
    if own_rewards is not None and own_over is not None:
        found["own"] = model(own_rewards.astype(np.float64), own_over.astype(np.float64))
    return found


def _costs(spec: TaskSpec, questions: EvalSet, predictions: Predictions) -> dict[str, float | list[float]]:
    """Value losses, in the mean, the worst and by start, and the gain of abstaining; NaN where not all is asked about.

    A loss is V* - V of the policy that is optimal in the model, by its own rewards and ends; NaN where it leaves them
    out. ``value_loss_ruled`` is the mean loss with the rules' rewards and ends for the imagined macrostates.

    The gain of abstaining is the gain in value of a planner that avoids some transitions, except in macrostates where
    it would avoid all of them. ``value_of_abstaining`` avoids those that the model knows least of; it tries the shares
    of :data:`_AVOIDED` and is the gain of the best one with the truth known, or 0 where none gains.
    ``value_of_filter`` avoids those that the model's own filter discards.
    """
    states = questions.macrostates
    starts = spec.rules.start_states
    names = ("value_loss", "worst_value_loss", "value_loss_ruled", "value_of_abstaining", "value_of_filter")
    found: dict[str, float | list[float]] = {**dict.fromkeys(names, math.nan), "value_loss_by_start": []}
    if not set(starts) <= set(states):
        return found
    truth = true_model(spec.rules, states)
    models = imagined_models(questions, predictions, spec.rules)
    rows = [states.index(start) for start in starts]

    def planned(held: Model, allowed: Bools | None = None) -> Floats:
        return values_of_planning(truth, held, spec.horizon, allowed)[rows]

    best = planned(truth)
    found["value_loss_ruled"] = float(np.maximum(best - planned(models["ruled"]), 0.0).mean())
    if "own" not in models:
        return found
    usual = planned(models["own"])

    def gain(allowed: Bools) -> float:
        return float(planned(models["own"], allowed).mean() - usual.mean())

    def by_pair(of_questions: Floats) -> Floats:
        return of_questions.reshape(len(states), -1, FRAMES).mean(axis=2).astype(np.float64)

    losses = np.maximum(best - usual, 0.0)
    found["value_loss"] = float(losses.mean())
    found["worst_value_loss"] = float(losses.max())
    found["value_loss_by_start"] = losses.round(6).tolist()
    epistemic = predictions.of_one_step("epistemic")
    accepted = predictions.of_one_step("accepted")
    if epistemic is not None:
        unknown = by_pair(epistemic)
        found["value_of_abstaining"] = max(0.0, *(gain(unknown <= np.quantile(unknown, 1.0 - s)) for s in _AVOIDED))
    if accepted is not None:
        found["value_of_filter"] = gain(by_pair(accepted) >= _MOST)
    return found


def policy_scores(
    world: PolicyWorld | None,
    questions: EvalSet,
    predictions: Predictions,
    rules: Rules,
    table: Model | None,
    seeds: SeedTree,
) -> tuple[Scores, Film | None]:
    """The scores of :func:`.policies.levels.level_scores` by the model's own rewards and ends, and by the rules'.

    The latter end in ``_ruled``. The film is by the model's own, or by the rules' where it predicts none. NaN, and no
    film, where not all of the world is asked about.

    Args:
        world: The policies.
        questions: Those of single transitions, as :func:`.questions.one_step` makes them.
        predictions: The model's answers.
        rules: The task's rules.
        table: The counts of the data that the model learned from.
        seeds: Has a generator for each search, and for training on the data.
    """
    found = {f"{name}{kind}": math.nan for name in SCORES for kind in ("", "_ruled")} | {"fidelity": math.nan}
    if world is None:
        return found, None
    models = imagined_models(questions, predictions, rules)
    without = None if table is None else without_model(world, table, seeds.child("data").generator())
    exploits = {}
    for kind, model in models.items():
        scores, exploits[kind] = level_scores(world, model, without, seeds.child(kind).generator())
        found |= {f"{name}{'_ruled' if kind == 'ruled' else ''}": value for name, value in scores.items()}
    found["fidelity"] = fidelity(world, dense(models["ruled"]))
    shown = "own" if "own" in models else "ruled"
    return found, _film(world, exploits[shown], _likeliest_imagined(world, predictions, models[shown]), rules)


def acceptance_scores(
    world: PolicyWorld | None, policy: str, questions: EvalSet, predictions: Predictions, seeds: SeedTree
) -> Scores:
    """The scores of :mod:`.policies.acceptance`, by the epistemic uncertainty.

    NaN where none is offered, not all of the world is asked about, or the data's distribution is not known. It is
    known of the policies ``random`` and ``uniform``.
    """
    found = {f"conformal_{name}": math.nan for name in acceptance.SCORES}
    epistemic = predictions.of_one_step("epistemic")
    if world is None or epistemic is None or policy not in ("random", "uniform"):
        return found
    uniform = world.policies.tables[:1]
    data = np.full_like(uniform, 1.0 / uniform.size)
    if policy == "random":
        data = acceptance.occupancies(world, uniform)
    wrong = _away(_distributions(questions, predictions)) > _WRONG
    scores = acceptance.acceptance_scores(world, data[0], epistemic, wrong, seeds.generator())
    return {f"conformal_{name}": value for name, value in scores.items()}


def _film(
    world: PolicyWorld, exploit: Exploit, believed: Callable[[State, int], Expected], rules: Rules
) -> Film | None:
    """The film of an exploit, from where its returns differ most; None where they differ nowhere."""

    def real(state: State, action: int) -> Expected:
        likely = max(rules.outcomes(state, action), key=lambda each: each.probability)
        return Expected(likely.macrostate, likely.reward, likely.terminated)

    gaps = np.where(world.starts > 0.0, exploit.believed - exploit.real, -np.inf)
    row = int(gaps.argmax())
    if gaps[row] <= TIE:
        return None
    start = world.states[row]
    return Film(
        start=start,
        returns=(float(exploit.believed[row]), float(exploit.real[row])),
        believed=course(start, exploit.plan, world.states, believed),
        real=course(start, exploit.plan, world.states, real),
    )


def _likeliest_imagined(world: PolicyWorld, predictions: Predictions, model: Model) -> Callable[[State, int], Expected]:
    """The outcome that a model expects most of a macro-action in a macrostate."""

    def outcome(state: State, action: int) -> Expected:
        row = world.states.index(state)
        first = FRAMES * (row * model.reward.shape[1] + action)
        likely = added_up(pair for frame in range(FRAMES) for pair in predictions.futures(first + frame, 0))
        over = float(model.p_continues[row, action].sum()) < _MOST
        return Expected(max(likely, key=likely.__getitem__), float(model.reward[row, action]), over)

    return outcome


def _calibration(of: str, pairs: Pairs[Value]) -> Scores:
    """Expected calibration error of probabilities, and Brier score beyond that of the exact ones."""
    held = []
    true = []
    brier = 0.0
    for truth, guess in pairs:
        for value in {*truth, *guess}:
            p = guess.get(value, 0.0)
            q = truth.get(value, 0.0)
            brier += (p - q) ** 2
            if p:
                held.append(p)
                true.append(q)
    return {
        f"{of}_ece": calibration_error(np.array(held), np.array(true), np.array(held)),
        f"{of}_brier": brier / len(pairs),
    }


def calibration_error(held: Floats, true: Floats, weights: Floats) -> float:
    """Expected calibration error: distance of probabilities held from those true, by ten equal bins of the former."""
    bins = np.minimum((held * _BINS).astype(int), _BINS - 1)
    gaps = [abs(np.dot(weights[rows], held[rows] - true[rows])) for rows in (bins == index for index in range(_BINS))]
    return float(sum(gaps) / weights.sum())


def _reward_scores(questions: EvalSet, predictions: Predictions) -> Scores:
    """Error of the expected reward; for calibration and Brier score a reward counts as the nearest of the rules'."""
    rewards = predictions.of_one_step("rewards")
    if rewards is None:
        return dict.fromkeys(("reward_error", "reward_ece", "reward_brier"), math.nan)
    weights = predictions.weights[:, :, 0]
    true = np.array([expected_reward(steps[0]) for steps in questions.truth])
    exact = [added_up((reward, share) for share, reward in steps[0].values()) for steps in questions.truth]
    given = np.array(sorted({reward for each in exact for reward in each}))
    nearest = given[np.abs(rewards[..., None] - given).argmin(axis=-1)]
    imagined = [added_up(zip(*each, strict=True)) for each in zip(nearest.tolist(), weights.tolist(), strict=True)]
    error = float(np.abs((weights * rewards).sum(axis=1) - true).mean())
    return {"reward_error": error, **_calibration("reward", list(zip(exact, imagined, strict=True)))}


def _end_scores(questions: EvalSet, predictions: Predictions) -> Scores:
    """Errors of the probability of the end."""
    over = predictions.of_one_step("p_ended")
    if over is None:
        return dict.fromkeys(("end_error", "end_ece", "end_brier"), math.nan)
    true = np.array([p_ended(steps[0]) for steps in questions.truth])
    held = (predictions.weights[:, :, 0] * over).sum(axis=1)
    return {
        "end_error": float(np.abs(held - true).mean()),
        "end_ece": calibration_error(held, true, np.ones(len(held))),
        "end_brier": float(((held - true) ** 2).mean()),
    }


def _uncertainty_scores(pairs: Pairs[State], predictions: Predictions, away: Floats, unseen: Bools | None) -> Scores:
    """How well each uncertainty that a model offers finds its errors."""
    wrong = away > _WRONG
    entropy = np.array([-sum(p * math.log(p) for p in exact.values()) for exact, _ in pairs])
    to_tell = {
        "wrong": ("epistemic", wrong),
        "never": ("epistemic", unseen),
        "either": ("epistemic", None if unseen is None else wrong | unseen),
        "noisy": ("aleatoric", entropy > np.median(entropy)),
        "several": ("modal", np.array([len(exact) > 1 for exact, _ in pairs])),
    }
    found: Scores = {}
    for name, (uncertainty, truth) in to_tell.items():
        offered = predictions.of_one_step(uncertainty)
        found[f"auroc_{name}"] = math.nan if offered is None or truth is None else auroc(offered, truth)
    epistemic = predictions.of_one_step("epistemic")
    found["risk_coverage"] = math.nan if epistemic is None else risk_coverage(epistemic, wrong)
    accepted = predictions.of_one_step("accepted")
    kept = None if accepted is None else accepted.astype(np.bool_)
    return found | filter_scores(epistemic, kept, away)


def risk_coverage(uncertainty: Floats, wrong: Bools) -> float:
    """The share of wrong ones among the k most certain of N answers, the mean over k = 1 to N; the less, the better.

    It is the area under the risk-coverage curve. Answers that are equally certain stand in any order: each counts as
    their mean.
    """
    _, places, often = np.unique(uncertainty, return_inverse=True, return_counts=True)
    level = np.bincount(places, weights=wrong) / often
    so_far = level.repeat(often).cumsum()
    return float((so_far / np.arange(1, len(wrong) + 1)).mean())


def filter_scores(epistemic: Floats | None, kept: Bools | None, away: Floats) -> Scores:
    """The share of N answers that a model's own filter keeps, and how well it chooses.

    ``filter_skill`` is the share of wrong answers that it discards less that of right ones, ``best_skill`` the largest
    that any threshold of the epistemic uncertainty has.

    Args:
        epistemic: Shape (N,).
        kept: Shape (N,).
        away: Total variation. Shape (N,).
    """
    found = dict.fromkeys(("filter_keeps", "filter_error", "filter_skill", "best_skill"), math.nan)
    wrong = away > _WRONG
    both = wrong.any() and not wrong.all()
    if kept is not None:
        found["filter_keeps"] = float(kept.mean())
        found["filter_error"] = float(away[kept].mean()) if kept.any() else math.nan
    if kept is not None and both:
        found["filter_skill"] = float((~kept)[wrong].mean() - (~kept)[~wrong].mean())
    if epistemic is not None and both:
        levels, places = np.unique(epistemic, return_inverse=True)
        of_wrong, of_right = (np.bincount(places[rows], minlength=len(levels)) / rows.sum() for rows in (wrong, ~wrong))
        found["best_skill"] = float(max(0.0, (of_right - of_wrong).cumsum().max()))
    return found


def light_scores(
    asked: EvalSet | None, predictions: Predictions | None, pairs: WorldQuestions | None
) -> dict[str, FamilyScores]:
    """The scores of the pairs that differ in the light alone, by cause; nothing where there are none."""
    if asked is None or predictions is None or pairs is None:
        return {}
    found = world_scores(pairs, transition_table(asked, predictions, pairs.states))
    return {name: scores for name, scores in found.items() if name not in {each.name for each in pairs.families}}


def whole_world_scores(
    name: str, model: WorldModel, single: EvalSet, predictions: Predictions, whole: WorldQuestions | None
) -> dict[str, FamilyScores]:
    """The scores of questions about the whole world, and the distance of the model's factor graph if it offers one.

    ``single`` and ``predictions`` are of single macro-actions; nothing is scored where ``whole`` is None.

    Raises:
        InvalidValueError: The model offers a graph and fails, or gives one of wrong types or shapes.
    """
    if whole is None:
        return {}
    found = world_scores(whole, transition_table(single, predictions, whole.states))
    learned = graph_of(model, name, single.frames[:, -1])
    if learned is not None:
        checked = require_graph(learned, name=name, rows=len(single.states), n_actions=len(whole.edges))
        found |= graph_scores(checked, whole.edges, np.array(single.states, dtype=np.int64))
    return found
