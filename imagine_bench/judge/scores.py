"""Scores of a model's predictions against the exact truth; 0 is best in every error.

The names of scores are columns of kept files and stay as they are there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Rules, State, TaskSpec
from imagine_bench.judge.predictions import Predictions
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.truth import (
    Distribution,
    Value,
    added_up,
    expected_reward,
    hallucinated_modes,
    missed_modes,
    p_ended,
    shares,
    total_variation,
)
from imagine_bench.judge.values import (
    exact_machine,
    imagined_machine,
    mean_by_pair,
    regrets,
    value_losses,
    value_of_abstaining,
)
from imagine_bench.rules import fewest_actions
from imagine_bench.statistics import auroc

_BINS = 10
_MOST = 0.5  # share of a transition's frames in which a filter keeps it
_AVOIDED = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)  # shares of the transitions, those that a model knows least of
_WRONG = 0.5  # total variation from which a transition counts as imagined wrongly
Scores = dict[str, float]
COVERAGES = tuple(round(0.05 * index, 2) for index in range(1, 21))
"""Shares of the questions that are answered, the surest first."""


def by_depth(questions: EvalSet, predictions: Predictions) -> dict[str, list[float]]:
    """Total variation to the exact distribution, and the share of unreadable images, by depth."""
    away = np.zeros((len(questions.truth), questions.depth))
    unreadable = np.zeros_like(away)
    for row, steps in enumerate(questions.truth):
        for step, outcomes in enumerate(steps):
            imagined = predictions.distribution(row, step)
            away[row, step] = total_variation(shares(outcomes), imagined)
            unreadable[row, step] = unreadable_share(imagined)
    return {"tv_by_depth": away.mean(axis=0).tolist(), "nothing_by_depth": unreadable.mean(axis=0).tolist()}


def unreadable_share(imagined: Distribution) -> float:
    """Share of images that show nothing of this world."""
    return sum(share for state, share in imagined.items() if state[0] < 0)


def one_step_scores(
    spec: TaskSpec, questions: EvalSet, predictions: Predictions, visited: set[tuple[State, int]]
) -> dict[str, Any]:
    """Every score of single transitions. ``visited`` are the (macrostate, action) pairs in the model's data."""
    exact = [shares(steps[0]) for steps in questions.truth]
    imagined = [predictions.distribution(row, 0) for row in range(len(exact))]
    readable = [{state: share for state, share in each.items() if state[0] >= 0} for each in imagined]
    away = np.array([total_variation(*pair) for pair in zip(exact, imagined, strict=True)])
    seen = np.array([pair in visited for pair in zip(questions.states, questions.first_actions, strict=True)])
    return {
        "total_variation": float(away.mean()),
        "missed": float(np.mean([missed_modes(*pair) for pair in zip(exact, imagined, strict=True)])),
        "invented": float(np.mean([hallucinated_modes(*pair) for pair in zip(exact, readable, strict=True)])),
        "nothing": float(np.mean([unreadable_share(each) for each in imagined])),
        **_calibration("outcome", exact, imagined),
        **_reward_scores(questions, predictions),
        **_end_scores(questions, predictions),
        **_values(spec, questions, predictions),
        "where": _where(spec, questions, exact, imagined, away, seen),
        **_uncertainty_scores(exact, predictions, away, seen),
        "by_question": away.round(6).tolist(),
        "worst": np.argsort(-away, kind="stable")[:10].tolist(),
    }


def after_the_end_scores(asked: EvalSet | None, predictions: Predictions | None, before: Predictions) -> Scores:
    """Total variation of transitions that no training contains, and whether its uncertainty tells them from others.

    ``before`` are the predictions of transitions that training can contain. NaN without such a question or uncertainty.
    """
    found = dict.fromkeys(("after_the_end", "auroc_after_the_end"), math.nan)
    if asked is None or predictions is None:
        return found
    found["after_the_end"] = by_depth(asked, predictions)["tv_by_depth"][0]
    known = before.epistemic
    unknown = predictions.epistemic
    if known is not None and unknown is not None:
        never_seen = np.repeat([False, True], [len(known), len(unknown)])
        found["auroc_after_the_end"] = auroc(np.concatenate([known, unknown]), never_seen)
    return found


