"""Agents that train in a model alone, and the same agents on the model's data alone, by tabular Q-learning.

An agent learns from one macro-action after another, each time with the expected value of its outcomes (Watkins, 1989;
with the expected update of Sutton and Barto, 2018, 8.5). Nothing is discounted.

Shapes: ``G`` agents, ``S`` macrostates, ``A`` macro-actions.
"""

from __future__ import annotations

import numpy as np

from imagine_bench.arrays import Floats
from imagine_bench.exact.values import NEVER, Model

AGENTS = 16
"""Agents that train at a time, each with random numbers of its own; a score is the mean over them."""
UPDATES = 5_000
"""Transitions that an agent learns from, one after another."""
RATE = 0.5
EXPLORES = 0.2
"""Share of the macro-actions in imagined episodes that are random."""


def trained(model: Model, rng: np.random.Generator, episodes: tuple[Floats, int] | None = None) -> Floats:
    """Greedy policies of agents that learned in a model. Shape (G, S, A).

    Args:
        model: Outcomes; a macro-action with the reward :data:`.NEVER` was never tried.
        rng: Draws all random numbers.
        episodes: Probability of each macrostate at the start, (S,), and the horizon of imagined episodes. Without it
            agents learn from macro-actions that are drawn from all that were tried, and choose no other one where any
            was tried.
    """
    n_states, n_actions = model.reward.shape
    tried = model.reward > NEVER
    untried = np.where(tried | ~tried.any(axis=1, keepdims=True), 0.0, NEVER)
    pairs = np.argwhere(tried)
    upto = model.p_continues.cumsum(axis=2)
    following = np.concatenate([model.following, np.full((n_states, n_actions, 1), n_states)], axis=2)
    values = np.zeros((AGENTS, n_states + 1, n_actions))
    values[:, :-1] += untried
    each = np.arange(AGENTS)
    state = np.full(AGENTS, n_states)
    left = np.zeros(AGENTS, dtype=np.int64)
    for _ in range(UPDATES):
        if episodes is None:
            state, action = pairs[rng.integers(len(pairs), size=AGENTS)].T
        else:
            begins = (state == n_states) | (left == 0)
            state = np.where(begins, rng.choice(n_states, AGENTS, p=episodes[0]), state)
            left = np.where(begins, episodes[1], left) - 1
            explores = rng.random(AGENTS) < EXPLORES
            action = np.where(explores, rng.integers(n_actions, size=AGENTS), values[each, state].argmax(axis=1))
        branch = (upto[state, action] <= rng.random((AGENTS, 1))).sum(axis=1)
        onward = values[each[:, None], model.following[state, action]].max(axis=2)  # [G, B]
        target = model.reward[state, action] + (model.p_continues[state, action] * onward).sum(axis=1)
        values[each, state, action] += RATE * (target - values[each, state, action])
        state = following[state, action, branch]
    return np.eye(n_actions)[values[:, :-1].argmax(axis=2)]
