"""The two ends of the scale: a model that says that nothing changes, and the rules themselves with the renderer."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, Frame, State, TaskSpec
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined
from imagine_bench.judge.models.truth import Outcomes, outcomes_by_depth
from imagine_bench.seeding import SeedTree


class Gallery:
    """Frames of macrostates that were rendered for one judgement, and what each of them shows, to the pixel."""

    def __init__(self, spec: TaskSpec, appearance: str) -> None:
        self._spec, self._appearance = spec, appearance
        self._shows: dict[bytes, State] = {}
        self._frames: dict[State, Frame] = {}

    def render(self, states: list[State], rng: np.random.Generator) -> Frame:
        """A new frame of each of N macrostates, which is remembered. Shape (N, 64, 64, 3)."""
        frames = self._spec.render_macrostates(np.array(states, dtype=np.int64), self._appearance, rng)
        self._shows |= {key_of(frame): state for frame, state in zip(frames, states, strict=True)}
        return frames

    def frame(self, state: State) -> Frame:
        """One frame of a macrostate, always the same."""
        if state not in self._frames:
            rng = SeedTree(0).child("evaluation", "judge", "gallery", self._spec.id, *state).generator()
            self._frames[state] = self.render([state], rng)[0]
        return self._frames[state]

    def shows(self, picture: NDArray[np.uint8]) -> State | None:
        """What a picture shows that is a rendered frame to the pixel; None for any other."""
        return self._shows.get(key_of(picture))


def key_of(picture: NDArray[np.uint8]) -> bytes:
    """What stands for a picture (H, W, 3) or (H, W)."""
    return hashlib.sha256(f"{picture.shape}".encode() + np.ascontiguousarray(picture).tobytes()).digest()


class Copy:
    """Says that nothing ever changes, is rewarded or ends."""

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Learn nothing."""
        del dataset, rng

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        """The last frame, whatever is done; see :class:`.interfaces.model.WorldModel`."""
        del samples, rng
        rows, depth = len(frames), actions.shape[1] - frames.shape[1] + 1
        shape = (rows, 1, depth, *frames.shape[2:])
        pictures = np.broadcast_to(frames[:, None, -1:], shape)
        return Imagined(pictures=pictures, probabilities=np.ones(shape[:3]))

    def parameters(self) -> int:
        """None."""
        return 0


class Exact:
    """The rules, and a rendered frame of each outcome; it reads what a frame of the gallery shows."""

    def __init__(self, spec: TaskSpec, gallery: Gallery) -> None:
        self._rules, self.gallery = spec.rules, gallery

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Learn nothing: it knows."""
        del dataset, rng

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        """Every outcome with its probability; see :class:`.interfaces.model.WorldModel`."""
        del samples, rng
        depth = actions.shape[1] - frames.shape[1] + 1
        found = [self._outcomes(history[-1], row[-depth:]) for history, row in zip(frames, actions, strict=True)]
        futures = max(len(outcomes) for steps in found for outcomes in steps)
        shape = (len(frames), futures, depth)
        pictures = np.zeros((*shape, *frames.shape[2:]), dtype=np.uint8)
        weights, rewards, ended = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        for row, steps in enumerate(found):
            for step, outcomes in enumerate(steps):
                for slot, ((state, over), (share, reward)) in enumerate(outcomes.items()):
                    pictures[row, slot, step] = self.gallery.frame(state)
                    weights[row, slot, step], ended[row, slot, step] = share, over
                    rewards[row, slot, step] = reward
        unknown = np.zeros((len(frames), depth))
        return Imagined(pictures=pictures, probabilities=weights, rewards=rewards, p_ended=ended, epistemic=unknown)

    def _outcomes(self, frame: Frame, actions: NDArray[np.int64]) -> tuple[Outcomes, ...]:
        state = self.gallery.shows(frame)
        if state is None:
            raise InvalidValueError("The exact model was given a frame that the judge did not render.")
        return outcomes_by_depth(self._rules, state, actions.tolist())

    def parameters(self) -> int:
        """None."""
        return 0


def make_copy(context: AgentContext) -> Copy:
    """The model that says that nothing changes."""
    del context
    return Copy()


def make_exact(spec: TaskSpec, gallery: Gallery) -> Exact:
    """The rules and the renderer."""
    return Exact(spec, gallery)
