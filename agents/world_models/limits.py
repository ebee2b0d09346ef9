"""The two ends of the scale: a model that says that nothing changes, and the rules themselves with the renderer."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from imagine_bench.arrays import Frame, Ints, Pixels, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, TaskSpec
from imagine_bench.interfaces.model import Imagined, Untaught, imagined_outcomes
from imagine_bench.rules import Outcomes, outcomes_by_depth


class MacrostateRenderer(Protocol):
    """Frames of macrostates that the judge rendered."""

    def frame(self, state: State) -> Frame:
        """One frame (64, 64, 3) of a macrostate, always the same."""

    def shows(self, image: Pixels) -> State | None:
        """The macrostate of a rendered frame; None for any other image."""


class Copy(Untaught):
    """Says that nothing ever changes, is rewarded or ends."""

    def __init__(self, context: AgentContext) -> None:
        del context

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """The last frame, whatever is done; see :class:`imagine_bench.interfaces.model.WorldModel`."""
        del samples, rng
        rows = len(frames)
        depth = actions.shape[1] - frames.shape[1] + 1
        images = np.broadcast_to(frames[:, None, -1:], (rows, 1, depth, *frames.shape[2:]))
        return Imagined(pictures=images, probabilities=np.ones((rows, 1, depth)))


class Exact(Untaught):
    """The rules, and a rendered frame of each outcome; it knows the content of each frame of the judge."""

    def __init__(self, spec: TaskSpec, renderer: MacrostateRenderer) -> None:
        self._rules = spec.rules
        self.renderer = renderer

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Every outcome with its probability; see :class:`imagine_bench.interfaces.model.WorldModel`."""
        del samples, rng
        depth = actions.shape[1] - frames.shape[1] + 1
        found = [self._outcomes(history[-1], row[-depth:]) for history, row in zip(frames, actions, strict=True)]
        unknown = np.zeros((len(frames), depth))
        return replace(imagined_outcomes(found, self.renderer.frame), epistemic=unknown)

    def _outcomes(self, frame: Frame, actions: Ints) -> tuple[Outcomes, ...]:
        state = self.renderer.shows(frame)
        if state is None:
            raise InvalidValueError("The exact model was given a frame that the judge did not render.")
        return outcomes_by_depth(self._rules, state, actions.tolist())
