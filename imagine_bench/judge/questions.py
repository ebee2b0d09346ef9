"""The questions to every model: real histories and macro-actions, the same for all, with the exact answers.

Shapes: ``N`` questions, ``K`` frames of history, ``D`` macro-actions asked about.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from imagine_bench.arrays import Frame, Ints, State
from imagine_bench.errors import ImagineBenchError
from imagine_bench.interfaces import Rules, TaskSpec
from imagine_bench.judge.worlds.making import PAIRS, WorldQuestions, light_pairs, whole_world
from imagine_bench.rules import Outcomes, advance, outcomes_by_depth, states_of, states_of_play
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
LIGHT = "light=1.0"
"""The appearance of pairs of frames that differ in the light alone."""

Render = Callable[[Sequence[State], np.random.Generator], Frame]
"""Draws a frame (64, 64, 3) of each of N macrostates."""
Asked = tuple[Sequence[State], Sequence[int]]
"""The macrostates shown, and the macro-actions between and after them."""
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class EvalSet:
    """Real histories and macro-actions, with the exact truth of each."""

    states: tuple[State, ...]  #: The content of the last frame. Length N.
    frames: Frame  #: Shape (N, K, 64, 64, 3).
    actions: Ints  #: Those between the frames, then those asked about. Shape (N, K - 1 + D).
    truth: tuple[tuple[Outcomes, ...], ...]  #: By question and depth. N of length D.

    @property
    def asked(self) -> Ints:
        """The macro-actions asked about. Shape (N, D)."""
        return self.actions[:, self.frames.shape[1] - 1 :]

    @property
    def pairs(self) -> list[tuple[State, int]]:
        """Macrostate and first macro-action of each question. Length N."""
        return list(zip(self.states, self.asked[:, 0].tolist(), strict=True))

    @property
    def macrostates(self) -> tuple[State, ...]:
        """Each macrostate that is asked about, once."""
        return tuple(dict.fromkeys(self.states))


def one_step(spec: TaskSpec, render: Render) -> EvalSet:
    """Every macro-action in every macrostate that an episode can be in, from :data:`FRAMES` frames each.

    Questions are in the order of macrostates, of each in that of its macro-actions, and of each of its frames.
    """
    rng = _generator(spec, "one_step")
    alike = itertools.product(_going_on(spec.rules, rng), range(spec.n_actions), range(FRAMES))
    return _eval_set(spec, render, [((state,), (action,)) for state, action, _ in alike], rng)


def after_the_end(spec: TaskSpec, render: Render) -> EvalSet | None:
    """Macro-actions in macrostates in which no episode goes on, which no training contains; None where there is none.

    The scene obeys the same dynamics there (thesis 5.2.3, "Model Generalization").
    """
    rng = _generator(spec, "after_the_end")
    over = [state for state in states_of(spec.rules) if spec.rules.is_terminal(state)]
    asked = [((state,), (action,)) for state in over for action in range(spec.n_actions)]
    return _eval_set(spec, render, _some(asked, AFTER_THE_END, rng), rng) if asked else None


def rollouts(spec: TaskSpec, render: Render) -> EvalSet:
    """Macro-actions that keep the episode going as surely as the rules allow, after a short real history."""
    rng = _generator(spec, "rollouts")
    asked: list[Asked] = []
    for start in some_starts(spec.rules, ROLLOUTS, rng):
        actions = _lasting_actions(spec.rules, start, HISTORY, rng)
        states = [start]
        for action in actions:
            outcomes = spec.rules.outcomes(states[-1], action)
            drawn = rng.choice(len(outcomes), p=[outcome.probability for outcome in outcomes])
            states.append(outcomes[int(drawn)].macrostate)
        asked.append((states, actions + _lasting_actions(spec.rules, states[-1], DEPTH, rng)))
    return _eval_set(spec, render, asked, rng)


def ranked(spec: TaskSpec, render: Render) -> EvalSet:
    """:data:`RANKED` random sequences from each start, one start behind another."""
    rng = _generator(spec, "ranked")
    starts = [start for start in some_starts(spec.rules, ROLLOUTS, rng) for _ in range(RANKED)]
    asked = [((start,), rng.integers(spec.n_actions, size=RANKED_DEPTH).tolist()) for start in starts]
    return _eval_set(spec, render, asked, rng)


def counterfactuals(spec: TaskSpec, render: Render) -> tuple[EvalSet, ...]:
    """The same frames of :data:`COUNTERFACTUALS` macrostates for each macro-action in turn."""
    rng = _generator(spec, "counterfactuals")
    states = _some(_going_on(spec.rules, rng), COUNTERFACTUALS, rng)
    first = _eval_set(spec, render, [((state,), (0,)) for state in states], rng)
    found = []
    for action in range(spec.n_actions):
        truth = tuple(outcomes_by_depth(spec.rules, state, [action]) for state in states)
        found.append(replace(first, actions=np.full_like(first.actions, action), truth=truth))
    return tuple(found)


def about_whole_world(spec: TaskSpec, single: EvalSet) -> WorldQuestions:
    """Questions about the whole world, of which ``single`` has every macro-action as :func:`one_step` has it."""
    of_one = single.frames.reshape(-1, FRAMES, *single.frames.shape[1:])
    frames_vary = bool((of_one[:, 0] != of_one[:, -1]).any())
    return whole_world(spec, single.macrostates, FRAMES, frames_vary=frames_vary)


def light_alone(spec: TaskSpec, render: Render) -> EvalSet | None:
    """One macro-action in each of some macrostates, from :data:`FRAMES` frames that differ in the light alone.

    ``render`` varies the light. None where it does not, or where the task's frames cannot be varied so.
    """
    rng = _generator(spec, "light")
    states = _some(_going_on(spec.rules, rng), PAIRS, rng)
    asked = [((state,), (int(rng.integers(spec.n_actions)),)) for state in states]
    try:
        found = _eval_set(spec, render, [each for each in asked for _ in range(FRAMES)], rng)
    except (ImagineBenchError, LookupError, ValueError):  # of a task of another package that knows other appearances
        return None
    return found if (found.frames[0] != found.frames[1]).any() else None


def about_light(spec: TaskSpec, light: EvalSet) -> WorldQuestions:
    """The pairs of :func:`light_alone`: the outcome of a macro-action, shown in two lights."""
    return light_pairs(spec, light.macrostates, light.asked[::FRAMES, 0], _generator(spec, "light answers"))


SETS = {"one_step": one_step, "rollouts": rollouts, "ranked": ranked, "after": after_the_end}
"""The makers of each set of questions that all models are asked once; the last may be None."""


def _generator(spec: TaskSpec, name: str) -> np.random.Generator:
    return SeedTree(0).child("evaluation", "judge", name, spec.id).generator()


def _going_on(rules: Rules, rng: np.random.Generator) -> Sequence[State]:
    """Every macrostate that an episode can be in; where there are too many, :data:`STATES` that are drawn."""
    alive = states_of_play(rules)
    return _some(alive, STATES, rng) if len(alive) > STATES else alive


def _some(choices: Sequence[T], most: int, rng: np.random.Generator) -> list[T]:
    """So many of them at most, drawn, in their order."""
    return [choices[row] for row in np.sort(rng.choice(len(choices), min(most, len(choices)), replace=False))]


def some_starts(rules: Rules, count: int, rng: np.random.Generator) -> list[State]:
    """So many start macrostates; different ones where there are as many."""
    starts = rules.start_states
    return [starts[row] for row in rng.choice(len(starts), count, replace=len(starts) < count)]


def _lasting_actions(rules: Rules, state: State, depth: int, rng: np.random.Generator) -> list[int]:
    """Random macro-actions after which the episode is least likely to be over, one after another."""
    chosen: list[int] = []
    outcomes: Outcomes = {(state, False): (1.0, 0.0)}
    for _ in range(depth):
        risks = [_risk(rules, outcomes, action) for action in range(rules.n_actions)]
        chosen.append(int(rng.choice([action for action, risk in enumerate(risks) if risk == min(risks)])))
        outcomes = advance(rules, outcomes, chosen[-1])
    return chosen


def _risk(rules: Rules, outcomes: Outcomes, action: int) -> tuple[float, int]:
    """How likely an action ends an episode, and in how many macrostates every action would, right after it."""
    after = [outcome for (before, over) in outcomes if not over for outcome in rules.outcomes(before, action)]
    ended = sum(outcome.probability for outcome in after if outcome.terminated)
    return ended, sum(not _can_last(rules, outcome.macrostate) for outcome in after if not outcome.terminated)


def _can_last(rules: Rules, state: State) -> bool:
    """Whether some macro-action surely does not end the episode there."""
    return any(not any(o.terminated for o in rules.outcomes(state, action)) for action in range(rules.n_actions))


def _eval_set(spec: TaskSpec, render: Render, asked: Sequence[Asked], rng: np.random.Generator) -> EvalSet:
    """The set of these questions."""
    frames = render([state for states, _ in asked for state in states], rng)
    shown = len(asked[0][0])
    return EvalSet(
        states=tuple(states[-1] for states, _ in asked),
        frames=frames.reshape(len(asked), shown, *frames.shape[1:]),
        actions=np.array([actions for _, actions in asked], dtype=np.int64),
        truth=tuple(outcomes_by_depth(spec.rules, states[-1], actions[shown - 1 :]) for states, actions in asked),
    )
