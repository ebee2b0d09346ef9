"""Generalisation: does the model know where macro-actions lead that no training episode can ever contain?

Episodes end in terminal macrostates, so no agent has acted in one; the scene nevertheless obeys the same dynamics there
(thesis 5.2.3, "Model Generalization": 20 such transitions). Here it is asked for all of them, and for all others too:
of those, by what the rules say comes of them, since a model that is right on average may have forgotten what fails.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import Imaginer, MapPredictor, ReplayReader
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome, TaskSpec
from imagine_bench.judge.calibration import auroc
from imagine_bench.seeding import Purpose, SeedTree

CONSEQUENCES = ("success", "failure", "the episode goes on")
"""What may come of a transition by the rules, as far as they leave no choice between these."""
_OFTEN = 10
EXPERIENCE = {
    "never": (0, 0),
    f"1 to {_OFTEN - 1} times": (1, _OFTEN - 1),
    f"{_OFTEN} times or more": (_OFTEN, math.inf),
}
"""How often an agent remembers a transition: least and most."""


@dataclass(frozen=True, kw_only=True)
class Probing:
    """Every (macrostate, action) of a task, from one real frame each. N = macrostates x actions.

    Attributes:
        macrostates: Shape (N, M).
        actions: Shape (N,).
        frames: A frame of each macrostate (kinematic mode). Shape (N, 64, 64, 3).
        terminal: Whether no episode goes on from the macrostate: the transition cannot be in any training data.
        legal: Whether the macrostate breaks no rule. Shape (N,).
        possible: What may come of it, by the rules. Length N.
    """

    macrostates: NDArray[np.int64]
    actions: NDArray[np.int64]
    frames: NDArray[np.uint8]
    terminal: NDArray[np.bool_]
    legal: NDArray[np.bool_]
    possible: tuple[tuple[Outcome, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What one agent imagined of a :class:`Probing`. Each of shape (N,).

    Attributes:
        right: Whether the imagined macrostate, read by the evaluation-only probe, is one the rules allow.
        epistemic: Epistemic uncertainty, reduced as the agent's filter does.
        reward_error: Distance of the imagined reward from the nearest one that the rules allow, in units of reward.
        end_right: Whether the rules allow what is imagined more likely: that the episode ends here, or that it goes on.
        likeliest_right: As ``right``, of what the model holds likeliest instead of what it draws; None if unknown.
        times: How often the agent remembers having had the transition; None if unknown.
    """

    right: NDArray[np.bool_]
    epistemic: NDArray[np.float64]
    reward_error: NDArray[np.float64]
    end_right: NDArray[np.bool_]
    likeliest_right: NDArray[np.bool_] | None = None
    times: NDArray[np.int64] | None = None


@dataclass(frozen=True, kw_only=True)
class Familiarity:
    """What an agent imagines of the transitions that it had equally often, of those that training can contain.

    Attributes:
        count: How many there are.
        right: Share of them whose next macrostate is right; NaN where there are none.
        likeliest_right: The same of what the model holds likeliest.
    """

    count: int
    right: float
    likeliest_right: float


@dataclass(frozen=True, kw_only=True)
class Marks:
    """What an agent imagines of the transitions of one consequence that training can contain.

    Attributes:
        count: How many there are.
        right: Share of them whose next macrostate is right.
        end_right: Share of them whose end, or going on, is right.
        reward_error: Their mean error, in units of reward.
    """

    count: int
    right: float
    end_right: float
    reward_error: float


@dataclass(frozen=True, kw_only=True)
class Generalisation:
    """One agent's answers in a few numbers.

    Attributes:
        unseen: Share right among transitions out of terminal macrostates.
        unseen_legal: The same out of the legal ones of them, such as goals; NaN where there are none.
        seen: Share right among the transitions that training can contain.
        unseen_likeliest: As ``unseen``, of what the model holds likeliest instead of what it draws; NaN if unknown.
        seen_likeliest: As ``seen``, likewise.
        auroc: Probability that a transition out of a terminal macrostate is doubted more than another.
        consequences: The transitions that training can contain, by those of :data:`CONSEQUENCES` that there are.
        experience: The same transitions by :data:`EXPERIENCE`; empty if unknown.
    """

    unseen: float
    unseen_legal: float
    seen: float
    unseen_likeliest: float
    seen_likeliest: float
    auroc: float
    consequences: dict[str, Marks]
    experience: dict[str, Familiarity]


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
        possible=tuple(tuple(rules.outcomes(state, action)) for state, action in pairs),
    )


