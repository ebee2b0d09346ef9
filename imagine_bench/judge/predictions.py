"""What a model answers: it is asked an :class:`.EvalSet`, and its images are read as macrostates."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import ImagineBenchError, InvalidValueError, plain
from imagine_bench.interfaces import Floats, Frame, State, TaskSpec
from imagine_bench.interfaces.model import UNCERTAINTIES, Imagined, WorldModel, require_imagined, weights_of
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.truth import Distribution, added_up
from imagine_bench.seeding import SeedTree

_AT_ONCE = 96  # questions handed to a model at a time, to bound memory
P = ParamSpec("P")
T = TypeVar("T")
Images = NDArray[np.uint8] | NDArray[np.floating]


class ImageReader(Protocol):
    """What reads images; see :mod:`imagine_bench.agents.world_models.reader`."""

    def read(self, pictures: Images) -> NDArray[np.int64]:
        """Macrostates (N, M) of images (N, H, W) or (N, H, W, 3); -1 where one shows nothing of this world."""


class RenderedFrameIndex:
    """Frames of macrostates that were rendered for one judgement, and what each of them shows, to the pixel."""

    def __init__(self, spec: TaskSpec, appearance: str) -> None:
        self._spec = spec
        self._appearance = appearance
        self._shows: dict[bytes, State] = {}
        self._frames: dict[State, Frame] = {}

    def render(self, states: Sequence[State], rng: np.random.Generator) -> Frame:
        """A new frame of each of N macrostates, which is remembered. Shape (N, 64, 64, 3)."""
        frames = self._spec.render_macrostates(np.array(states, dtype=np.int64), self._appearance, rng)
        for frame, state in zip(frames, states, strict=True):
            self._shows[_key(frame)] = state
        return frames

    def frame(self, state: State) -> Frame:
        """One frame of a macrostate, always the same."""
        if state not in self._frames:
            rng = SeedTree(0).child("evaluation", "judge", "gallery", self._spec.id, *state).generator()
            self._frames[state] = self.render([state], rng)[0]
        return self._frames[state]

    def shows(self, image: NDArray[np.uint8]) -> State | None:
        """The macrostate of an image that is a rendered frame to the pixel; None for any other."""
        return self._shows.get(_key(image))


def _key(image: Images) -> bytes:
    """A digest of an image (H, W, 3) or (H, W)."""
    return hashlib.sha256(f"{image.shape}".encode() + np.ascontiguousarray(image).tobytes()).digest()


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """What a model imagines of an :class:`.EvalSet`, as read, in S futures."""

    states: NDArray[np.int64]  #: Shape (N, S, D, M); -1 where an image shows nothing of this world.
    weights: Floats  #: Probability of each image at its depth. Shape (N, S, D).
    rewards: Floats | None  #: Shape (N, S, D).
    p_ended: Floats | None  #: Shape (N, S, D).
    uncertainties: dict[str, Floats]  #: Those offered, by name, each (N, D).
    accepted: NDArray[np.bool_] | None  #: Whether a filter of its own keeps it. Shape (N, D).
    cpu_s: float  #: CPU seconds of imagining, reading apart
    steps: int  #: Macro-actions imagined, N D of each future

    @property
    def epistemic(self) -> Floats | None:
        """The epistemic uncertainty of the first step, if it is offered. Shape (N,)."""
        offered = self.uncertainties.get("epistemic")
        return None if offered is None else offered[:, 0]

    def distribution(self, row: int, step: int) -> Distribution:
        """Of the macrostates after a step."""
        futures = zip(self.states[row, :, step].tolist(), self.weights[row, :, step].tolist(), strict=True)
        return added_up((tuple(state), weight) for state, weight in futures if weight)


def evaluate(
    model: WorldModel,
    name: str,
    questions: EvalSet,
    *,
    samples: int,
    reader: ImageReader,
    index: RenderedFrameIndex,
    rng: np.random.Generator,
) -> Predictions:
    """Run a model and classify its images.

    An image that equals a rendered frame gets that frame's macrostate; the reader classifies the rest.

    Raises:
        InvalidValueError: The model fails, or hands in what it must not; the message names model and method.
    """
    answers: list[Imagined] = []
    states = []
    cpu_s = 0.0
    for at in range(0, len(questions.frames), _AT_ONCE):
        some = slice(at, at + _AT_ONCE)
        begun_s = time.process_time()
        imagined = call(name, "imagine", model.imagine, questions.frames[some], questions.actions[some], samples, rng)
        cpu_s += time.process_time() - begun_s
        rows = len(questions.frames[some])
        require_imagined(imagined, name=name, rows=rows, depth=questions.depth, samples=samples)
        answers.append(imagined)
        states.append(read_images(imagined, reader, index, len(questions.states[0])))
    offered = {each: _all_of(answers, each) for each in UNCERTAINTIES}
    accepted = _all_of(answers, "accepted")
    return Predictions(
        states=_joined(states, -1),
        weights=_joined([weights_of(each) for each in answers], 0),
        rewards=_padded(_all_of(answers, "rewards")),
        p_ended=_padded(_all_of(answers, "p_ended")),
        accepted=np.concatenate(accepted).astype(np.bool_) if accepted else None,
        uncertainties={each: np.concatenate(parts) for each, parts in offered.items() if parts},
        cpu_s=cpu_s,
        steps=sum(int(np.prod(each.pictures.shape[:3])) for each in answers),
    )


def call(name: str, method: str, function: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
    """What a model's method returns; InvalidValueError, naming both, where it raises."""
    try:
        return function(*arguments, **named)
    except ImagineBenchError as error:
        raise InvalidValueError(f"World model {name}: {method}() failed: {error}") from error
    except Exception as error:  # whatever a model does wrong is one sentence
        why = f"{type(error).__name__}: {plain(error)}".partition("\n")[0]
        raise InvalidValueError(f"World model {name}: {method}() failed ({why}).") from error


