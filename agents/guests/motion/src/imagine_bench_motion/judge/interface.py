"""The interface of a model of motions that is judged: a frame and a motion's commands in, the frame at its end out.

A package offers models in the group of entry points :data:`GROUP`, each the ``"module:attr"`` of a
:class:`MotionModelEntry`. Shapes: ``N`` motions, ``T`` control periods of the longest, ``A`` numbers of an action.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.registry.entries import ENCODER_KINDS

GROUP = "imagine_bench.motion_models"
"""Entry points in which packages offer models of motions, this one too."""
LEVELS = ("commands", "macro-action")
"""The input of a model about a motion: all its commands, or the one macro-action that it was planned for."""


@dataclass(frozen=True, kw_only=True)
class MotionModelEntry:
    """A model of motions that a package offers.

    Raises:
        UnknownNameError: No such level or kind of encoder.
    """

    make: str  #: ``"module:attr"`` of a function from AgentContext to :class:`MotionModel`
    level: str  #: One of :data:`LEVELS`; it only stands in tables
    description: str  #: One sentence for a reader who knows none of this
    encoder_kind: str | None = None  #: Which of the task's encoders it sees through, ``"latents"`` or ``"codes"``

    def __post_init__(self) -> None:
        require_known("level", self.level, LEVELS)
        if self.encoder_kind is not None:
            require_known("kind of encoder", self.encoder_kind, ENCODER_KINDS)


registry.describe_group(GROUP, what="model of motions", kind=MotionModelEntry, own=())


def motion_models() -> dict[str, MotionModelEntry]:
    """All models of motions by name, of this package and of others, without those that cannot be loaded."""
    return registry.usable(GROUP)


def motion_model_entry(name: str) -> MotionModelEntry:
    """The entry of a model of motions.

    Raises:
        UnknownNameError: No such model; the message lists those that there are.
        SetupError: Its package offers something else under this name, or nothing that can be loaded.
    """
    entry: MotionModelEntry = registry.offered(name, {}, GROUP)
    return entry


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
    """A model of motions from anyone; an instance is fitted once, in a process of its own."""

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
            f"Model of motions {name}: imagine_motion() gave {given}; give uint8 of shape ({rows}, 64, 64, 3)."
        )
    return frames
