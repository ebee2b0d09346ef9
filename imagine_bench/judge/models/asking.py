"""Putting questions to a model: what it is asked, and its pictures read as macrostates."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import ImagineBenchError, InvalidValueError, plain
from imagine_bench.interfaces import Floats, State, TaskSpec
from imagine_bench.interfaces.model import UNCERTAINTIES, Imagined, WorldModel, require_imagined, weights_of
from imagine_bench.judge.models.ends import Gallery, key_of
from imagine_bench.judge.models.truth import Questions, lasting_actions, outcomes_by_depth, transitions
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree

STATES = 400  # macrostates asked about at most; of more, values are not computed
AFTER_THE_END = 200  # transitions that no training contains, at most
FRAMES = 2  # frames of each macrostate in the questions of one step
DEPTH, HISTORY = 10, 2
"""Macro-actions of each rollout, and macro-actions before them that a model is shown."""
ROLLOUTS, RANKED, RANKED_DEPTH = 64, 5, 5
"""Rollouts; sequences that are ranked from each start, and their macro-actions."""
COUNTERFACTUALS = 48  # macrostates in which every macro-action is imagined with the same draws
_AT_ONCE = 96  # questions handed to a model at a time, to bound memory

Distribution = dict[State, float]
"""Probability of each macrostate; of pictures that show nothing, all coordinates are -1."""


class Reader(Protocol):
    """What reads pictures; see :mod:`imagine_bench.agents.world_models.reader`."""

    def read(self, pictures: NDArray[Any]) -> NDArray[np.int64]:
        """Macrostates (N, M) of pictures (N, H, W) or (N, H, W, 3); -1 where one shows nothing of this world."""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What a model imagines of :class:`.truth.Questions`, as read."""

    states: NDArray[np.int64]  #: Shape (N, S, D, M); -1 where a picture shows nothing.
    weights: Floats  #: Probability of each picture at its depth. Shape (N, S, D).
    rewards: NDArray[Any] | None  #: Shape (N, S, D).
    p_ended: NDArray[Any] | None  #: Shape (N, S, D).
    uncertainties: dict[str, NDArray[Any]]  #: Those offered, by name, each (N, D).
    accepted: NDArray[np.bool_] | None  #: Whether a filter of its own keeps it. Shape (N, D).
    cpu_s: float  #: CPU seconds of imagining, reading apart
    steps: int  #: Macro-actions imagined, N D of each future

    def distribution(self, row: int, step: int) -> Distribution:
        """Of the macrostates after a step."""
        found: Distribution = {}
        for state, weight in zip(self.states[row, :, step].tolist(), self.weights[row, :, step].tolist(), strict=True):
            if weight:
                found[tuple(state)] = found.get(tuple(state), 0.0) + weight
        return found


def one_step(spec: TaskSpec, gallery: Gallery) -> Questions:
    """Every macro-action in every macrostate that an episode can be in, from :data:`FRAMES` frames each."""
    rng = SeedTree(0).child("evaluation", "judge", "one_step", spec.id).generator()
    pairs = [pair for pair in transitions(spec.rules, rng, STATES) for _ in range(FRAMES)]
    return _questions(spec, gallery, [((state,), (action,)) for state, action in pairs], rng)


def after_the_end(spec: TaskSpec, gallery: Gallery) -> Questions | None:
    """Macro-actions in macrostates in which no episode goes on, which no training contains; None where there is none.

    The scene obeys the same dynamics there (thesis 5.2.3, "Model Generalization").
    """
    rng = SeedTree(0).child("evaluation", "judge", "after_the_end", spec.id).generator()
    over = [state for state in states_of(spec.rules) if spec.rules.is_terminal(state)]
    pairs = list(itertools.product(over, range(spec.n_actions)))
    if not pairs:
        return None
    chosen = np.sort(rng.choice(len(pairs), min(AFTER_THE_END, len(pairs)), replace=False))
    return _questions(spec, gallery, [((pairs[index][0],), (pairs[index][1],)) for index in chosen], rng)


def rollouts(spec: TaskSpec, gallery: Gallery) -> Questions:
    """Macro-actions that keep the episode going as surely as the rules allow, after a short real history."""
    rng = SeedTree(0).child("evaluation", "judge", "rollouts", spec.id).generator()
    starts = spec.rules.start_states
    asked = []
    for index in rng.choice(len(starts), ROLLOUTS, replace=len(starts) < ROLLOUTS):
        states, actions = [starts[index]], lasting_actions(spec.rules, starts[index], HISTORY, rng)
        for action in actions:
            outcomes = spec.rules.outcomes(states[-1], action)
            states.append(outcomes[int(rng.choice(len(outcomes), p=[o.probability for o in outcomes]))].macrostate)
        asked.append((tuple(states), (*actions, *lasting_actions(spec.rules, states[-1], DEPTH, rng))))
    return _questions(spec, gallery, asked, rng)


def ranked(spec: TaskSpec, gallery: Gallery) -> Questions:
    """:data:`RANKED` random sequences from each start, one start behind another."""
    rng = SeedTree(0).child("evaluation", "judge", "ranked", spec.id).generator()
    starts = spec.rules.start_states
    chosen = rng.choice(len(starts), ROLLOUTS, replace=len(starts) < ROLLOUTS)
    asked = [
        ((starts[index],), tuple(rng.integers(spec.n_actions, size=RANKED_DEPTH).tolist()))
        for index in chosen
        for _ in range(RANKED)
    ]
    return _questions(spec, gallery, asked, rng)