def read_images(
    imagined: Imagined, reader: ImageReader, index: RenderedFrameIndex, coordinates: int
) -> NDArray[np.int64]:
    """Macrostates (N, S, D, M) of what was imagined; equal images are read once."""
    shape = imagined.pictures.shape
    images = imagined.pictures.reshape(-1, *shape[3:])
    places: dict[bytes, list[int]] = {}
    for row, image in enumerate(images):
        places.setdefault(_key(image), []).append(row)
    read = np.full((len(images), coordinates), -1, dtype=np.int64)
    unknown = []
    for rows in places.values():
        state = index.shows(images[rows[0]]) if images.dtype == np.uint8 else None
        if state is None:
            unknown.append(rows)
        else:
            read[rows] = state
    if unknown:
        for rows, found in zip(unknown, reader.read(images[[rows[0] for rows in unknown]]), strict=True):
            read[rows] = found
    return read.reshape(*shape[:3], coordinates)


def _all_of(answers: Sequence[Imagined], field: str) -> list[Floats]:
    """A field of every batch; empty unless each offers it."""
    there = [array for array in (getattr(each, field) for each in answers) if array is not None]
    return there if len(there) == len(answers) else []


def _padded(parts: Sequence[Floats]) -> Floats | None:
    return _joined([part.astype(np.float64) for part in parts], 0) if parts else None


N = TypeVar("N", np.int64, np.float64)


def _joined(parts: Sequence[NDArray[N]], fill: int) -> NDArray[N]:
    """Batches one behind another, with as many futures each: those missing have weight 0 and show nothing."""
    most = max(part.shape[1] for part in parts)
    whole = []
    for part in parts:
        missing = [(0, 0)] * part.ndim
        missing[1] = (0, most - part.shape[1])
        whole.append(np.pad(part, missing, constant_values=fill))
    return np.concatenate(whole)