def _values(spec: TaskSpec, questions: EvalSet, predictions: Predictions) -> dict[str, float | list[float]]:
    """Value losses, in the mean, the worst and by start, and the value of abstaining; NaN where not all is asked about.

    The value of abstaining is what planning gains where it avoids transitions: those that the model knows least of, of
    :data:`_AVOIDED` the best share with the truth known and 0 where none gains; or those that its own filter discards.
    """
    machine = imagined_machine(questions, predictions, spec.rules)
    truth = exact_machine(questions, spec.n_actions)
    starts = spec.rules.start_states
    found: dict[str, float | list[float]] = dict.fromkeys(
        ("value_loss", "worst_value_loss", "worth_of_refusing", "worth_of_filter"), math.nan
    )
    if not set(starts) <= set(truth.states):
        return {**found, "value_loss_by_start": []}
    losses = value_losses(truth, machine, starts, spec.horizon)
    gain = partial(value_of_abstaining, truth, machine, starts, spec.horizon)
    found["value_loss"] = float(losses.mean())
    found["worst_value_loss"] = float(losses.max())
    if predictions.epistemic is not None:
        unknown = mean_by_pair(questions, predictions.epistemic)
        known = [unknown <= np.quantile(unknown, 1.0 - share) for share in _AVOIDED]
        found["worth_of_refusing"] = max(0.0, *map(gain, known))
    if predictions.accepted is not None:
        kept = mean_by_pair(questions, predictions.accepted[:, 0].astype(np.float64))
        found["worth_of_filter"] = gain(kept >= _MOST)
    return {**found, "value_loss_by_start": losses.round(6).tolist()}


def ranking_scores(spec: TaskSpec, questions: EvalSet, predictions: Predictions) -> Scores:
    """Mean regret of the first of the ranked sequences."""
    return {"regret": float(regrets(questions, predictions, spec.rules).mean())}


def _calibration(of: str, exact: Sequence[Mapping[Value, float]], imagined: Sequence[Mapping[Value, float]]) -> Scores:
    """Expected calibration error of probabilities, and Brier score beyond that of the exact ones."""
    held = []
    true = []
    brier = 0.0
    for truth, guess in zip(exact, imagined, strict=True):
        for value in {*truth, *guess}:
            p = guess.get(value, 0.0)
            q = truth.get(value, 0.0)
            brier += (p - q) ** 2
            if p:
                held.append(p)
                true.append(q)
    return {
        f"{of}_ece": calibration_error(np.array(held), np.array(true), np.array(held)),
        f"{of}_brier": brier / len(exact),
    }


def calibration_error(held: Floats, true: Floats, weights: Floats) -> float:
    """Expected calibration error: distance of probabilities held from those true, by ten equal bins of the former."""
    bins = np.minimum((held * _BINS).astype(int), _BINS - 1)
    gaps = [abs(np.dot(weights[rows], held[rows] - true[rows])) for rows in (bins == index for index in range(_BINS))]
    return float(sum(gaps) / weights.sum())


def _reward_scores(questions: EvalSet, predictions: Predictions) -> Scores:
    """Error of the expected reward; for calibration and Brier score a reward counts as the nearest of the rules'.

    NaN where rewards are not offered.
    """
    if predictions.rewards is None:
        return dict.fromkeys(("reward_error", "reward_ece", "reward_brier"), math.nan)
    weights = predictions.weights[:, :, 0]
    rewards = predictions.rewards[:, :, 0]
    true = np.array([expected_reward(steps[0]) for steps in questions.truth])
    error = float(np.abs((weights * rewards).sum(axis=1) - true).mean())
    exact = [added_up((reward, share) for share, reward in steps[0].values()) for steps in questions.truth]
    given = np.array(sorted({reward for each in exact for reward in each}))
    nearest = given[np.abs(rewards[..., None] - given).argmin(axis=-1)]
    imagined = [added_up(zip(*pair, strict=True)) for pair in zip(nearest.tolist(), weights.tolist(), strict=True)]
    return {"reward_error": error, **_calibration("reward", exact, imagined)}


def _end_scores(questions: EvalSet, predictions: Predictions) -> Scores:
    """Errors of the probability of the end; NaN where it is not offered."""
    if predictions.p_ended is None:
        return dict.fromkeys(("end_error", "end_ece", "end_brier"), math.nan)
    true = np.array([p_ended(steps[0]) for steps in questions.truth])
    held = (predictions.weights[:, :, 0] * predictions.p_ended[:, :, 0]).sum(axis=1)
    return {
        "end_error": float(np.abs(held - true).mean()),
        "end_ece": calibration_error(held, true, np.ones(len(held))),
        "end_brier": float(((held - true) ** 2).mean()),
    }


