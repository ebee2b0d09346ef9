"""Scores of a model's answers against the exact truth; 0 is best in every error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, State, TaskSpec
from imagine_bench.judge.calibration import auroc
from imagine_bench.judge.futures import hallucinated_modes, missed_modes, total_variation
from imagine_bench.judge.models.asking import Answers, Distribution
from imagine_bench.judge.models.truth import Questions, expected_reward, p_ended, shares
from imagine_bench.judge.models.values import (
    exact_machine,
    imagined_machine,
    regrets,
    value_losses,
    worth_of_refusing,
)
from imagine_bench.rules import fewest_actions

_BINS = 10
_WRONG = 0.5  # total variation from which a transition counts as imagined wrongly
COVERAGES = tuple(round(0.05 * index, 2) for index in range(1, 21))
"""Shares of the questions that are answered, the surest first."""


def by_depth(questions: Questions, answers: Answers) -> dict[str, list[float]]:
    """Total variation to the exact distribution, and the share of pictures that show nothing, by depth."""
    rows, depth = len(questions.truth), questions.depth
    away, nothing = np.zeros((rows, depth)), np.zeros((rows, depth))
    for row, steps in enumerate(questions.truth):
        for step, course in enumerate(steps):
            imagined = answers.distribution(row, step)
            away[row, step] = total_variation(shares(course), imagined)
            nothing[row, step] = no_picture(imagined)
    return {"tv_by_depth": away.mean(axis=0).tolist(), "nothing_by_depth": nothing.mean(axis=0).tolist()}


def no_picture(imagined: Distribution) -> float:
    """Share of pictures that show nothing of this world."""
    return sum(share for state, share in imagined.items() if state[0] < 0)


def one_step_scores(
    spec: TaskSpec, questions: Questions, answers: Answers, visited: set[tuple[State, int]]
) -> dict[str, Any]:
    """Every score of single transitions. ``visited`` are the (macrostate, action) pairs in the model's data."""
    exact = [shares(steps[0]) for steps in questions.truth]
    imagined = [answers.distribution(row, 0) for row in range(len(exact))]
    pictured = [{state: share for state, share in each.items() if state[0] >= 0} for each in imagined]
    away = np.array([total_variation(*pair) for pair in zip(exact, imagined, strict=True)])
    calibrated = _outcome_calibration(exact, imagined)
    seen = np.array([pair in visited for pair in zip(questions.states, questions.asked[:, 0].tolist(), strict=True)])
    return {
        "total_variation": float(away.mean()),
        "missed": float(np.mean([missed_modes(*pair) for pair in zip(exact, imagined, strict=True)])),
        "invented": float(np.mean([hallucinated_modes(*pair) for pair in zip(exact, pictured, strict=True)])),
        "nothing": float(np.mean([no_picture(each) for each in imagined])),
        **calibrated,
        **_reward_and_end(questions, answers),
        **_values(spec, questions, answers),
        "where": _where(spec, questions, exact, imagined, away, seen),
        **_knows(exact, answers, away, seen),
        "by_question": away.round(6).tolist(),
        "worst": np.argsort(-away, kind="stable")[:10].tolist(),
    }


def _values(spec: TaskSpec, questions: Questions, answers: Answers) -> dict[str, float]:
    """Value losses; NaN where not every start was asked about."""
    machine, truth = imagined_machine(questions, answers, spec.rules), exact_machine(questions, spec.n_actions)
    starts = spec.rules.start_states
    if not set(starts) <= set(truth.states):
        return dict.fromkeys(("value_loss", "worst_value_loss", "worth_of_refusing"), math.nan)
    losses = value_losses(truth, machine, starts, spec.horizon)
    worth = worth_of_refusing(questions, answers, truth, machine, starts, spec.horizon)
    return {"value_loss": float(losses.mean()), "worst_value_loss": float(losses.max()), "worth_of_refusing": worth}


def ranking_scores(spec: TaskSpec, questions: Questions, answers: Answers) -> dict[str, float]:
    """Mean regret of the first of the ranked sequences."""
    return {"regret": float(regrets(questions, answers, spec.rules).mean())}


def _outcome_calibration(exact: list[Distribution], imagined: list[Distribution]) -> dict[str, float]:
    """Expected calibration error of outcome probabilities, and Brier score beyond that of the exact ones."""
    held, true, brier = [], [], 0.0
    for truth, guess in zip(exact, imagined, strict=True):
        for state in {*truth, *guess}:
            p, q = guess.get(state, 0.0), truth.get(state, 0.0)
            brier += (p - q) ** 2
            if p:
                held.append(p)
                true.append(q)
    return {
        "outcome_ece": calibration_error(np.array(held), np.array(true), np.array(held)),
        "outcome_brier": brier / len(exact),
    }


