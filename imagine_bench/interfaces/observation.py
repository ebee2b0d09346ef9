"""The interface between an environment and an agent: observations and the transitions between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from imagine_bench.arrays import Array, Frame, Info, Macrostate, Observed, read_only

OBSERVATIONS = ("frame", "human", "state", "proprio")
"""Parts of an observation of one moment, by our environments."""
PROPRIO_SIZE = 16
"""Joints, fingers, and the tool's position and quaternion."""
FRAME_PX = 64
"""Edge of a frame, in pixels."""
OBSERVATION_SIZES_PX = (32, 256)
"""Smallest and largest edge of an image that is observed instead of a frame, in pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """One observation, which an agent is given before it acts. Its arrays cannot be written to."""

    #: the camera image, uint8. Shape (64, 64, 3), or as the protocol says (size, size, 3), or (0, 0, 3) for none
    frame: Frame
    #: the true state, only for agents registered as privileged, as the next; None for every other
    macrostate: Macrostate | None = None
    #: the content of ``frame``, of the macrostate it was taken of, -1 for a hidden coordinate
    shown: Macrostate | None = None
    #: other parts of :data:`OBSERVATIONS` that the protocol shows, by name; no agent that takes frames alone gets any
    more: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("frame", "macrostate", "shown"):
            array = getattr(self, name)
            if array is not None:
                object.__setattr__(self, name, read_only(array))
        object.__setattr__(self, "more", {name: read_only(part) for name, part in self.more.items()})

    @classmethod
    def of(cls, seen: Observed, info: Info, *, privileged: bool) -> Observation:
        """The part that an agent may see of a frame, or of parts by name; of ``info`` only if it is privileged."""
        more = {name: part for name, part in seen.items() if name != "frame"} if isinstance(seen, Mapping) else {}
        frame = seen.get("frame", np.zeros((0, 0, 3), dtype=np.uint8)) if isinstance(seen, Mapping) else seen
        if not privileged:
            return cls(frame=frame, more=more)
        macrostate = np.asarray(info["macrostate"])
        return cls(frame=frame, macrostate=macrostate, shown=np.asarray(info.get("shown", macrostate)), more=more)


@dataclass(frozen=True, slots=True, kw_only=True)
class Transition:
    """One real macro-action and its result. ``terminated`` stops bootstrapping, ``truncated`` does not."""

    observation: Observation
    action: int
    reward: float
    next_observation: Observation
    terminated: bool
    truncated: bool
