"""What a model's mistakes cost: plans that are optimal in the model, followed by the exact rules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Rules, State
from imagine_bench.judge.models.asking import RANKED, Answers
from imagine_bench.judge.models.truth import Questions, expected_reward

_TIE = 1e-9
_MOST = 0.5  # share of a transition's frames in which a filter keeps it


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Macrostates in which episodes go on, X of them, and what macro-actions do there, as somebody has it."""

    states: tuple[State, ...]
    goes_on: Floats  #: Probability that the episode goes on in each of them. Shape (A, X, X).
    reward: Floats  #: Expected reward. Shape (A, X).


def exact_machine(questions: Questions, n_actions: int) -> Machine:
    """As the rules have it."""
    states, pairs = _pairs(questions)
    goes_on, reward = _empty(states, n_actions)
    for (state, action), rows in pairs.items():
        outcomes = questions.truth[rows[0]][0]
        reward[action, states[state]] = expected_reward(outcomes)
        for (after, over), (share, _) in outcomes.items():
            if not over and after in states:
                goes_on[action, states[state], states[after]] += share
    return Machine(states=tuple(states), goes_on=goes_on, reward=reward)


def imagined_machine(questions: Questions, answers: Answers, rules: Rules) -> Machine:
    """As a model has it; rewards and ends that it does not offer are those of the rules for what it imagines.

    A picture that shows nothing earns nothing and ends the episode.
    """
    states, pairs = _pairs(questions)
    goes_on, reward = _empty(states, rules.n_actions)
    for (state, action), rows in pairs.items():
        place = action, states[state]
        for row in rows:
            for slot, weight in enumerate(answers.weights[row, :, 0] / len(rows)):
                after = tuple(answers.states[row, slot, 0].tolist())
                ruled = rules.judge(state, action, after) if weight and after[0] >= 0 else None
                earned = 0.0 if ruled is None else ruled.reward
                ends = 1.0 if ruled is None else float(ruled.terminated)
                earned = earned if answers.rewards is None else float(answers.rewards[row, slot, 0])
                ends = ends if answers.p_ended is None else float(answers.p_ended[row, slot, 0])
                reward[place] += weight * earned
                if after in states:
                    goes_on[(*place, states[after])] += weight * (1.0 - ends)
    return Machine(states=tuple(states), goes_on=goes_on, reward=reward)


def optimal_plan(machine: Machine, horizon: int, allowed: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """The best action with each number of actions left, the lowest index among equals. Shape (horizon, X).

    ``allowed`` (A, X) leaves actions out, where any other is left.
    """
    values = np.zeros(len(machine.states))
    plan = np.zeros((horizon, len(values)), dtype=np.int64)
    for left in range(horizon):
        actions = machine.reward + machine.goes_on @ values  # [A, X]
        if allowed is not None:
            actions = np.where(allowed | ~allowed.any(axis=0), actions, -np.inf)
        values = actions.max(axis=0)
        plan[left] = (actions >= values - _TIE).argmax(axis=0)
    return plan


def plan_values(machine: Machine, plan: NDArray[np.int64]) -> Floats:
    """Expected return of a plan from each macrostate, with all actions left. Shape (X,)."""
    values, every = np.zeros(len(machine.states)), np.arange(len(machine.states))
    for actions in plan:
        values = machine.reward[actions, every] + np.einsum("xy,y->x", machine.goes_on[actions, every], values)
    return values


def value_losses(exact: Machine, imagined: Machine, starts: tuple[State, ...], horizon: int) -> Floats:
    """V* - V of the policy that is optimal in the model, at least 0, by start. Shape (starts,)."""
    rows = [exact.states.index(state) for state in starts]
    best = plan_values(exact, optimal_plan(exact, horizon))
    found = plan_values(exact, optimal_plan(imagined, horizon))
    return np.asarray(np.maximum(best - found, 0.0)[rows])


def worth_of_refusing(
    unknown: Floats, exact: Machine, imagined: Machine, starts: tuple[State, ...], horizon: int
) -> float:
    """Reward a start that planning gains where it avoids the macro-actions that the model knows least of.

    ``unknown`` (A, X) is the epistemic uncertainty. The share that is avoided is the best of 5, 10, 20, 30, 40 and
    50 %, chosen with the truth; 0 where none gains.
    """
    masks = [unknown <= np.quantile(unknown, 1.0 - share) for share in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)]
    return max(0.0, *(_gained(mask, exact, imagined, starts, horizon) for mask in masks))


