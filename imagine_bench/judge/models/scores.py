"""Scores of a model's answers against the exact truth; 0 is best in every error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Rules, State, TaskSpec
from imagine_bench.judge.calibration import auroc
from imagine_bench.judge.models.asking import Answers, Distribution
from imagine_bench.judge.models.outcomes import hallucinated_modes, missed_modes, total_variation
from imagine_bench.judge.models.truth import Questions, expected_reward, p_ended, shares
from imagine_bench.judge.models.values import (
    exact_machine,
    imagined_machine,
    mean_by_pair,
    regrets,
    value_losses,
    worth_of_filter,
    worth_of_refusing,
)
from imagine_bench.rules import fewest_actions

_BINS = 10
_WRONG = 0.5  # total variation from which a transition counts as imagined wrongly
Scores = dict[str, float]
COVERAGES = tuple(round(0.05 * index, 2) for index in range(1, 21))
"""Shares of the questions that are answered, the surest first."""


def by_depth(questions: Questions, answers: Answers) -> dict[str, list[float]]:
    """Total variation to the exact distribution, and the share of pictures that show nothing, by depth."""
    rows, depth = len(questions.truth), questions.depth
    away, nothing = np.zeros((rows, depth)), np.zeros((rows, depth))
    for row, steps in enumerate(questions.truth):
        for step, outcomes in enumerate(steps):
            imagined = answers.distribution(row, step)
            away[row, step] = total_variation(shares(outcomes), imagined)
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
    seen = np.array([pair in visited for pair in zip(questions.states, questions.asked[:, 0].tolist(), strict=True)])
    return {
        "total_variation": float(away.mean()),
        "missed": float(np.mean([missed_modes(*pair) for pair in zip(exact, imagined, strict=True)])),
        "invented": float(np.mean([hallucinated_modes(*pair) for pair in zip(exact, pictured, strict=True)])),
        "nothing": float(np.mean([no_picture(each) for each in imagined])),
        **_calibration("outcome", exact, imagined),
        **_reward_and_end(questions, answers),
        **_values(spec, questions, answers),
        "where": _where(spec, questions, exact, imagined, away, seen),
        **_knows(exact, answers, away, seen),
        "by_question": away.round(6).tolist(),
        "worst": np.argsort(-away, kind="stable")[:10].tolist(),
    }


def after_the_end(asked: Questions | None, answers: Answers | None, before: Answers) -> dict[str, float]:
    """Total variation of transitions that no training contains, and whether its uncertainty tells them from others.

    ``before`` are the answers about transitions that training can contain. NaN without such a question or uncertainty.
    """
    found = dict.fromkeys(("after_the_end", "auroc_after_the_end"), math.nan)
    if asked is None or answers is None:
        return found
    away = [total_variation(shares(steps[0]), answers.distribution(row, 0)) for row, steps in enumerate(asked.truth)]
    both = [each.uncertainties.get("epistemic") for each in (before, answers)]
    if both[0] is not None and both[1] is not None:
        unseen = np.repeat([False, True], [len(each) for each in both if each is not None])
        found["auroc_after_the_end"] = auroc(np.concatenate([both[0][:, 0], both[1][:, 0]]), unseen)
    return {**found, "after_the_end": float(np.mean(away))}


def _values(spec: TaskSpec, questions: Questions, answers: Answers) -> dict[str, Any]:
    """Value losses, in the mean, the worst and by start, and what refusing is worth; NaN where not all is asked about.

    What refusing is worth has two figures: with the best share that the model knows least of, and by its own filter.
    """
    machine, truth = imagined_machine(questions, answers, spec.rules), exact_machine(questions, spec.n_actions)
    starts, names = spec.rules.start_states, ("value_loss", "worst_value_loss", "worth_of_refusing", "worth_of_filter")
    if not set(starts) <= set(truth.states):
        return {**dict.fromkeys(names, math.nan), "value_loss_by_start": []}
    losses = value_losses(truth, machine, starts, spec.horizon)
    epistemic, accepted = answers.uncertainties.get("epistemic"), answers.accepted
    worths = [
        math.nan if given is None else worth(mean_by_pair(questions, given[:, 0]), truth, machine, starts, spec.horizon)
        for given, worth in ((epistemic, worth_of_refusing), (accepted, worth_of_filter))
    ]
    found = dict(zip(names, (float(losses.mean()), float(losses.max()), *worths), strict=True))
    return {**found, "value_loss_by_start": losses.round(6).tolist()}


def ranking_scores(spec: TaskSpec, questions: Questions, answers: Answers) -> dict[str, float]:
    """Mean regret of the first of the ranked sequences."""
    return {"regret": float(regrets(questions, answers, spec.rules).mean())}


def _calibration(of: str, exact: Sequence[Mapping[Any, float]], imagined: Sequence[Mapping[Any, float]]) -> Scores:
    """Expected calibration error of probabilities, and Brier score beyond that of the exact ones."""
    held, true, brier = [], [], 0.0
    for truth, guess in zip(exact, imagined, strict=True):
        for state in {*truth, *guess}:
            p, q = guess.get(state, 0.0), truth.get(state, 0.0)
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


def _reward_and_end(questions: Questions, answers: Answers) -> dict[str, float]:
    """Errors of rewards and of the probability of the end; NaN where not offered.

    ``reward_error`` is that of the expected reward. For calibration and Brier score a reward counts as the nearest of
    those that the rules give.
    """
    names = ("reward_error", "reward_ece", "reward_brier", "end_error", "end_ece", "end_brier")
    found, weights = dict.fromkeys(names, math.nan), answers.weights[:, :, 0]
    if answers.rewards is not None:
        rewards, true = answers.rewards[:, :, 0], np.array([expected_reward(steps[0]) for steps in questions.truth])
        found["reward_error"] = float(np.abs((weights * rewards).sum(axis=1) - true).mean())
        exact = [_gathered((reward, share) for share, reward in steps[0].values()) for steps in questions.truth]
        given = np.array(sorted({reward for each in exact for reward in each}))
        nearest = given[np.abs(rewards[..., None] - given).argmin(axis=-1)]
        imagined = [_gathered(zip(*pair, strict=True)) for pair in zip(nearest.tolist(), weights.tolist(), strict=True)]
        found |= _calibration("reward", exact, imagined)
    if answers.p_ended is not None:
        true = np.array([p_ended(steps[0]) for steps in questions.truth])
        held = (weights * answers.p_ended[:, :, 0]).sum(axis=1)
        found["end_error"], found["end_brier"] = float(np.abs(held - true).mean()), float(((held - true) ** 2).mean())
        found["end_ece"] = calibration_error(held, true, np.ones(len(held)))
    return found


def _gathered(pairs: Iterable[tuple[float, float]]) -> dict[float, float]:
    """Probability of each value."""
    found: dict[float, float] = {}
    for value, share in pairs:
        found[value] = found.get(value, 0.0) + share
    return found


def _where(
    spec: TaskSpec, questions: Questions, exact: list[Distribution], imagined: list[Distribution], away: Floats,
    seen: NDArray[np.bool_],
) -> dict[str, dict[str, float]]:  # fmt: skip
    """Mean total variation by action, coordinate, plan length, whether it is in the data, and number of outcomes."""
    actions, several = questions.asked[:, 0], np.array([len(each) > 1 for each in exact])
    comes = np.array([_comes_of(spec.rules, *pair) for pair in zip(questions.states, actions.tolist(), strict=True)])
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
        "what comes of it": means((name, comes == name) for name in sorted(set(comes.tolist()))),
        "in its data": means((("seen", seen), ("never", ~seen))),
        "outcomes": means((("one", ~several), ("several", several))),
    }


def _comes_of(rules: Rules, state: State, action: int) -> str:
    """Success, failure or that the episode goes on; "chance decides" where the rules leave it open."""
    kinds = {
        "success" if o.success else "failure" if o.terminated else "it goes on" for o in rules.outcomes(state, action)
    }
    return kinds.pop() if len(kinds) == 1 else "chance decides"


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
    several, wrong = np.array([len(each) > 1 for each in exact]), away > _WRONG
    entropy = np.array([-sum(p * math.log(p) for p in each.values()) for each in exact])
    questions = {
        "wrong": ("epistemic", wrong), "never": ("epistemic", ~seen), "either": ("epistemic", wrong | ~seen),
        "noisy": ("aleatoric", entropy > np.median(entropy)), "several": ("modal", several),
    }  # fmt: skip
    found: dict[str, Any] = {"risk": []}
    for name, (uncertainty, truth) in questions.items():
        offered = answers.uncertainties.get(uncertainty)
        found[f"auroc_{name}"] = math.nan if offered is None else auroc(offered[:, 0], truth)
    epistemic = answers.uncertainties.get("epistemic")
    if epistemic is not None:
        found["risk"] = risks(epistemic[:, 0], away)
    return found | filter_scores(epistemic, answers.accepted, away)


def filter_scores(epistemic: NDArray[Any] | None, accepted: NDArray[Any] | None, away: Floats) -> Scores:
    """What a model's own filter keeps of N answers, and how well it chooses; NaN where there is none.

    ``filter_skill`` is the share of wrong answers that it discards less that of right ones, ``best_skill`` the largest
    that any threshold of the epistemic uncertainty has.

    Args:
        epistemic: Shape (N, D); the first step counts.
        accepted: Likewise.
        away: Total variation. Shape (N,).
    """
    found, wrong = (
        dict.fromkeys(("filter_keeps", "filter_error", "filter_skill", "best_skill"), math.nan),
        away > _WRONG,
    )
    if accepted is not None:
        kept = accepted[:, 0]
        found["filter_keeps"] = float(kept.mean())
        found["filter_error"] = float(away[kept].mean()) if kept.any() else math.nan
    if wrong.all() or not wrong.any():
        return found
    if accepted is not None:
        found["filter_skill"] = float((~kept)[wrong].mean() - (~kept)[~wrong].mean())
    if epistemic is not None:
        score = epistemic[:, 0]
        levels, places = np.unique(score, return_inverse=True)
        shares = [np.bincount(places[rows], minlength=len(levels)) / rows.sum() for rows in (wrong, ~wrong)]
        found["best_skill"] = float(max(0.0, (shares[1] - shares[0]).cumsum().max()))
    return found


def risks(uncertainty: NDArray[Any], away: Floats) -> list[float]:
    """Mean error of the surest questions, by :data:`COVERAGES`; equally sure ones count in equal shares."""
    order = np.argsort(uncertainty, kind="stable")
    _, group = np.unique(uncertainty[order], return_inverse=True)
    tied = np.bincount(group, weights=away[order]) / np.bincount(group)
    total = np.concatenate([[0.0], tied[group].cumsum()])
    counts = [max(1, round(share * len(away))) for share in COVERAGES]
    return [float(total[count] / count) for count in counts]
