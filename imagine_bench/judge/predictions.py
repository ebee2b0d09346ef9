"""The answers of a model: it is asked an :class:`.EvalSet`, and its images are read as macrostates."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Arrays, Floats, Frame, Ints, State
from imagine_bench.errors import ImagineBenchError, InvalidValueError
from imagine_bench.exact.values import rows_of
from imagine_bench.interfaces.model import UNCERTAINTIES, Imagined, WorldModel, require_imagined, weights_of
from imagine_bench.judge.questions import FRAMES, EvalSet
from imagine_bench.judge.reading import ImageReader, RenderedFrameIndex
from imagine_bench.judge.truth import Distribution, added_up
from imagine_bench.judge.worlds.tables import TransitionTable
from imagine_bench.registry.loading import fault
from imagine_bench.running.isolation import GuestError

_AT_ONCE = 96  # questions handed to a model at a time, to bound memory
P = ParamSpec("P")
T = TypeVar("T")
N = TypeVar("N", bound=np.generic)
_OFFERED = ("rewards", "p_ended", "accepted", *UNCERTAINTIES)


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """A model's imagination of an :class:`.EvalSet`, as read, in S futures."""

    states: Ints  #: Shape (N, S, D, M); -1 where an image shows nothing of this world.
    weights: Floats  #: Probability of each image at its depth. Shape (N, S, D).
    #: Futures that were drawn for each question, all equally likely; 0 where the model gives probabilities. Shape (N,).
    drawn: Ints
    offered: Arrays  #: The other abilities of the model, by its name in :class:`.Imagined`. Shapes (N, S, D) or (N, D).
    cpu_s: float  #: CPU seconds of imagining, reading apart
    steps: int  #: Macro-actions imagined, N D of each future

    def of_rows(self, first: int, end: int) -> Predictions:
        """Those of some questions, in a row."""
        rows = slice(first, end)
        share = (end - first) / len(self.states)
        return replace(
            self,
            states=self.states[rows],
            weights=self.weights[rows],
            drawn=self.drawn[rows],
            offered={name: array[rows] for name, array in self.offered.items()},
            cpu_s=share * self.cpu_s,
            steps=round(share * self.steps),
        )

    def of_one_step(self, name: str) -> Floats | None:
        """The model's offers for the first macro-action, by name, as far as it has them. Shape (N, S) or (N,)."""
        return self.offered[name][..., 0] if name in self.offered else None

    def futures(self, row: int, step: int) -> list[tuple[State, float]]:
        """Macrostate and probability of each future after a step. Length S."""
        states = map(tuple, self.states[row, :, step].tolist())
        return list(zip(states, self.weights[row, :, step].tolist(), strict=True))

    def distribution(self, row: int, step: int) -> Distribution:
        """Of the macrostates after a step."""
        return added_up((state, weight) for state, weight in self.futures(row, step) if weight)


def evaluate(
    model: WorldModel,
    name: str,
    questions: EvalSet,
    *,
    samples: int,
    reader: ImageReader,
    index: RenderedFrameIndex,
    rng: np.random.Generator,
    order: np.random.Generator | None = None,
    cpu_clock: Callable[[], float] = time.process_time,
) -> Predictions:
    """Run a model and classify its images.

    An image that equals a rendered frame gets that frame's macrostate; the reader classifies the rest. A model is
    handed copies, so that it cannot change the questions of other models. ``order`` shuffles the questions; without it
    they are asked in their own order. ``cpu_clock`` is that of the process in which the model is.

    Raises InvalidValueError as :func:`imagined_by`.
    """
    answers: list[Imagined] = []
    cpu_s = 0.0
    shuffled = np.arange(len(questions.frames))
    if order is not None:
        order.shuffle(shuffled)
    places = np.argsort(shuffled)
    for at in range(0, len(questions.frames), _AT_ONCE):
        rows = shuffled[at : at + _AT_ONCE]
        own = np.random.default_rng(int(rng.integers(2**63)))  # a model elsewhere cannot draw on from the same
        begun_s = cpu_clock()
        answers.append(imagined_by(model, name, questions.frames[rows], questions.actions[rows], samples, own))
        cpu_s += cpu_clock() - begun_s
    drawn = [0 if each.probabilities is not None else each.pictures.shape[1] for each in answers]
    given = {name: [getattr(each, name) for each in answers] for name in _OFFERED}
    return Predictions(
        states=_joined([index.read(each.pictures, reader) for each in answers], -1)[places],
        weights=_joined([weights_of(each) for each in answers])[places],
        drawn=np.repeat(drawn, [len(each.pictures) for each in answers])[places],
        offered={
            name: _joined(parts)[places] for name, parts in given.items() if all(part is not None for part in parts)
        },
        cpu_s=cpu_s,
        steps=sum(int(np.prod(each.pictures.shape[:3])) for each in answers),
    )


