"""What a trained agent would do in every macrostate, and where that leads by the rules: no episode is sampled.

A test says how often an agent succeeds. This says from which starts it does not, and how: an end that is no success, or
out of time, and then whether it would have come to a success, to another end, or to none however long.

An agent sees a macrostate in many frames, and may do one thing in some of them and another in others; here every visit
of a macrostate shows it in one of ``F`` frames, drawn anew. In a real episode the frames of two visits are more alike,
so who goes to and fro stays there a little longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Agent, Observation, TaskSpec
from imagine_bench.rules import evaluate, greedy, optimal_policy, tabulate
from imagine_bench.seeding import Purpose, SeedTree

FRAMES = 16
"""Frames of a macrostate, F."""
_PATIENCE = 1_000
"""Macro-actions after which an end is taken for one that never comes."""


@dataclass(frozen=True, kw_only=True)
class Situations:
    """Every macrostate of a task that no episode ends in, N of them, and what it looks like.

    Attributes:
        macrostates: Shape (N, M).
        frames: Of each of them, kinematic mode. Shape (N, F, 64, 64, 3).
    """

    macrostates: NDArray[np.int64]
    frames: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Ends:
    """How episodes of one agent end by the rules, from each of the S start macrostates. Each of shape (S,).

    Attributes:
        success: Probability of a success within the horizon.
        failure: Probability of another end within the horizon.
        late_success: Probability of a success after the horizon, if episodes went on there.
        late_failure: Probability of another end after it.
        length: Expected macro-actions within the horizon.
    """

    success: NDArray[np.float64]
    failure: NDArray[np.float64]
    late_success: NDArray[np.float64]
    late_failure: NDArray[np.float64]
    length: NDArray[np.float64]

    @property
    def endless(self) -> NDArray[np.float64]:
        """Probability of what remains: no end at all."""
        ended = self.success + self.failure + self.late_success + self.late_failure
        return np.maximum(0.0, 1.0 - ended)  # but for rounding


def situations(spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> Situations:
    """All that an agent of a task may meet, each in :data:`FRAMES` frames, the same for every agent."""
    macrostates = np.array([state for state in spec.rules.states if not spec.rules.is_terminal(state)], dtype=np.int64)
    rng = SeedTree(0).child(purpose, "policy", spec.id).generator()
    frames = spec.render_macrostates(np.repeat(macrostates, FRAMES, axis=0), appearance, rng)
    return Situations(macrostates=macrostates, frames=frames.reshape(len(macrostates), FRAMES, *frames.shape[1:]))


def choices(agent: Agent, met: Situations, n_actions: int) -> NDArray[np.float64]:
    """In which share of the frames of each macrostate an agent takes each macro-action, greedily. Shape (A, N).

    The agent is not changed.
    """
    counts = np.zeros((n_actions, len(met.macrostates)))
    for index, frames in enumerate(met.frames):
        for frame in frames:
            counts[agent.act(Observation(frame=frame), explore=False), index] += 1.0
    return np.asarray(counts / counts.sum(axis=0))


def optimal_length(spec: TaskSpec) -> NDArray[np.float64]:
    """Expected macro-actions of an optimal agent within the horizon, from each start. Shape (S,)."""
    tables = tabulate(spec.rules)
    best = greedy(optimal_policy(tables), spec.n_actions)
    return evaluate(tables, best, spec.horizon).length[tables.starts]


def follow(spec: TaskSpec, met: Situations, policy: NDArray[np.float64]) -> Ends:
    """Follow a policy from every start, by the rules.

    Args:
        spec: The task.
        met: All situations.
        policy: Probability of each macro-action in each of them. Shape (A, N).
    """
    tables = tabulate(spec.rules)
    everywhere = np.full(tables.reward.shape, 1.0 / len(policy))  # anything, where episodes have ended
    everywhere[:, [tables.index[tuple(state)] for state in met.macrostates.tolist()]] = policy
    within = evaluate(tables, everywhere, spec.horizon)
    patient = evaluate(tables, everywhere, max(spec.horizon, _PATIENCE))
    return Ends(
        success=within.success[tables.starts],
        failure=within.failure[tables.starts],
        late_success=(patient.success - within.success)[tables.starts],
        late_failure=(patient.failure - within.failure)[tables.starts],
        length=within.length[tables.starts],
    )
