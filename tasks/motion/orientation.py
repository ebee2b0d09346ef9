"""How an object stands, is turned and tipped, read from its pose: x, y, z (m), and unit quaternion w, x, y, z."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def yaw_rad(w: float, x: float, y: float, z: float) -> float:
    """Rotation about the vertical, in (-pi, pi]."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def tilt_rad(x: float, y: float) -> float:
    """Angle between its own vertical and the world's, in [0, pi]."""
    return math.acos(max(-1.0, 1.0 - 2.0 * (x * x + y * y)))


def about_vertical(yaw_rad: float) -> tuple[float, float, float, float]:
    """The quaternion of a rotation about the vertical."""
    return (math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2))


@dataclass(frozen=True, kw_only=True)
class ObjectPose:
    """An object as measured."""

    position_m: NDArray[np.float64]  #: of its origin in the world. Shape (3,).
    yaw_rad: float  #: heading of its x axis
    tilt_rad: float  #: of its z axis from the vertical

    @classmethod
    def of(cls, qpos: NDArray[np.float64]) -> ObjectPose:
        """From a free joint's coordinates (7,), whose quaternion may have lost its unit length."""
        w, x, y, z = (qpos[3:] / math.sqrt(qpos[3:] @ qpos[3:])).tolist()
        return cls(position_m=qpos[:3].copy(), yaw_rad=yaw_rad(w, x, y, z), tilt_rad=tilt_rad(x, y))