def transition_table(questions: EvalSet, predictions: Predictions, states: Sequence[State]) -> TransitionTable:
    """A model's predictions for the questions of one step, in the order of :func:`.questions.one_step`.

    Args:
        questions: Every macro-action in every macrostate in which an episode goes on.
        predictions: The model's.
        states: The T macrostates of the table's columns.
    """
    columns = rows_of(predictions.states[:, :, 0], states)  # [N, S]
    shares = np.zeros((len(columns), len(states) + 1))
    np.add.at(shares, (np.arange(len(columns))[:, None], columns), predictions.weights[:, :, 0])
    shape = (len(questions.macrostates), -1, FRAMES)
    by_frame = shares.reshape(*shape, len(states) + 1)
    return TransitionTable(by_frame=by_frame, drawn=predictions.drawn.reshape(shape))


def imagined_by(
    model: WorldModel, name: str, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator
) -> Imagined:
    """The imagined futures of a model, checked; see :class:`.interfaces.model.WorldModel`.

    Raises:
        InvalidValueError: The model fails, or returns a type, shape or value that is not allowed; the message
            names model and method.
    """
    depth = actions.shape[1] - frames.shape[1] + 1
    found = call(name, "imagine", model.imagine, frames, actions, samples, rng)
    return require_imagined(found, name=name, rows=len(frames), depth=depth, samples=samples)


def ask_together(ask: Callable[[EvalSet, str], Predictions], sets: Mapping[str, EvalSet]) -> dict[str, Predictions]:
    """The predictions of sets of questions; those with one kind of history are asked as one, shuffled together."""
    kinds: dict[tuple[tuple[int, ...], ...], list[str]] = {}
    for name, each in sets.items():
        kinds.setdefault((each.frames.shape[1:], each.actions.shape[1:]), []).append(name)
    found = {}
    for names in kinds.values():
        parts = [sets[name] for name in names]
        together = EvalSet(
            states=tuple(state for part in parts for state in part.states),
            frames=np.concatenate([part.frames for part in parts]),
            actions=np.concatenate([part.actions for part in parts]),
            truth=tuple(steps for part in parts for steps in part.truth),
        )
        predictions = ask(together, names[0])
        ends = np.cumsum([len(part.states) for part in parts])
        for name, part, end in zip(names, parts, ends.tolist(), strict=True):
            found[name] = predictions.of_rows(end - len(part.states), end)
    return found


def call(name: str, method: str, function: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """The answer of a model's method; InvalidValueError, naming both, where it raises."""
    try:
        return function(*arguments, **named)
    except GuestError as error:
        raise InvalidValueError(f"World model {name}: {method}() failed ({error}).") from error
    except ImagineBenchError as error:
        said = f"World model {name}: {method}()"
        known = str(error).startswith(said)
        raise InvalidValueError(str(error) if known else f"{said} failed: {error}") from error
    except Exception as error:  # whatever a model does wrong is one sentence
        raise InvalidValueError(f"World model {name}: {method}() failed ({fault(error)}).") from error


def _joined(parts: Sequence[NDArray[N]], missing: int = 0) -> NDArray[N]:
    """Batches one behind another, with as many futures each: those that are missing weigh 0, or show -1, nothing."""
    most = max(part.shape[1] for part in parts)
    wide = []
    for part in parts:
        around = [(0, 0), (0, most - part.shape[1]), *[(0, 0)] * (part.ndim - 2)]
        wide.append(np.pad(part, around, constant_values=missing))
    return np.concatenate(wide)
