"""What a trained agent would do in every macrostate, and where that leads by the rules: no episode is sampled.

A test says how often an agent succeeds. This says from which starts it does not, and how: a termination that is no
success, or out of time, and then whether it would have come to a success, to another termination, or to none at all.

An agent sees a macrostate in many frames, and may do one thing in some of them and another in others; here every visit
of a macrostate shows it in one of ``F`` frames, drawn anew. In a real episode the frames of two visits are more alike,
so an agent that goes to and fro stays there a little longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import begin_episode
from imagine_bench.interfaces import Agent, Floats, Frame, Observation, TaskSpec
from imagine_bench.rules import evaluate, greedy, optimal_policy, states_of, tabulate
from imagine_bench.seeding import Purpose, SeedTree

FRAMES = 16  # frames of a macrostate, F
_PATIENCE = 1_000  # macro-actions after which a termination is taken for one that never comes


@dataclass(frozen=True, kw_only=True)
class EvalStates:
    """Every macrostate of a task that is not terminal, N of them, and what it looks like."""

    macrostates: NDArray[np.int64]  # shape (N, M)
    frames: Frame  # of each of them, kinematic mode. Shape (N, F, 64, 64, 3).


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


def eval_states(spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> EvalStates:
    """All macrostates that an agent may act in, each in :data:`FRAMES` frames, the same for every agent."""
    macrostates = np.array(
        [state for state in states_of(spec.rules) if not spec.rules.is_terminal(state)], dtype=np.int64
    )
    rng = SeedTree(0).child(purpose, "policy", spec.id).generator()
    frames = spec.render_macrostates(np.repeat(macrostates, FRAMES, axis=0), appearance, rng)
    return EvalStates(macrostates=macrostates, frames=frames.reshape(len(macrostates), FRAMES, *frames.shape[1:]))


def action_shares(agent: Agent, states: EvalStates, n_actions: int, *, privileged: bool = False) -> Floats:
    """In which share of the frames of each macrostate an agent takes each macro-action, greedily. Shape (A, N).

    The agent is not changed. A ``privileged`` one is shown the macrostate too.
    """
    counts = np.zeros((n_actions, len(states.macrostates)))
    for index, frames in enumerate(states.frames):
        for frame in frames:
            seen = Observation(frame=frame, macrostate=states.macrostates[index] if privileged else None)
            begin_episode(agent)
            counts[agent.act(seen, explore=False), index] += 1.0
    return np.asarray(counts / counts.sum(axis=0))


def optimal_length(spec: TaskSpec) -> Floats:
    """Expected macro-actions of an optimal agent within the horizon, from each start. Shape (S,)."""
    tables = tabulate(spec.rules)
    best = greedy(optimal_policy(tables), spec.n_actions)
    return evaluate(tables, best, spec.horizon).length[tables.starts]


def terminations(spec: TaskSpec, states: EvalStates, policy: Floats) -> Terminations:
    """Follow a policy from every start, by the rules: probabilities (A, N) in the N macrostates not terminal."""
    tables = tabulate(spec.rules)
    everywhere = np.full(tables.reward.shape, 1.0 / len(policy))  # anything, where episodes have ended
    everywhere[:, [tables.index[tuple(state)] for state in states.macrostates.tolist()]] = policy
    within = evaluate(tables, everywhere, spec.horizon)
    patient = evaluate(tables, everywhere, max(spec.horizon, _PATIENCE))
    return Terminations(
        success=within.success[tables.starts],
        failure=within.failure[tables.starts],
        late_success=(patient.success - within.success)[tables.starts],
        late_failure=(patient.failure - within.failure)[tables.starts],
        length=within.length[tables.starts],
    )