def calibration_error(held: Floats, true: Floats, weights: Floats) -> float:
    """Expected calibration error: distance of probabilities held from those true, by ten equal bins of the former."""
    bins = np.minimum((held * _BINS).astype(int), _BINS - 1)
    gaps = [abs(np.dot(weights[rows], held[rows] - true[rows])) for rows in (bins == index for index in range(_BINS))]
    return float(sum(gaps) / weights.sum())


def _reward_and_end(questions: Questions, answers: Answers) -> dict[str, float]:
    """Errors of expected rewards and of the probability of the end; NaN where not offered."""
    found = dict.fromkeys(("reward_error", "end_error", "end_ece", "end_brier"), math.nan)
    weights = answers.weights[:, :, 0]
    if answers.rewards is not None:
        true = np.array([expected_reward(steps[0]) for steps in questions.truth])
        found["reward_error"] = float(np.abs((weights * answers.rewards[:, :, 0]).sum(axis=1) - true).mean())
    if answers.p_ended is not None:
        true = np.array([p_ended(steps[0]) for steps in questions.truth])
        held = (weights * answers.p_ended[:, :, 0]).sum(axis=1)
        found["end_error"], found["end_brier"] = float(np.abs(held - true).mean()), float(((held - true) ** 2).mean())
        found["end_ece"] = calibration_error(held, true, np.ones(len(held)))
    return found


def _where(
    spec: TaskSpec, questions: Questions, exact: list[Distribution], imagined: list[Distribution], away: Floats,
    seen: NDArray[np.bool_],
) -> dict[str, dict[str, float]]:  # fmt: skip
    """Mean total variation by action, coordinate, plan length, whether it is in the data, and number of outcomes."""
    actions, several = questions.asked[:, 0], np.array([len(each) > 1 for each in exact])
    lengths = {state: _plan_length(spec, state) for state in set(questions.states)}
    plan = np.array([lengths[state] for state in questions.states])

    def means(groups: Iterable[tuple[str, NDArray[np.bool_]]]) -> dict[str, float]:
        return {name: float(away[rows].mean()) for name, rows in groups if rows.any()}

    return {
        "action": means((name, actions == index) for index, name in enumerate(spec.action_names)),
        "coordinate": {
            name: float(np.mean([_apart(index, *pair) for pair in zip(exact, imagined, strict=True)]))
            for index, name in enumerate(spec.macrostate_names)
        },
        "plan length": means((str(each), plan == each) for each in sorted(set(plan.tolist()))),
        "in its data": means((("seen", seen), ("never", ~seen))),
        "outcomes": means((("one", ~several), ("several", several))),
    }


def _plan_length(spec: TaskSpec, state: State) -> int:
    return fewest_actions(spec.rules, state)


def _apart(coordinate: int, exact: Distribution, imagined: Distribution) -> float:
    """Total variation of one coordinate."""

    def marginal(whole: Mapping[State, float]) -> Distribution:
        found: Distribution = {}
        for state, share in whole.items():
            found[state[coordinate],] = found.get((state[coordinate],), 0.0) + share
        return found

    return total_variation(marginal(exact), marginal(imagined))


def _knows(exact: list[Distribution], answers: Answers, away: Floats, seen: NDArray[np.bool_]) -> dict[str, Any]:
    """How well each uncertainty offered tells what it should; NaN where there is nothing to tell apart."""
    several = np.array([len(each) > 1 for each in exact])
    entropy = np.array([-sum(p * math.log(p) for p in each.values()) for each in exact])
    truths = {"epistemic": away > _WRONG, "aleatoric": entropy > np.median(entropy), "modal": several}
    found: dict[str, Any] = {}
    for name, truth in truths.items():
        offered = answers.uncertainties.get(name)
        found[f"auroc_{name}"] = math.nan if offered is None else auroc(offered[:, 0], truth)
    epistemic = answers.uncertainties.get("epistemic")
    found["auroc_never"] = math.nan if epistemic is None else auroc(epistemic[:, 0], ~seen)
    found["risk"] = [] if epistemic is None else risks(epistemic[:, 0], away)
    return found


def risks(uncertainty: NDArray[Any], away: Floats) -> list[float]:
    """Mean error of the surest questions, by :data:`COVERAGES`; equally sure ones count in equal shares."""
    order = np.argsort(uncertainty, kind="stable")
    _, group = np.unique(uncertainty[order], return_inverse=True)
    tied = np.bincount(group, weights=away[order]) / np.bincount(group)
    total = np.concatenate([[0.0], tied[group].cumsum()])
    counts = [max(1, round(share * len(away))) for share in COVERAGES]
    return [float(total[count] / count) for count in counts]