def answer(agent: Imaginer, probe: Probing, seeds: SeedTree) -> Answers:
    """Imagine every transition, one step each, and ask what else the agent can say of it.

    Args:
        agent: It is not changed.
        probe: What is asked.
        seeds: Names the generators that imagination draws from.
    """
    rows = []
    for index, (frame, action) in enumerate(zip(probe.frames, probe.actions, strict=True)):
        rng = seeds.child(index).generator()
        step = agent.imagine(frame, actions=np.array([action]), depth=1, rng=rng)
        possible = probe.possible[index]
        rows.append((
            tuple(int(value) for value in step.macrostates[0]) in {outcome.macrostate for outcome in possible},
            float(step.epistemic[0]),
            min(abs(float(step.rewards[0]) - outcome.reward) for outcome in possible),
            bool(step.p_terminated[0] > 0.5) in {outcome.terminated for outcome in possible},
        ))  # fmt: skip
    right, epistemic, reward_error, end_right = (np.array(column) for column in zip(*rows, strict=True))
    return Answers(
        right=right,
        epistemic=epistemic,
        reward_error=reward_error,
        end_right=end_right,
        likeliest_right=_likeliest_right(agent, probe, seeds.child("likeliest").generator()),
        times=_times(agent, probe),
    )


def _likeliest_right(agent: Imaginer, probe: Probing, rng: np.random.Generator) -> NDArray[np.bool_] | None:
    if not isinstance(agent, MapPredictor):
        return None
    found = agent.predict_map(probe.frames, probe.actions, rng).tolist()
    return np.array([
        tuple(macrostate) in {outcome.macrostate for outcome in possible}
        for macrostate, possible in zip(found, probe.possible, strict=True)
    ])  # fmt: skip


def _times(agent: Imaginer, probe: Probing) -> NDArray[np.int64] | None:
    if not isinstance(agent, ReplayReader):
        return None
    macrostates, actions = agent.replayed()
    had = Counter(zip(map(tuple, macrostates.tolist()), actions.tolist(), strict=True))
    asked = zip(map(tuple, probe.macrostates.tolist()), probe.actions.tolist(), strict=True)
    return np.array([had[pair] for pair in asked], dtype=np.int64)


def consequence(possible: Sequence[Outcome]) -> str | None:
    """The one of :data:`CONSEQUENCES` that the rules say comes of a transition; None where they leave it open."""
    success, failure, survival_probability = CONSEQUENCES
    found = {success if o.success else failure if o.terminated else survival_probability for o in possible}
    return found.pop() if len(found) == 1 else None


def summarise(probe: Probing, answers: Answers) -> Generalisation:
    """The numbers of one agent."""
    right, terminal = answers.right, probe.terminal
    legal_ends = terminal & probe.legal
    return Generalisation(
        unseen=float(right[terminal].mean()),
        unseen_legal=_share(right, legal_ends),
        seen=float(right[~terminal].mean()),
        unseen_likeliest=_share(answers.likeliest_right, terminal),
        seen_likeliest=_share(answers.likeliest_right, ~terminal),
        auroc=auroc(answers.epistemic, terminal),
        consequences=_by_consequence(probe, answers),
        experience=_by_experience(probe, answers),
    )


def _share(right: NDArray[np.bool_] | None, part: NDArray[np.bool_]) -> float:
    """Share that is right within a part; NaN where that is unknown, or nothing is in it."""
    return float("nan") if right is None or not part.any() else float(right[part].mean())


def _by_experience(probe: Probing, answers: Answers) -> dict[str, Familiarity]:
    if answers.times is None:
        return {}
    parts = {
        name: ~probe.terminal & (answers.times >= least) & (answers.times <= most)
        for name, (least, most) in EXPERIENCE.items()
    }
    return {
        name: Familiarity(
            count=int(part.sum()),
            right=_share(answers.right, part),
            likeliest_right=_share(answers.likeliest_right, part),
        )
        for name, part in parts.items()
    }


def _by_consequence(probe: Probing, answers: Answers) -> dict[str, Marks]:
    found = np.array([consequence(possible) or "" for possible in probe.possible])
    parts = {name: ~probe.terminal & (found == name) for name in CONSEQUENCES}
    return {
        name: Marks(
            count=int(part.sum()),
            right=float(answers.right[part].mean()),
            end_right=float(answers.end_right[part].mean()),
            reward_error=float(answers.reward_error[part].mean()),
        )
        for name, part in parts.items()
        if part.any()
    }
