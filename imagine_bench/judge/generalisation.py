"""Generalisation: does the model know where macro-actions lead that no training episode can ever contain?

Episodes end in terminal macrostates, so no agent has acted in one; the scene nevertheless obeys the same dynamics there
(thesis 5.2.3, "Model Generalization": 20 such transitions). Here it predicts all of them, and all others too: of those,
by what the rules say comes of them, since a model that is right on average may have forgotten what fails.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import ImaginedRollout, Imaginer, MapPredictor, ReplayReader
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats, Frame, Outcome, TaskSpec
from imagine_bench.judge.calibration import auroc
from imagine_bench.rules import states_of
from imagine_bench.seeding import Purpose, SeedTree

Mask = NDArray[np.bool_]

CONSEQUENCES = ("success", "failure", "the episode goes on")  # of a transition, where the rules leave no choice
_SHOWN = 6  # transitions of the figure
_OFTEN = 10
# How many real visits of a transition an agent remembers: least and most.
VISIT_COUNTS = {
    "never": (0, 0), f"1 to {_OFTEN - 1} times": (1, _OFTEN - 1), f"{_OFTEN} times or more": (_OFTEN, math.inf),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TransitionSet:
    """Every (macrostate, action) of a task, from one real frame each. N = macrostates x actions."""

    macrostates: NDArray[np.int64]  # shape (N, M)
    actions: NDArray[np.int64]  # shape (N,)
    frames: Frame  # a frame of each macrostate (kinematic mode). Shape (N, 64, 64, 3).
    terminal: Mask  # whether no episode goes on from the macrostate: the transition cannot be in any training data
    legal: Mask  # whether the macrostate breaks no rule. Shape (N,).
    possible: tuple[tuple[Outcome, ...], ...]  # what may come of it, by the rules. Length N.
    shown: NDArray[np.int64]  # a few out of terminal macrostates, for a figure; of legal ones if there are
    frames_after: Frame  # a frame of the first outcome of each shown one. Shape (shown, 64, 64, 3).

    @property
    def consequences(self) -> list[str]:
        """See :func:`consequence`. Length N."""
        return [consequence(possible) for possible in self.possible]

    def allows(self, macrostates: Sequence[Sequence[int]]) -> Mask:
        """Whether the rules allow each of N macrostates as what comes of the transition. Shape (N,)."""
        pairs = zip(macrostates, self.possible, strict=True)
        return np.array([tuple(state) in {o.macrostate for o in possible} for state, possible in pairs])


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """What one agent predicts of a :class:`TransitionSet`, held against the rules. Each of shape (N,)."""

    right: Mask  # whether the imagined macrostate, read by the evaluation-only probe, is one the rules allow
    epistemic: Floats  # epistemic uncertainty, reduced as the agent's filter does
    # distance of the imagined reward from the nearest one that the rules allow, in units of reward
    reward_error: Floats
    # whether the rules allow what is imagined more likely: that the episode ends here, or that it goes on
    end_right: Mask
    # as ``right``, of what the model holds likeliest instead of what it samples; None if unknown
    likeliest_right: Mask | None = None
    # how many real visits of the transition the agent remembers; None if unknown
    visit_count: NDArray[np.int64] | None = None
    examples: tuple[ImaginedRollout, ...] = ()  # what was imagined of the set's ``shown``

    def scores(self, part: Mask) -> Scores:
        """The scores of some of the transitions."""

        def mean(values: Mask | Floats | None) -> float:
            return math.nan if values is None or not part.any() else float(values[part].mean())

        names = ("right", "likeliest_right", "end_right", "reward_error")
        return Scores(count=int(part.sum()), **{name: mean(getattr(self, name)) for name in names})


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The number of some transitions and the means of an agent's :class:`Predictions` of them; NaN where unknown."""

    count: int
    right: float
    likeliest_right: float
    end_right: float
    reward_error: float


@dataclass(frozen=True, kw_only=True)
class Generalisation:
    """The scores of one agent's predictions."""

    unseen: Scores  # of transitions out of terminal macrostates, which no training can contain
    unseen_legal: Scores  # of those of them out of legal macrostates, such as goals
    seen: Scores  # of all other transitions
    # probability that a transition out of a terminal macrostate has more epistemic uncertainty than another
    auroc: float
    consequences: dict[str, Scores]  # of the other transitions, by those of :data:`CONSEQUENCES` that there are
    visit_counts: dict[str, Scores]  # the same transitions by :data:`VISIT_COUNTS`; empty if unknown


