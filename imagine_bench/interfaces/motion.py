"""The interface of a model of motions that is judged: a frame and a motion's commands in, the frame at its end out.

Shapes: ``N`` motions, ``T`` control periods of the longest, ``A`` numbers of an action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.errors import InvalidValueError


@dataclass(frozen=True, kw_only=True)
class Motions:
    """N motions that a model learns from."""

    before: Frame  #: the scene at rest, as the camera of macro-actions sees it, uint8. Shape (N, 64, 64, 3).
    after: Frame  #: the scene when the motion is over, likewise. Shape (N, 64, 64, 3).
    actions: Floats32  #: commands of ``control="twist"``, zeros after a motion's end. Shape (N, T, A).
    lengths: Ints  #: control periods of each motion. Shape (N,).
    labels: Ints  #: the macro-action that each motion was planned for, whatever became of it. Shape (N,).

    def __len__(self) -> int:
        return len(self.labels)


class MotionModel(Protocol):
    """A model of motions from anyone; an instance is fitted once."""

    def fit(self, dataset: Motions, rng: np.random.Generator) -> None:
        """Learn from real motions; everything random is drawn from ``rng``."""

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """The frame at the end of each motion, uint8.

        Args:
            frames: The scene before. Shape (N, 64, 64, 3), uint8.
            actions: As in :class:`Motions`; T may be another than in training. Shape (N, T, A).
            lengths: Shape (N,).
            labels: Shape (N,). A model of motion ignores them; a model of macro-actions knows nothing else.
        """

    def parameters(self) -> int:
        """Numbers that were fitted."""


def require_frames(frames: object, *, name: str, rows: int) -> Frame:
    """The answer of a model of motions, checked to be N frames. Raises InvalidValueError: another type or shape."""
    if not isinstance(frames, np.ndarray) or frames.dtype != np.uint8 or frames.shape != (rows, 64, 64, 3):
        given = f"{frames.dtype} {frames.shape}" if isinstance(frames, np.ndarray) else type(frames).__name__
        raise InvalidValueError(
            f"World model {name}: imagine_motion() gave {given}; give uint8 of shape ({rows}, 64, 64, 3)."
        )
    return frames
