"""Values of policies by enumeration: the outcomes of macro-actions as arrays, and plans that are optimal in them.

Shapes: ``S`` macrostates, ``A`` macro-actions, ``B`` branches, ``H`` the horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Bools, Floats, Ints, State
from imagine_bench.rules import Dynamics, Rules, every_outcome

TIE = 1e-9
"""Values that differ by no more are equal: rounding alone may part them."""
NEVER = -1e6
"""Reward of a macro-action that was never tried, for an agent that has nothing but its experience."""


class Branches(NamedTuple):
    """Outcomes of every macro-action in some macrostates, in the order of the rules; those missing have no share."""

    states: tuple[State, ...]  # those asked about, and behind them whatever else is reached
    following: Ints  # rows of ``states``. Shape (S, A, B).
    probability: Floats  # shape (S, A, B)
    reward: Floats  # shape (S, A, B)
    terminated: Bools  # shape (S, A, B)


def branches(states: Sequence[State], n_actions: int, dynamics: Dynamics) -> Branches:
    """Write out the possible outcomes of macro-actions in some macrostates."""
    found = every_outcome(states, n_actions, dynamics, follow=False)
    pair = found.before * n_actions + found.action
    branch = np.arange(len(pair)) - np.searchsorted(pair, pair)
    table = np.zeros((4, len(states) * n_actions, 1 + int(branch.max())))
    table[:, pair, branch] = found.after, found.probability, found.reward, found.terminated
    following, probability, reward, terminated = table.reshape(4, len(states), n_actions, -1)
    return Branches(tuple(found.index), following.astype(np.int64), probability, reward, terminated.astype(bool))


class Model(NamedTuple):
    """Outcomes that a model or the rules expect in S macrostates. A sum of probabilities below 1 is an end."""

    following: Ints  # rows of macrostates, S for a state that is none of them. Shape (S, A, B).
    p_continues: Floats  # shape (S, A, B)
    reward: Floats  # expected reward. Shape (S, A).


def true_model(rules: Rules, states: Sequence[State]) -> Model:
    """The rules as a model of some macrostates."""
    return model_of(branches(states, rules.n_actions, rules.outcomes))


def model_of(found: Branches) -> Model:
    """Outcomes as a model of the macrostates that were asked about."""
    states = found.following
    following = np.minimum(states, len(states))
    expected = (found.probability * found.reward).sum(axis=2)
    return Model(following, found.probability * ~found.terminated, expected)


def rows_of(macrostates: NDArray[np.integer], states: Sequence[State]) -> Ints:
    """The row of each macrostate (..., M) among S; S for a state that is none of them. Shape (...)."""
    index = {state: row for row, state in enumerate(states)}
    flat = macrostates.reshape(-1, macrostates.shape[-1]).tolist()
    return np.array([index.get(tuple(each), len(states)) for each in flat], dtype=np.int64).reshape(
        macrostates.shape[:-1]
    )


def action_values(model: Model, horizon: int, allowed: Bools | None = None) -> Floats:
    """The largest expected return of each macro-action with 1 to H of them left. Shape (H, S, A).

    ``allowed`` (S, A) leaves macro-actions out, where any other is left.
    """
    values = np.zeros(len(model.reward) + 1)  # the last is that of a state that is no macrostate
    found = []
    for _ in range(horizon):
        of_actions = model.reward + (model.p_continues * values[model.following]).sum(axis=2)
        if allowed is not None:
            of_actions = np.where(allowed | ~allowed.any(axis=1, keepdims=True), of_actions, -np.inf)
        values[:-1] = of_actions.max(axis=1)
        found.append(of_actions)
    return np.array(found)


def values_of_planning(truth: Model, model: Model, horizon: int, allowed: Bools | None = None) -> Floats:
    """Expected return, by the truth, of the plan that is optimal in a model, of equals the first. Shape (S,).

    ``allowed`` is as in :func:`action_values`.
    """
    planned = action_values(model, horizon, allowed)
    plan = (planned >= planned.max(axis=2, keepdims=True) - TIE).argmax(axis=2)
    every = np.arange(len(truth.reward))
    values = np.zeros(len(every) + 1)
    for actions in plan:
        onward = truth.p_continues[every, actions] * values[truth.following[every, actions]]
        values[:-1] = truth.reward[every, actions] + onward.sum(axis=1)
    return values[:-1]
