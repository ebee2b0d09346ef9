"""What every model is asked: real histories and macro-actions, the same for all, with the exact answers.

Shapes: ``N`` questions, ``K`` frames of history, ``D`` macro-actions asked about.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, Rules, State, TaskSpec
from imagine_bench.judge.truth import lasting_actions, transitions
from imagine_bench.rules import Outcomes, outcomes_by_depth, states_of
from imagine_bench.seeding import SeedTree

STATES = 400  # macrostates asked about at most; of more, values are not computed
AFTER_THE_END = 200  # transitions that no training contains, at most
FRAMES = 2  # frames of each macrostate in the questions of one step
DEPTH = 10  # macro-actions of each rollout
HISTORY = 2  # macro-actions before them that a model is shown
ROLLOUTS = 64
RANKED = 5  # sequences that are ranked from each start
RANKED_DEPTH = 5  # macro-actions of each of them
COUNTERFACTUALS = 48  # macrostates in which every macro-action is imagined with the same draws

Render = Callable[[Sequence[State], np.random.Generator], Frame]
"""Draws a frame (64, 64, 3) of each of N macrostates."""


@dataclass(frozen=True, kw_only=True)
class EvalSet:
    """Real histories and macro-actions, with the exact truth of each."""

    states: tuple[State, ...]  #: What the last frame shows. Length N.
    frames: Frame  #: Shape (N, K, 64, 64, 3).
    actions: NDArray[np.int64]  #: Those between the frames, then those asked about. Shape (N, K - 1 + D).
    truth: tuple[tuple[Outcomes, ...], ...]  #: By question and depth. N of length D.

    @property
    def depth(self) -> int:
        """Macro-actions asked about, D."""
        return self.actions.shape[1] - self.frames.shape[1] + 1

    @property
    def asked(self) -> NDArray[np.int64]:
        """The macro-actions asked about. Shape (N, D)."""
        return self.actions[:, self.frames.shape[1] - 1 :]

    @property
    def first_actions(self) -> list[int]:
        """The first macro-action of each question. Length N."""
        found: list[int] = self.asked[:, 0].tolist()
        return found


def one_step(spec: TaskSpec, render: Render) -> EvalSet:
    """Every macro-action in every macrostate that an episode can be in, from :data:`FRAMES` frames each."""
    rng = _generator(spec, "one_step")
    pairs = [pair for pair in transitions(spec.rules, rng, STATES) for _ in range(FRAMES)]
    return _eval_set(spec, render, [((state,), (action,)) for state, action in pairs], rng)


def after_the_end(spec: TaskSpec, render: Render) -> EvalSet | None:
    """Macro-actions in macrostates in which no episode goes on, which no training contains; None where there is none.

    The scene obeys the same dynamics there (thesis 5.2.3, "Model Generalization").
    """
    rng = _generator(spec, "after_the_end")
    over = [state for state in states_of(spec.rules) if spec.rules.is_terminal(state)]
    pairs = list(itertools.product(over, range(spec.n_actions)))
    if not pairs:
        return None
    chosen = np.sort(rng.choice(len(pairs), min(AFTER_THE_END, len(pairs)), replace=False))
    return _eval_set(spec, render, [((pairs[index][0],), (pairs[index][1],)) for index in chosen], rng)


def rollouts(spec: TaskSpec, render: Render) -> EvalSet:
    """Macro-actions that keep the episode going as surely as the rules allow, after a short real history."""
    rng = _generator(spec, "rollouts")
    asked = []
    for start in _some_starts(spec.rules, rng):
        actions = lasting_actions(spec.rules, start, HISTORY, rng)
        states = [start]
        for action in actions:
            outcomes = spec.rules.outcomes(states[-1], action)
            drawn = rng.choice(len(outcomes), p=[outcome.probability for outcome in outcomes])
            states.append(outcomes[int(drawn)].macrostate)
        later = lasting_actions(spec.rules, states[-1], DEPTH, rng)
        asked.append((tuple(states), (*actions, *later)))
    return _eval_set(spec, render, asked, rng)


def ranked(spec: TaskSpec, render: Render) -> EvalSet:
    """:data:`RANKED` random sequences from each start, one start behind another."""
    rng = _generator(spec, "ranked")
    asked = [
        ((start,), tuple(rng.integers(spec.n_actions, size=RANKED_DEPTH).tolist()))
        for start in _some_starts(spec.rules, rng)
        for _ in range(RANKED)
    ]
    return _eval_set(spec, render, asked, rng)


def counterfactuals(spec: TaskSpec, render: Render) -> tuple[EvalSet, ...]:
    """The same frames of :data:`COUNTERFACTUALS` macrostates for each macro-action in turn."""
    rng = _generator(spec, "counterfactuals")
    states = list(dict.fromkeys(state for state, _ in transitions(spec.rules, rng, STATES)))
    picks = np.sort(rng.choice(len(states), min(COUNTERFACTUALS, len(states)), replace=False))
    chosen = [states[index] for index in picks]
    first = _eval_set(spec, render, [((state,), (0,)) for state in chosen], rng)
    return tuple(
        replace(
            first,
            actions=np.full_like(first.actions, action),
            truth=tuple(outcomes_by_depth(spec.rules, state, [action]) for state in chosen),
        )
        for action in range(spec.n_actions)
    )


def _generator(spec: TaskSpec, name: str) -> np.random.Generator:
    return SeedTree(0).child("evaluation", "judge", name, spec.id).generator()


def _some_starts(rules: Rules, rng: np.random.Generator) -> list[State]:
    """:data:`ROLLOUTS` start macrostates; different ones where there are as many."""
    starts = rules.start_states
    return [starts[index] for index in rng.choice(len(starts), ROLLOUTS, replace=len(starts) < ROLLOUTS)]


def _eval_set(
    spec: TaskSpec,
    render: Render,
    asked: Sequence[tuple[tuple[State, ...], tuple[int, ...]]],
    rng: np.random.Generator,
) -> EvalSet:
    """The set of (states shown, macro-actions between and after them)."""
    shown = len(asked[0][0])
    frames = render([state for states, _ in asked for state in states], rng)
    truth = [outcomes_by_depth(spec.rules, states[-1], actions[shown - 1 :]) for states, actions in asked]
    return EvalSet(
        states=tuple(states[-1] for states, _ in asked),
        frames=frames.reshape(len(asked), shown, *frames.shape[1:]),
        actions=np.array([actions for _, actions in asked], dtype=np.int64),
        truth=tuple(truth),
    )