def _where(
    spec: TaskSpec,
    questions: EvalSet,
    exact: list[Distribution],
    imagined: list[Distribution],
    away: Floats,
    seen: NDArray[np.bool_],
) -> dict[str, dict[str, float]]:
    """Mean total variation by action, coordinate, plan length, whether it is in the data, and number of outcomes."""
    pairs = list(zip(questions.states, questions.first_actions, strict=True))
    lengths = {state: fewest_actions(spec.rules, state) for state in set(questions.states)}

    def means(labels: Sequence[object], names: Mapping[object, str]) -> dict[str, float]:
        rows = {name: [index for index, label in enumerate(labels) if label == key] for key, name in names.items()}
        return {name: float(away[there].mean()) for name, there in rows.items() if there}

    comes = [_comes_of(spec.rules, *pair) for pair in pairs]
    plan = [lengths[state] for state, _ in pairs]
    return {
        "action": means([action for _, action in pairs], dict(enumerate(spec.action_names))),
        "coordinate": {
            name: float(np.mean([_apart(index, *pair) for pair in zip(exact, imagined, strict=True)]))
            for index, name in enumerate(spec.macrostate_names)
        },
        "plan length": means(plan, {each: str(each) for each in sorted(set(plan))}),
        "what comes of it": means(comes, {name: name for name in sorted(set(comes))}),
        "in its data": means(seen.tolist(), {True: "seen", False: "never"}),
        "outcomes": means([len(each) > 1 for each in exact], {False: "one", True: "several"}),
    }


def _comes_of(rules: Rules, state: State, action: int) -> str:
    """Success, failure or that the episode goes on; "chance decides" where the rules leave it open."""
    kinds = {
        "success" if o.success else "failure" if o.terminated else "it goes on" for o in rules.outcomes(state, action)
    }
    return kinds.pop() if len(kinds) == 1 else "chance decides"


def _apart(coordinate: int, exact: Distribution, imagined: Distribution) -> float:
    """Total variation of one coordinate."""

    def marginal(whole: Distribution) -> Distribution:
        return added_up(((state[coordinate],), share) for state, share in whole.items())

    return total_variation(marginal(exact), marginal(imagined))


def _uncertainty_scores(
    exact: list[Distribution], predictions: Predictions, away: Floats, seen: NDArray[np.bool_]
) -> dict[str, Any]:
    """How well each uncertainty offered tells what it should; NaN where there is nothing to tell apart."""
    several = np.array([len(each) > 1 for each in exact])
    wrong = away > _WRONG
    entropy = np.array([-sum(p * math.log(p) for p in each.values()) for each in exact])
    to_tell = {
        "wrong": ("epistemic", wrong),
        "never": ("epistemic", ~seen),
        "either": ("epistemic", wrong | ~seen),
        "noisy": ("aleatoric", entropy > np.median(entropy)),
        "several": ("modal", several),
    }
    found: dict[str, float | list[float]] = {"risk": []}
    for name, (uncertainty, truth) in to_tell.items():
        offered = predictions.uncertainties.get(uncertainty)
        found[f"auroc_{name}"] = math.nan if offered is None else auroc(offered[:, 0], truth)
    if predictions.epistemic is not None:
        found["risk"] = risks(predictions.epistemic, away)
    kept = None if predictions.accepted is None else predictions.accepted[:, 0]
    return found | filter_scores(predictions.epistemic, kept, away)


def filter_scores(epistemic: Floats | None, kept: NDArray[np.bool_] | None, away: Floats) -> Scores:
    """What a model's own filter keeps of N answers, and how well it chooses; NaN where there is none.

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


def risks(uncertainty: Floats, away: Floats) -> list[float]:
    """Mean error of the surest questions, by :data:`COVERAGES`; equally sure ones count in equal shares."""
    order = np.argsort(uncertainty, kind="stable")
    _, group = np.unique(uncertainty[order], return_inverse=True)
    tied = np.bincount(group, weights=away[order]) / np.bincount(group)
    total = np.concatenate([[0.0], tied[group].cumsum()])
    counts = [max(1, round(share * len(away))) for share in COVERAGES]
    return [float(total[count] / count) for count in counts]
