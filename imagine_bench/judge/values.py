"""What mistakes cost: plans that are optimal in a model, and policies of agents, followed by the exact rules.

No episode is sampled. A test says how often an agent succeeds; :func:`terminations` says from which starts it does not,
and how: a termination that is no success, or out of time, and then whether it would have come to a success, to another
termination, or to none at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Floats, Rules, State, TaskSpec
from imagine_bench.judge.predictions import Predictions
from imagine_bench.judge.questions import RANKED, EvalSet
from imagine_bench.judge.truth import expected_reward
from imagine_bench.rules import evaluate, greedy, optimal_policy, tabulate

_TIE = 1e-9
_PATIENCE = 1_000  # macro-actions after which a termination is taken for one that never comes


@dataclass(frozen=True, kw_only=True)
class DecisionTables:
    """Macrostates in which episodes go on, X of them, and what macro-actions do there, as somebody has it."""

    states: tuple[State, ...]
    goes_on: Floats  #: Probability that the episode goes on in each of them. Shape (A, X, X).
    reward: Floats  #: Expected reward. Shape (A, X).


def exact_machine(questions: EvalSet, n_actions: int) -> DecisionTables:
    """As the rules have it."""
    states, pairs = _pairs(questions)
    goes_on, reward = _empty(states, n_actions)
    for (state, action), rows in pairs.items():
        outcomes = questions.truth[rows[0]][0]
        reward[action, states[state]] = expected_reward(outcomes)
        for (after, over), (share, _) in outcomes.items():
            if not over and after in states:
                goes_on[action, states[state], states[after]] += share
    return DecisionTables(states=tuple(states), goes_on=goes_on, reward=reward)


def imagined_machine(questions: EvalSet, predictions: Predictions, rules: Rules) -> DecisionTables:
    """As a model has it; rewards and ends that it does not offer are those of the rules for what it imagines.

    An unreadable image earns nothing and ends the episode.
    """
    states, pairs = _pairs(questions)
    goes_on, reward = _empty(states, rules.n_actions)
    for (state, action), rows in pairs.items():
        place = action, states[state]
        for row in rows:
            for slot, weight in enumerate(predictions.weights[row, :, 0] / len(rows)):
                after = tuple(predictions.states[row, slot, 0].tolist())
                ruled = rules.judge(state, action, after) if weight and after[0] >= 0 else None
                earned = 0.0 if ruled is None else ruled.reward
                ends = 1.0 if ruled is None else float(ruled.terminated)
                earned = earned if predictions.rewards is None else float(predictions.rewards[row, slot, 0])
                ends = ends if predictions.p_ended is None else float(predictions.p_ended[row, slot, 0])
                reward[place] += weight * earned
                if after in states:
                    goes_on[(*place, states[after])] += weight * (1.0 - ends)
    return DecisionTables(states=tuple(states), goes_on=goes_on, reward=reward)


def optimal_plan(machine: DecisionTables, horizon: int, allowed: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
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


def plan_values(machine: DecisionTables, plan: NDArray[np.int64]) -> Floats:
    """Expected return of a plan from each macrostate, with all actions left. Shape (X,)."""
    values = np.zeros(len(machine.states))
    every = np.arange(len(machine.states))
    for actions in plan:
        values = machine.reward[actions, every] + np.einsum("xy,y->x", machine.goes_on[actions, every], values)
    return values


def value_losses(exact: DecisionTables, imagined: DecisionTables, starts: tuple[State, ...], horizon: int) -> Floats:
    """V* - V of the policy that is optimal in the model, at least 0, by start. Shape (starts,)."""
    rows = [exact.states.index(state) for state in starts]
    best = plan_values(exact, optimal_plan(exact, horizon))
    found = plan_values(exact, optimal_plan(imagined, horizon))
    return np.asarray(np.maximum(best - found, 0.0)[rows])


def value_of_abstaining(
    exact: DecisionTables,
    imagined: DecisionTables,
    starts: tuple[State, ...],
    horizon: int,
    allowed: NDArray[np.bool_],
) -> float:
    """Reward a start that planning in a model gains where it avoids the macro-actions that are not ``allowed`` (A, X).

    An action is avoided only where another is allowed.
    """
    rows = [exact.states.index(state) for state in starts]
    usual = plan_values(exact, optimal_plan(imagined, horizon))
    restricted = plan_values(exact, optimal_plan(imagined, horizon, allowed))
    return float(restricted[rows].mean() - usual[rows].mean())


def mean_by_pair(questions: EvalSet, values: Floats) -> Floats:
    """Means of one number a question, (N,), by macro-action and macrostate asked about. Shape (A, X)."""
    states, pairs = _pairs(questions)
    found = np.zeros((1 + max(action for _, action in pairs), len(states)))
    for (state, action), rows in pairs.items():
        found[action, states[state]] = values[rows].mean()
    return found


def regrets(questions: EvalSet, predictions: Predictions, rules: Rules) -> Floats:
    """Of each start's sequences: the exact return of the best, less that of the one the model ranks first."""
    exact = np.array([sum(map(expected_reward, steps)) for steps in questions.truth]).reshape(-1, RANKED)
    earned = predictions.rewards
    if earned is None:
        earned = _ruled_rewards(questions, predictions, rules)
    imagined = (predictions.weights * earned).sum(axis=(1, 2)).reshape(-1, RANKED)
    first = (imagined >= imagined.max(axis=1, keepdims=True) - _TIE).argmax(axis=1)
    return np.asarray(exact.max(axis=1) - np.take_along_axis(exact, first[:, None], axis=1)[:, 0])