def worth_of_filter(kept: Floats, exact: Machine, imagined: Machine, starts: tuple[State, ...], horizon: int) -> float:
    """The same where it avoids what the model's own filter discards; ``kept`` (A, X) is the share that it keeps."""
    return _gained(kept >= _MOST, exact, imagined, starts, horizon)


def _gained(
    allowed: NDArray[np.bool_], exact: Machine, imagined: Machine, starts: tuple[State, ...], horizon: int
) -> float:
    rows = [exact.states.index(state) for state in starts]
    plans = [optimal_plan(imagined, horizon, mask) for mask in (None, allowed)]
    without, within = (plan_values(exact, plan)[rows].mean() for plan in plans)
    return float(within - without)


def mean_by_pair(questions: Questions, values: NDArray[Any]) -> Floats:
    """Means of one number a question, (N,), by macro-action and macrostate asked about. Shape (A, X)."""
    states, pairs = _pairs(questions)
    found = np.zeros((1 + max(action for _, action in pairs), len(states)))
    for (state, action), rows in pairs.items():
        found[action, states[state]] = values[rows].mean()
    return found


def regrets(questions: Questions, answers: Answers, rules: Rules) -> Floats:
    """Of each start's sequences: the exact return of the best, less that of the one the model ranks first."""
    exact = np.array([sum(map(expected_reward, steps)) for steps in questions.truth]).reshape(-1, RANKED)
    earned = answers.rewards
    if earned is None:
        earned = _ruled_rewards(questions, answers, rules)
    imagined = (answers.weights * earned).sum(axis=(1, 2)).reshape(-1, RANKED)
    first = (imagined >= imagined.max(axis=1, keepdims=True) - _TIE).argmax(axis=1)
    return np.asarray(exact.max(axis=1) - np.take_along_axis(exact, first[:, None], axis=1)[:, 0])


def _ruled_rewards(questions: Questions, answers: Answers, rules: Rules) -> Floats:
    """What the rules give for imagined futures, nothing once one has ended or shows nothing. Shape (N, S, D)."""
    rewards = np.zeros(answers.weights.shape)
    futures = answers.weights.shape[1]
    for row, (start, actions) in enumerate(zip(questions.states, questions.asked.tolist(), strict=True)):
        for slot in range(futures):
            state = start
            for step, action in enumerate(actions):
                after = tuple(answers.states[row, slot, step].tolist())
                if after[0] < 0:
                    break
                ruled = rules.judge(state, action, after)
                rewards[row, slot, step] = ruled.reward
                if ruled.terminated:
                    break
                state = after
    return rewards


def _pairs(questions: Questions) -> tuple[dict[State, int], dict[tuple[State, int], list[int]]]:
    """Rows of the macrostates asked about, and of the questions of each (macrostate, action)."""
    pairs: dict[tuple[State, int], list[int]] = {}
    for row, (state, action) in enumerate(zip(questions.states, questions.asked[:, 0].tolist(), strict=True)):
        pairs.setdefault((state, action), []).append(row)
    return {state: index for index, state in enumerate(dict.fromkeys(questions.states))}, pairs


def _empty(states: dict[State, int], n_actions: int) -> tuple[Floats, Floats]:
    return np.zeros((n_actions, len(states), len(states))), np.zeros((n_actions, len(states)))
