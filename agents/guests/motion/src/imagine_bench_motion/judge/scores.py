"""Scores of a model of motions: is the imagined final frame the right macrostate, also of a motion that grips nothing?

Truth is the simulator itself, which is deterministic, and at its end the macrostate that the rules' reader finds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from imagine_bench.arrays import Bools, Floats32, Frame, Ints

from .interface import Motions, require_frames
from .questions import MotionQuestions


@dataclass(frozen=True, kw_only=True)
class MotionScores:
    """Shares of questions, in [0, 1]."""

    right: float  #: planned motions whose imagined final frame shows the macrostate that the simulator ends in
    unread: float  #: planned motions whose imagined final frame shows nothing of this world, as the reader says
    raised_right: float  #: likewise of the raised motions, which grip nothing
    painted: float  #: raised motions of which the frame shows the end of the planned one, where that is another end
    pairs: float  #: counterfactual pairs of which both are right
    by_depth: tuple[float, ...]  #: chains that are right after 1, 2, ... motions


class FrameReading(Protocol):
    """Reads macrostates from frames; see :class:`imagine_bench.judge.reading.ImageReader`."""

    def read(self, pictures: Frame) -> Ints:
        """Macrostates (N, M) of frames (N, 64, 64, 3); -1 where one shows nothing of this world."""


class Imagines(Protocol):
    """A fitted model of motions."""

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """See :class:`.interface.MotionModel`."""


def score(name: str, model: Imagines, asked: MotionQuestions, reader: FrameReading) -> MotionScores:
    """Ask a fitted model everything. Raises InvalidValueError: it hands in something else than frames."""

    def imagined(motions: Motions, frames: Frame) -> Frame:
        drawn = model.imagine_motion(frames, motions.actions, motions.lengths, motions.labels)
        return require_frames(drawn, name=name, rows=len(motions))

    planned = asked.planned
    raised = asked.raised
    of_planned = imagined(planned, planned.before)
    right = _shows(reader, of_planned, planned.reached)
    of_raised = imagined(raised, raised.before)
    raised_right = _shows(reader, of_raised, raised.reached)
    differ = (planned.reached[:, :-1] != raised.reached[:, :-1]).any(axis=1)
    painted = _shows(reader, of_raised, planned.reached)[differ]
    still = np.ones(len(asked.chains[0]), dtype=bool)
    by_depth = []
    frames = asked.chains[0].before
    for motions in asked.chains:
        frames = imagined(motions, frames)
        still &= _shows(reader, frames, motions.reached)
        by_depth.append(float(still.mean()))
    return MotionScores(
        right=float(right.mean()),
        unread=float((reader.read(of_planned)[:, 0] < 0).mean()),
        raised_right=float(raised_right.mean()),
        painted=float(painted.mean()) if differ.any() else float("nan"),
        pairs=float((right & raised_right).mean()),
        by_depth=tuple(by_depth),
    )


def _shows(reader: FrameReading, frames: Frame, macrostates: Ints) -> Bools:
    """Whether each frame is read as its macrostate; people's gestures are no matter of a motion. Shape (N,)."""
    found: Bools = (reader.read(frames)[:, :-1] == macrostates[:, :-1]).all(axis=1)
    return found


class Simulator:
    """Hands in the true final frames of the questions: the reader's reading of them bounds every model."""

    def __init__(self, asked: MotionQuestions) -> None:
        every = (asked.planned, asked.raised, *asked.chains)
        self._after = {id(motions.actions): motions.after for motions in every}

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """The frame that the simulator ended with."""
        del frames, lengths, labels
        return self._after[id(actions)]
