"""What a model answers: it is asked an :class:`.EvalSet`, and its images are read as macrostates."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Arrays, Images, Ints
from imagine_bench.errors import ImagineBenchError, InvalidValueError, plain
from imagine_bench.interfaces import Floats, Frame, State, TaskSpec
from imagine_bench.interfaces.model import UNCERTAINTIES, Imagined, WorldModel, require_imagined, weights_of
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.truth import Distribution, added_up
from imagine_bench.rules import states_of
from imagine_bench.running.isolation import GuestError
from imagine_bench.seeding import SeedTree

_READ = 1_000  # frames that a reader is measured on
_AT_ONCE = 96  # questions handed to a model at a time, to bound memory
P = ParamSpec("P")
T = TypeVar("T")
N = TypeVar("N", bound=np.generic)
_OFFERED = ("rewards", "p_ended", "accepted", *UNCERTAINTIES)


class ImageReader(Protocol):
    """What reads images; see :mod:`imagine_bench.agents.world_models.reader`."""

    def read(self, pictures: Images) -> Ints:
        """Macrostates (N, M) of images (N, H, W) or (N, H, W, 3); -1 where one shows nothing of this world."""


def reader_errors(reader: ImageReader, spec: TaskSpec, appearance: str) -> dict[str, float]:
    """Error rates of a reader, on frames that it was not trained on and on images that show nothing of this world.

    Shares of real frames: ``misread``, taken for another macrostate, and ``refused``; the others are shares taken for
    an image of this world of black and gray fog, noise, and blends of two frames of different macrostates.
    """
    rng = SeedTree(1).child("encoder_probe", "judge", spec.id, appearance).generator()
    states = np.array(states_of(spec.rules), dtype=np.int64)
    macrostates, others = (states[rng.integers(len(states), size=_READ)] for _ in range(2))
    frames, blended = (spec.render_macrostates(each, appearance, rng) for each in (macrostates, others))
    differ = (macrostates != others).any(axis=1)
    of_nothing = {
        "black": np.zeros_like(frames[:1]),
        "gray": np.full_like(frames[:1], 128),
        "noise": rng.integers(0, 256, frames.shape, dtype=np.uint8),
        "blends": ((frames[differ].astype(np.uint16) + blended[differ]) // 2).astype(np.uint8),
    }
    read = reader.read(frames)
    refused = read[:, 0] < 0
    wrong = (read != macrostates).any(axis=1) & ~refused
    found = {"misread": float(wrong.mean()), "refused": float(refused.mean())}
    for name, images in of_nothing.items():
        found[f"{name}_read"] = float((reader.read(images)[:, 0] >= 0).mean())
    return found


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

    def read(self, images: Images, reader: ImageReader) -> Ints:
        """Macrostates (N, S, D, M) of images (N, S, D, ...); a reader reads what was not rendered, equal ones once."""
        flat = images.reshape(-1, *images.shape[3:])
        keys = [_key(image) for image in flat]
        unknown = {key: row for row, key in enumerate(keys) if key not in self._shows}
        read = reader.read(flat[list(unknown.values())]).tolist() if unknown else []
        shown = dict(zip(unknown, map(tuple, read), strict=True))
        states = [self._shows.get(key) or shown[key] for key in keys]
        return np.array(states, dtype=np.int64).reshape(*images.shape[:3], -1)


def _key(image: Images) -> bytes:
    """A digest of an image (H, W, 3) or (H, W)."""
    return hashlib.sha256(f"{image.shape}".encode() + np.ascontiguousarray(image).tobytes()).digest()


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """What a model imagines of an :class:`.EvalSet`, as read, in S futures."""

    states: Ints  #: Shape (N, S, D, M); -1 where an image shows nothing of this world.
    weights: Floats  #: Probability of each image at its depth. Shape (N, S, D).
    #: Futures that were drawn for each question, all equally likely; 0 where the model gives probabilities. Shape (N,).
    drawn: Ints
    offered: Arrays  #: What else the model offers, by its name in :class:`.Imagined`. Shapes (N, S, D) or (N, D).
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
        """What the model offers of the first macro-action, by name, if it does. Shape (N, S) or (N,)."""
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

    Raises:
        InvalidValueError: The model fails, or hands in what it must not; the message names model and method.
    """
    answers: list[Imagined] = []
    cpu_s = 0.0
    shuffled = np.arange(len(questions.frames))
    if order is not None:
        order.shuffle(shuffled)
    places = np.argsort(shuffled)
    for at in range(0, len(questions.frames), _AT_ONCE):
        rows = shuffled[at : at + _AT_ONCE]
        frames = questions.frames[rows]
        own = np.random.default_rng(int(rng.integers(2**63)))  # a model elsewhere cannot draw on from the same
        begun_s = cpu_clock()
        imagined = call(name, "imagine", model.imagine, frames, questions.actions[rows], samples, own)
        cpu_s += cpu_clock() - begun_s
        depth = questions.asked.shape[1]
        answers.append(require_imagined(imagined, name=name, rows=len(frames), depth=depth, samples=samples))
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
    """What a model's method returns; InvalidValueError, naming both, where it raises."""
    try:
        return function(*arguments, **named)
    except GuestError as error:
        raise InvalidValueError(f"World model {name}: {method}() failed ({error}).") from error
    except ImagineBenchError as error:
        said = f"World model {name}: {method}()"
        known = str(error).startswith(said)
        raise InvalidValueError(str(error) if known else f"{said} failed: {error}") from error
    except Exception as error:  # whatever a model does wrong is one sentence
        why = f"{type(error).__name__}: {plain(error)}".partition("\n")[0]
        raise InvalidValueError(f"World model {name}: {method}() failed ({why}).") from error


def _joined(parts: Sequence[NDArray[N]], missing: int = 0) -> NDArray[N]:
    """Batches one behind another, with as many futures each: those that are missing weigh 0, or show -1, nothing."""
    most = max(part.shape[1] for part in parts)
    wide = []
    for part in parts:
        around = [(0, 0), (0, most - part.shape[1]), *[(0, 0)] * (part.ndim - 2)]
        wide.append(np.pad(part, around, constant_values=missing))
    return np.concatenate(wide)
