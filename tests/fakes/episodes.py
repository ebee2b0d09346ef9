"""Worlds as plain arrays, many episodes of them at once, and two solvers; none of it is code of the package.

Shapes: ``A`` macro-actions, ``S`` states, ``K`` outcomes at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, eye_array, kron

EPISODES = 100_000


@dataclass(frozen=True)
class Arrays:
    """Outcomes of each action in each state: where they lead, their probability, whether they end, and succeed."""

    starts: np.ndarray  # (N,)
    reached: np.ndarray  # (A, S, K)
    share: np.ndarray
    ends: np.ndarray
    wins: np.ndarray


def arrays_of(starts, n_actions, outcomes):
    """Those of all states that starts lead to; ``outcomes(state, action)`` gives (state, probability, end, success)."""
    index = {state: row for row, state in enumerate(starts)}
    states, found = list(index), {}
    for state in states:  # grows
        for action in range(n_actions):
            found[action, index[state]] = list(outcomes(state, action))
            for reached, *_ in found[action, index[state]]:
                if reached not in index:
                    index[reached] = len(index)
                    states.append(reached)
    shape = n_actions, len(index), max(map(len, found.values()))
    reached, share, ends, wins = np.zeros(shape, int), np.zeros(shape), np.zeros(shape, bool), np.zeros(shape, bool)
    for (action, row), each in found.items():
        after, share[action, row, : len(each)], *kinds = zip(*each, strict=True)
        reached[action, row, : len(each)] = [index[state] for state in after]
        ends[action, row, : len(each)], wins[action, row, : len(each)] = kinds
    return Arrays(np.array([index[state] for state in starts]), reached, share, ends, wins)


def arrays_of_rules(rules):
    def outcomes(state, action):
        return [(o.macrostate, o.probability, o.terminated, o.success) for o in rules.outcomes(state, action)]

    return arrays_of(rules.start_states, rules.n_actions, outcomes)


def simulated(world, horizon, policy, seed):
    """Share of successes among 100,000 episodes; ``policy`` (horizon, S) gives actions, None draws them."""
    rng = np.random.default_rng(seed)
    row = world.starts[rng.integers(len(world.starts), size=EPISODES)]
    limits, going, won = world.share.cumsum(axis=2), np.ones(EPISODES, bool), np.zeros(EPISODES, bool)
    for step in range(horizon):
        action = rng.integers(len(limits), size=EPISODES) if policy is None else policy[step, row]
        drawn = (rng.random((EPISODES, 1)) > limits[action, row]).sum(axis=1).clip(max=limits.shape[2] - 1)
        won |= going & world.wins[action, row, drawn]
        going &= ~world.ends[action, row, drawn]
        row = world.reached[action, row, drawn]
    return won.mean()


def solved(world, horizon):
    """Largest success probability and that of random actions, means over starts, and a best policy (horizon, S)."""
    best, chance = np.zeros(world.reached.shape[1]), np.zeros(world.reached.shape[1])
    policy = np.zeros((horizon, len(best)), int)
    for step in reversed(range(horizon)):
        best_of, chance_of = (
            (world.share * np.where(world.ends, world.wins, value[world.reached])).sum(axis=2)  # [A, S]
            for value in (best, chance)
        )
        policy[step], best, chance = best_of.argmax(axis=0), best_of.max(axis=0), chance_of.mean(axis=0)
    return best[world.starts].mean(), chance[world.starts].mean(), policy


def solved_as_a_flow(world, horizon):
    """The largest success probability by linear programming: how often each (step, state, action) comes up at most."""
    n_actions, states, _ = world.reached.shape
    action, state, _ = np.indices(world.reached.shape)
    goes_on = (world.share * ~world.ends).ravel()
    pair = (state * n_actions + action).ravel()
    into = coo_array((goes_on, (world.reached.ravel(), pair)), shape=(states, states * n_actions))
    out_of = kron(eye_array(states), np.ones((1, n_actions)))
    conserved = kron(eye_array(horizon), out_of) - kron(eye_array(horizon, k=-1), into)
    begins = np.bincount(world.starts, minlength=states) / len(world.starts)
    supply = np.concatenate([begins, np.zeros(states * (horizon - 1))])
    wins = (world.share * world.wins).sum(axis=2).T.ravel()  # [S A]
    return -linprog(-np.tile(wins, horizon), A_eq=conserved.tocsr(), b_eq=supply).fun