def _ruled_rewards(questions: EvalSet, predictions: Predictions, rules: Rules) -> Floats:
    """What the rules give for imagined futures, nothing once one has ended or shows nothing. Shape (N, S, D)."""
    rewards = np.zeros(predictions.weights.shape)
    futures = predictions.weights.shape[1]
    for row, (start, actions) in enumerate(zip(questions.states, questions.asked.tolist(), strict=True)):
        for slot in range(futures):
            state = start
            for step, action in enumerate(actions):
                after = tuple(predictions.states[row, slot, step].tolist())
                if after[0] < 0:
                    break
                ruled = rules.judge(state, action, after)
                rewards[row, slot, step] = ruled.reward
                if ruled.terminated:
                    break
                state = after
    return rewards


def _pairs(questions: EvalSet) -> tuple[dict[State, int], dict[tuple[State, int], list[int]]]:
    """Rows of the macrostates asked about, and of the questions of each (macrostate, action)."""
    pairs: dict[tuple[State, int], list[int]] = {}
    for row, (state, action) in enumerate(zip(questions.states, questions.first_actions, strict=True)):
        pairs.setdefault((state, action), []).append(row)
    return {state: index for index, state in enumerate(dict.fromkeys(questions.states))}, pairs


def _empty(states: dict[State, int], n_actions: int) -> tuple[Floats, Floats]:
    return np.zeros((n_actions, len(states), len(states))), np.zeros((n_actions, len(states)))


@dataclass(frozen=True, kw_only=True)
class Terminations:
    """How episodes of one agent terminate by the rules, from each of the S start macrostates. Each of shape (S,)."""

    success: Floats  # probability of a success within the horizon
    failure: Floats  # probability of another termination within the horizon
    late_success: Floats  # probability of a success after the horizon, if episodes went on there
    late_failure: Floats  # probability of another termination after it
    length: Floats  # expected macro-actions within the horizon

    @property
    def endless(self) -> Floats:
        """Probability of what remains: no termination at all."""
        ended = self.success + self.failure + self.late_success + self.late_failure
        return np.maximum(0.0, 1.0 - ended)  # but for rounding


def optimal_length(spec: TaskSpec, starts: Sequence[State]) -> Floats:
    """Expected macro-actions of an optimal agent within the horizon, from each start. Shape (S,)."""
    tables = tabulate(spec.rules)
    best = greedy(optimal_policy(tables), spec.n_actions)
    return evaluate(tables, best, spec.horizon).length[[tables.index[start] for start in starts]]


def terminations(spec: TaskSpec, policy: Floats, starts: Sequence[State]) -> Terminations:
    """Follow a policy from S starts by the rules; its probabilities are (A, X), of the X macrostates of the rules."""
    tables = tabulate(spec.rules)
    within = evaluate(tables, policy, spec.horizon)
    patient = evaluate(tables, policy, max(spec.horizon, _PATIENCE))
    rows = [tables.index[start] for start in starts]
    return Terminations(
        success=within.success[rows],
        failure=within.failure[rows],
        late_success=(patient.success - within.success)[rows],
        late_failure=(patient.failure - within.failure)[rows],
        length=within.length[rows],
    )
