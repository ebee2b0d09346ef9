"""Generalisation: does the model know where macro-actions lead that no training episode can ever contain?

Episodes end in terminal macrostates, so no agent has acted in one; the scene nevertheless obeys the same dynamics there
(thesis 5.2.3, "Model Generalization": 20 such transitions). Here it is asked for all of them, and for all others too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench import statistics
from imagine_bench.capabilities import Imaginer
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import TaskSpec
from imagine_bench.seeding import Purpose, SeedTree


@dataclass(frozen=True, kw_only=True)
class Probing:
    """Every (macrostate, action) of a task, from one real frame each. N = macrostates x actions.

    Attributes:
        macrostates: Shape (N, M).
        actions: Shape (N,).
        frames: A frame of each macrostate (kinematic mode). Shape (N, 64, 64, 3).
        terminal: Whether no episode goes on from the macrostate: the transition cannot be in any training data.
        legal: Whether the macrostate breaks no rule. Shape (N,).
        possible: What the macrostate may be afterwards, by the rules. Length N.
    """

    macrostates: NDArray[np.int64]
    actions: NDArray[np.int64]
    frames: NDArray[np.uint8]
    terminal: NDArray[np.bool_]
    legal: NDArray[np.bool_]
    possible: tuple[frozenset[tuple[int, ...]], ...]


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What one agent imagined of a :class:`Probing`. Each of shape (N,).

    Attributes:
        right: Whether the imagined macrostate, read by the evaluation-only probe, is one the rules allow.
        epistemic: Epistemic uncertainty, reduced as the agent's filter does.
    """

    right: NDArray[np.bool_]
    epistemic: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Generalisation:
    """One agent's answers in four numbers.

    Attributes:
        unseen: Share right among transitions out of terminal macrostates.
        unseen_legal: The same out of the legal ones of them, such as goals; NaN where there are none.
        seen: Share right among the transitions that training can contain.
        auroc: Probability that a transition out of a terminal macrostate is doubted more than another.
    """

    unseen: float
    unseen_legal: float
    seen: float
    auroc: float


def probing(spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> Probing:
    """All transitions of a task; the frames are the same for every agent.

    Raises:
        InvalidValueError: The rules list no terminal macrostate, so that there is nothing a model could not have seen.
    """
    rules = spec.rules
    pairs = [(state, action) for state in rules.states for action in range(rules.n_actions)]
    terminal = np.array([rules.is_terminal(state) for state, _ in pairs])
    if terminal.all() or not terminal.any():
        raise InvalidValueError(
            f"Task {spec.id!r} has {'only' if terminal.all() else 'no'} terminal macrostates in its rules; transitions "
            "out of them cannot be set apart. Choose another task."
        )
    macrostates = np.array([state for state, _ in pairs], dtype=np.int64)
    rng = SeedTree(0).child(purpose, "generalisation", spec.id).generator()
    return Probing(
        macrostates=macrostates,
        actions=np.array([action for _, action in pairs], dtype=np.int64),
        frames=spec.render_macrostates(macrostates, appearance, rng),
        terminal=terminal,
        legal=np.array([rules.is_legal(state) for state, _ in pairs]),
        possible=tuple(
            frozenset(outcome.macrostate for outcome in rules.outcomes(state, action)) for state, action in pairs
        ),
    )


def answer(
    agent: Imaginer, probe: Probing, seeds: SeedTree, on_progress: Callable[[int], None] = lambda _: None
) -> Answers:
    """Imagine every transition, one step each.

    Args:
        agent: It is not changed.
        probe: What is asked.
        seeds: Names the generators that imagination draws from.
        on_progress: Told how many are done.
    """
    right, epistemic = [], []
    for index, (frame, action) in enumerate(zip(probe.frames, probe.actions, strict=True)):
        rng = seeds.child(index).generator()
        step = agent.imagine(frame, actions=np.array([action]), depth=1, rng=rng)
        right.append(tuple(int(value) for value in step.macrostates[0]) in probe.possible[index])
        epistemic.append(float(step.epistemic[0]))
        on_progress(index + 1)
    return Answers(right=np.array(right), epistemic=np.array(epistemic, dtype=np.float64))


def summarise(probe: Probing, answers: Answers) -> Generalisation:
    """The four numbers."""
    right, terminal = answers.right, probe.terminal
    legal_ends = terminal & probe.legal
    return Generalisation(
        unseen=float(right[terminal].mean()),
        unseen_legal=float(right[legal_ends].mean()) if legal_ends.any() else float("nan"),
        seen=float(right[~terminal].mean()),
        auroc=statistics.auroc(answers.epistemic[terminal], answers.epistemic[~terminal]),
    )