def transition_set(spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> TransitionSet:
    """All transitions of a task; the frames are the same for every agent.

    Raises:
        InvalidValueError: The rules list no terminal macrostate, so that there is nothing a model could not have seen.
    """
    rules = spec.rules
    pairs = [(state, action) for state in states_of(rules) for action in range(rules.n_actions)]
    terminal = np.array([rules.is_terminal(state) for state, _ in pairs])
    if terminal.all() or not terminal.any():
        raise InvalidValueError(
            f"Task {spec.id!r} has {'only' if terminal.all() else 'no'} terminal macrostates in its rules; transitions "
            "out of them cannot be set apart. Choose another task."
        )
    macrostates = np.array([state for state, _ in pairs], dtype=np.int64)
    seeds = SeedTree(0).child(purpose, "generalisation", spec.id)
    rng, draw = seeds.generator(), seeds.child("shown").generator()
    legal = np.array([rules.is_legal(state) for state, _ in pairs])
    possible = tuple(tuple(rules.outcomes(state, action)) for state, action in pairs)
    candidates = np.flatnonzero(terminal & legal if (terminal & legal).any() else terminal)
    shown = np.sort(draw.choice(candidates, min(_SHOWN, len(candidates)), replace=False))
    after = np.array([possible[index][0].macrostate for index in shown], dtype=np.int64)
    return TransitionSet(
        macrostates=macrostates,
        actions=np.array([action for _, action in pairs], dtype=np.int64),
        frames=spec.render_macrostates(macrostates, appearance, rng),
        terminal=terminal,
        legal=legal,
        possible=possible,
        shown=shown,
        frames_after=spec.render_macrostates(after, appearance, draw),
    )


def predict(agent: Imaginer, transitions: TransitionSet, seeds: SeedTree) -> Predictions:
    """Imagine every transition, one step each, and take what else the agent, which is not changed, can say of it."""
    pairs = enumerate(zip(transitions.frames, transitions.actions, strict=True))
    steps = [
        agent.imagine(frame, actions=np.array([action]), depth=1, rng=seeds.child(index).generator())
        for index, (frame, action) in pairs
    ]
    likeliest, rng = None, seeds.child("likeliest").generator()
    if isinstance(agent, MapPredictor):
        likeliest = agent.predict_map(transitions.frames, transitions.actions, rng).tolist()
    imagined = list(zip(steps, transitions.possible, strict=True))
    return Predictions(
        right=transitions.allows([step.macrostates[0].tolist() for step in steps]),
        epistemic=np.array([float(step.epistemic[0]) for step in steps]),
        reward_error=np.array([min(abs(float(step.rewards[0]) - o.reward) for o in outs) for step, outs in imagined]),
        end_right=np.array([(step.p_terminated[0] > 0.5) in {o.terminated for o in outs} for step, outs in imagined]),
        likeliest_right=None if likeliest is None else transitions.allows(likeliest),
        visit_count=_visit_count(agent, transitions),
        examples=tuple(steps[index] for index in transitions.shown),
    )


def _visit_count(agent: Imaginer, transitions: TransitionSet) -> NDArray[np.int64] | None:
    if not isinstance(agent, ReplayReader):
        return None
    macrostates, actions = agent.replayed()
    visits = Counter(zip(map(tuple, macrostates.tolist()), actions.tolist(), strict=True))
    pairs = zip(map(tuple, transitions.macrostates.tolist()), transitions.actions.tolist(), strict=True)
    return np.array([visits[pair] for pair in pairs], dtype=np.int64)


def consequence(possible: Sequence[Outcome]) -> str:
    """The one of :data:`CONSEQUENCES` that comes of a transition; ``"open"`` where the rules leave it to chance."""
    success, failure, goes_on = CONSEQUENCES
    found = {success if o.success else failure if o.terminated else goes_on for o in possible}
    return found.pop() if len(found) == 1 else "open"


def generalisation(transitions: TransitionSet, predictions: Predictions) -> Generalisation:
    """Score one agent's predictions."""
    terminal, visits = transitions.terminal, predictions.visit_count
    found = np.array(transitions.consequences)
    consequences = {name: predictions.scores(~terminal & (found == name)) for name in CONSEQUENCES}
    return Generalisation(
        unseen=predictions.scores(terminal),
        unseen_legal=predictions.scores(terminal & transitions.legal),
        seen=predictions.scores(~terminal),
        auroc=auroc(predictions.epistemic, terminal),
        consequences={name: scores for name, scores in consequences.items() if scores.count},
        visit_counts={
            name: predictions.scores(~terminal & (visits >= least) & (visits <= most))
            for name, (least, most) in VISIT_COUNTS.items()
            if visits is not None
        },
    )
