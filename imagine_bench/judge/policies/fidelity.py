"""Behavioral fidelity: how much of a policy's return survives when it sees a model's frames instead of real ones.

After WorldModelGym (reka.ai, 2026). Both begin with one real frame. From then on the model imagines each next frame
from its own latest one and the macro-action that the policy takes, and the world goes its own way. Here the pair of
both is enumerated; where chance decides, the luck of model and world is independent, so that even *exact* is below 1.

Shapes: ``S`` macrostates, ``A`` macro-actions; macrostate S of a model is an image of none in which an episode goes on.
"""

from __future__ import annotations

import math

import numpy as np

from imagine_bench.arrays import Floats
from imagine_bench.exact.values import TIE
from imagine_bench.judge.policies.agreement import DenseModel
from imagine_bench.judge.policies.policy_set import PolicyWorld


def value_in_its_frames(truth: DenseModel, model: DenseModel, policy: Floats, horizon: int) -> Floats:
    """The true return of a policy (S, A) that sees the model's frames, from each macrostate. Shape (S,).

    Where the model shows no macrostate in which an episode goes on, macro-actions are random from then on.
    """
    n_states, n_actions = policy.shape
    acts = np.concatenate([policy, np.full((1, n_actions), 1.0 / n_actions)])
    imagined = np.zeros((n_states + 1, n_actions, n_states + 1))
    imagined[:-1, :, :-1] = model.onward
    imagined[:, :, -1] = 1.0 - imagined.sum(axis=2)
    values = np.zeros((n_states, n_states + 1))  # by the macrostate of the world and that of the model
    for _ in range(horizon):
        found = truth.reward @ acts.T
        for action, share in enumerate(acts.T):
            found += share * (truth.onward[:, action] @ values @ imagined[:, action].T)
        values = found
    return np.diagonal(values)


def fidelity(world: PolicyWorld, model: DenseModel) -> float:
    """The part of the optimal policy's gain over random macro-actions that survives in the model's frames.

    1 is all of it; below 0 the policy does worse than at random. NaN where nothing is to be gained.
    """
    at = {name: row for row, name in enumerate(world.policies.names)}
    best = world.real[at["optimal"]]
    chance = world.real[at["uniform"]]
    if best - chance <= TIE:
        return math.nan
    policy = world.policies.tables[at["optimal"]]
    survives = world.starts @ value_in_its_frames(world.dense_truth, model, policy, world.horizon)
    return float((survives - chance) / (best - chance))
