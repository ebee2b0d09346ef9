"""The policies of a world that models are judged by: the same for all, made of the rules and of fixed seeds alone."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats, Ints, State, content_hash
from imagine_bench.exact.changed_rules import one_change_each
from imagine_bench.exact.values import TIE, Branches, Model, action_values, branches, model_of
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.policies.agreement import DenseModel, dense, values_of
from imagine_bench.seeding import SeedTree

BUDGETS = (30, 100, 300, 1_000)
"""Episodes of Q-learning after which its greedy policy is kept."""
SEEDS = 3
_NOISE = (0.1, 0.25, 0.5, 0.75, 0.9)  # shares of the uniform policy in mixtures with the optimal one
_GOALS = 4  # macrostates that become the goal
_DRAWN = 4  # random policies, deterministic ones and others
_RATE = 0.5  # learning rate of Q-learning
_EXPLORES = 0.2  # share of its macro-actions that are random


class PolicySet(NamedTuple):
    """N policies, each a table of probabilities."""

    names: tuple[str, ...]
    tables: Floats  # probability of each macro-action. Shape (N, S, A).

    @property
    def digest(self) -> str:
        """Of the names and tables, to six decimals."""
        return content_hash(dict(zip(self.names, self.tables.round(6), strict=True)))[:12]


class PolicyWorld(NamedTuple):
    """A world's policies, and their values in it."""

    states: tuple[State, ...]  # length S
    starts: Floats  # probability of each macrostate at the start of an episode. Shape (S,).
    horizon: int
    truth: Model
    dense_truth: DenseModel
    policies: PolicySet
    real: Floats  # expected return of each policy from the starts. Shape (N,).


def policy_world(spec: TaskSpec, states: Sequence[State]) -> PolicyWorld | None:
    """The policies of a world whose episodes can be in ``states``; None where some starts are not among them."""
    if not set(spec.rules.start_states) <= set(states):
        return None
    found = branches(states, spec.n_actions, spec.rules.outcomes)
    truth = model_of(found)
    starts = np.zeros(len(states))
    starts[[states.index(start) for start in spec.rules.start_states]] = 1.0 / len(spec.rules.start_states)
    held = dense(truth)
    policies = policy_set(spec, states, found)
    real = values_of(held, policies.tables, spec.horizon) @ starts
    return PolicyWorld(tuple(states), starts, spec.horizon, truth, held, policies, real)


def policy_set(spec: TaskSpec, states: Sequence[State], found: Branches) -> PolicySet:
    """Random, optimal, noisy, wrongly optimal, trained and adversarial policies of a world.

    Args:
        spec: The task.
        states: The macrostates that an episode can be in.
        found: The outcomes of every macro-action there.
    """
    rules = spec.rules
    truth = model_of(found)
    best = functools.partial(_optimal, horizon=spec.horizon)
    uniform = np.full(truth.reward.shape, 1.0 / spec.n_actions)
    optimal = best(truth)
    worst = best(truth._replace(reward=-truth.reward))
    tables = {"uniform": uniform, "optimal": optimal, "worst": worst, "half worst": 0.5 * worst + 0.5 * uniform}
    for share in _NOISE:
        tables[f"optimal, {share:.0%} random"] = (1.0 - share) * optimal + share * uniform
    rng = SeedTree(0).child("evaluation", "judge", "policies", spec.id).generator()
    for number in range(_DRAWN):
        tables[f"drawn {number}"] = np.eye(spec.n_actions)[rng.integers(spec.n_actions, size=len(states))]
        tables[f"drawn with probabilities {number}"] = rng.dirichlet(np.ones(spec.n_actions), size=len(states))
    chosen = [states[row] for row in rng.choice(len(states), min(_GOALS, len(states)), replace=False)]
    goals = {", ".join(spec.value_names(state)): state for state in chosen}
    for name, dynamics in one_change_each(rules, states, goals).items():
        tables[f"optimal if {name}"] = best(model_of(branches(states, spec.n_actions, dynamics)))
    starts = np.array([states.index(start) for start in rules.start_states])
    for seed in range(SEEDS):
        for episodes, table in zip(BUDGETS, _learned(found, starts, spec.horizon, rng), strict=True):
            tables[f"Q-learning, {episodes} episodes, seed {seed}"] = table
    return PolicySet(tuple(tables), np.array(list(tables.values())))


def _optimal(model: Model, horizon: int) -> Floats:
    """Whatever is left of an episode, the macro-action that is best at its beginning. Shape (S, A)."""
    return _greedy(action_values(model, horizon)[-1])


def _greedy(values: Floats) -> Floats:
    """The macro-action of the largest value, of equals the first, as probabilities. Shape (S, A)."""
    first = (values >= values.max(axis=1, keepdims=True) - TIE).argmax(axis=1)
    return np.eye(values.shape[1])[first]


def _learned(found: Branches, starts: Ints, horizon: int, rng: np.random.Generator) -> list[Floats]:
    """Greedy policies of one tabular Q-learning (Watkins, 1989), without discount, after each of its budgets."""
    n_states, n_actions, _ = found.probability.shape
    upto = found.probability.cumsum(axis=2)
    upto /= upto[:, :, -1:]
    values = np.zeros((len(found.states), n_actions))
    tables = []
    for episode in range(1, 1 + BUDGETS[-1]):
        state = starts[rng.integers(len(starts))]
        for _ in range(horizon):
            explores = rng.random() < _EXPLORES
            action = rng.integers(n_actions) if explores else values[state].argmax()
            branch = int((upto[state, action] <= rng.random()).sum())
            over = found.terminated[state, action, branch]
            after = found.following[state, action, branch]
            target = found.reward[state, action, branch] + (0.0 if over else values[after].max())
            values[state, action] += _RATE * (target - values[state, action])
            if over or after >= n_states:
                break
            state = after
        if episode in BUDGETS:
            tables.append(_greedy(values[:n_states]))
    return tables