def counterfactuals(spec: TaskSpec, gallery: Gallery) -> tuple[Questions, ...]:
    """The same frames of :data:`COUNTERFACTUALS` macrostates for each macro-action in turn."""
    rng = SeedTree(0).child("evaluation", "judge", "counterfactuals", spec.id).generator()
    states = list(dict.fromkeys(state for state, _ in transitions(spec.rules, rng, STATES)))
    chosen = [
        states[index] for index in np.sort(rng.choice(len(states), min(COUNTERFACTUALS, len(states)), replace=False))
    ]
    first = _questions(spec, gallery, [((state,), (0,)) for state in chosen], rng)
    return tuple(
        replace(
            first,
            actions=np.full_like(first.actions, action),
            truth=tuple(outcomes_by_depth(spec.rules, state, [action]) for state in chosen),
        )
        for action in range(spec.n_actions)
    )


def _questions(
    spec: TaskSpec,
    gallery: Gallery,
    asked: Sequence[tuple[tuple[State, ...], tuple[int, ...]]],
    rng: np.random.Generator,
) -> Questions:
    """Questions of (states shown, macro-actions between and after them)."""
    shown = len(asked[0][0])
    frames = gallery.render([state for states, _ in asked for state in states], rng)
    truth = [outcomes_by_depth(spec.rules, states[-1], actions[shown - 1 :]) for states, actions in asked]
    return Questions(
        states=tuple(states[-1] for states, _ in asked),
        frames=frames.reshape(len(asked), shown, *frames.shape[1:]),
        actions=np.array([actions for _, actions in asked], dtype=np.int64),
        truth=tuple(truth),
    )


def ask(
    model: WorldModel, name: str, questions: Questions, *, samples: int, reader: Reader, gallery: Gallery,
    rng: np.random.Generator,
) -> Answers:  # fmt: skip
    """Let a model imagine the answers, and read them; a picture of the gallery is what it is, to the pixel.

    Raises:
        InvalidValueError: The model fails, or hands in what it must not; the message names model and method.
    """
    parts, cpu_s = [], 0.0
    for at in range(0, len(questions.frames), _AT_ONCE):
        frames, actions = questions.frames[at : at + _AT_ONCE], questions.actions[at : at + _AT_ONCE]
        begun_s = time.process_time()
        imagined = call(name, "imagine", model.imagine, frames, actions, samples, rng)
        cpu_s += time.process_time() - begun_s
        require_imagined(imagined, name=name, rows=len(frames), depth=questions.depth, samples=samples)
        parts.append((read_pictures(imagined, reader, gallery, len(questions.states[0])), imagined))
    offered = [each for each in UNCERTAINTIES if all(getattr(part, each) is not None for _, part in parts)]
    return Answers(
        states=_joined([states for states, _ in parts]),
        weights=_joined([weights_of(imagined) for _, imagined in parts]),
        **{each: _offered([getattr(part, each) for _, part in parts]) for each in ("rewards", "p_ended")},
        accepted=_one_behind_another([part.accepted for _, part in parts]),
        uncertainties={each: np.concatenate([getattr(part, each) for _, part in parts]) for each in offered},
        cpu_s=cpu_s,
        steps=sum(int(np.prod(imagined.pictures.shape[:3])) for _, imagined in parts),
    )


def call(name: str, method: str, function: Any, *arguments: Any) -> Any:
    """What a model's method returns; InvalidValueError, naming both, where it raises."""
    try:
        return function(*arguments)
    except ImagineBenchError as error:
        raise InvalidValueError(f"World model {name}: {method}() failed: {error}") from error
    except Exception as error:  # whatever a model does wrong is one sentence
        why = f"{type(error).__name__}: {plain(error)}".partition("\n")[0]
        raise InvalidValueError(f"World model {name}: {method}() failed ({why}).") from error


def read_pictures(imagined: Imagined, reader: Reader, gallery: Gallery, coordinates: int) -> NDArray[np.int64]:
    """Macrostates (N, S, D, M) of what was imagined; equal pictures are read once."""
    shape = imagined.pictures.shape
    pictures = imagined.pictures.reshape(-1, *shape[3:])
    places: dict[bytes, list[int]] = {}
    for index, picture in enumerate(pictures):
        places.setdefault(key_of(picture), []).append(index)
    read = np.full((len(pictures), coordinates), -1, dtype=np.int64)
    unknown = []
    for rows in places.values():
        state = gallery.shows(pictures[rows[0]]) if pictures.dtype == np.uint8 else None
        if state is None:
            unknown.append(rows)
        else:
            read[rows] = state
    if unknown:
        for rows, found in zip(unknown, reader.read(pictures[[rows[0] for rows in unknown]]), strict=True):
            read[rows] = found
    return read.reshape(*shape[:3], coordinates)


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Parts one behind another, with as many futures each: those missing have weight 0 and show nothing."""
    most = max(part.shape[1] for part in parts)
    fill = [-1 if part.dtype.kind == "i" else 0 for part in parts]
    return np.concatenate([
        np.pad(part, [(0, 0), (0, most - part.shape[1]), *[(0, 0)] * (part.ndim - 2)], constant_values=value)
        for part, value in zip(parts, fill, strict=True)
    ])  # fmt: skip


def _one_behind_another(parts: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
    there = [part for part in parts if part is not None]
    return np.concatenate(there) if len(there) == len(parts) else None


def _offered(parts: Sequence[NDArray[Any] | None]) -> NDArray[Any] | None:
    there = [part.astype(np.float64) for part in parts if part is not None]
    return _joined(there) if len(there) == len(parts) else None
