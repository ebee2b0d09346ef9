"""What a trained agent would do in every macrostate, and where that leads by the rules: no episode is sampled.

A test says how often an agent succeeds. This says from which starts it does not, and how: an end that is no success, a
success that comes too late, or neither, however long it goes on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Agent, Frame, Observation, TaskSpec
from imagine_bench.rules import evaluate, greedy, optimal_policy, tabulate
from imagine_bench.seeding import Purpose, SeedTree

_PATIENCE = 1_000
"""Macro-actions after which a success is taken for one that never comes."""


@dataclass(frozen=True, kw_only=True)
class Situations:
    """Every macrostate of a task that no episode ends in, and a frame of it. N of them.

    Attributes:
        macrostates: Shape (N, M).
        frames: Kinematic mode. Shape (N, 64, 64, 3).
    """

    macrostates: NDArray[np.int64]
    frames: Frame


@dataclass(frozen=True, kw_only=True)
class Ends:
    """How episodes of one agent end by the rules, from each of the S start macrostates. Each of shape (S,).

    Attributes:
        success: Probability of a success within the horizon.
        failure: Probability of another end within the horizon.
        late: Probability of a success after the horizon, if episodes went on there.
        length: Expected macro-actions within the horizon.
        shortest: The same of an optimal agent.
    """

    success: NDArray[np.float64]
    failure: NDArray[np.float64]
    late: NDArray[np.float64]
    length: NDArray[np.float64]
    shortest: NDArray[np.float64]

    @property
    def never(self) -> NDArray[np.float64]:
        """Probability of what remains: out of time at the horizon, and no success after it."""
        return np.maximum(0.0, 1.0 - self.success - self.failure - self.late)  # but for rounding


def situations(spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> Situations:
    """All that an agent of a task may meet; the frames are the same for every agent."""
    macrostates = np.array([state for state in spec.rules.states if not spec.rules.is_terminal(state)], dtype=np.int64)
    rng = SeedTree(0).child(purpose, "policy", spec.id).generator()
    return Situations(macrostates=macrostates, frames=spec.render_macrostates(macrostates, appearance, rng))


def choices(agent: Agent, met: Situations) -> NDArray[np.int64]:
    """The greedy macro-action of an agent in each situation; it is not changed. Shape (N,)."""
    actions = [agent.act(Observation(frame=frame), explore=False) for frame in met.frames]
    return np.array(actions, dtype=np.int64)


def follow(spec: TaskSpec, met: Situations, actions: NDArray[np.int64]) -> Ends:
    """Follow a policy from every start, by the rules.

    Args:
        spec: The task.
        met: All situations.
        actions: What is done in each of them. Shape (N,).
    """
    rules, tables = spec.rules, tabulate(spec.rules)
    policy = np.zeros(len(tables.index), dtype=np.int64)  # any action where episodes have ended
    policy[[tables.index[tuple(state)] for state in met.macrostates.tolist()]] = actions
    chosen = greedy(policy, rules.n_actions)
    within = evaluate(tables, chosen, spec.horizon)
    patient = evaluate(tables, chosen, max(spec.horizon, _PATIENCE))
    optimal = evaluate(tables, greedy(optimal_policy(tables), rules.n_actions), spec.horizon)
    return Ends(
        success=within.success[tables.starts],
        failure=within.failure[tables.starts],
        late=(patient.success - within.success)[tables.starts],
        length=within.length[tables.starts],
        shortest=optimal.length[tables.starts],
    )
