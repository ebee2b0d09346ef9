"""How a thing is turned and tipped, read from its unit quaternion (w, x, y, z) in the world frame."""

from __future__ import annotations

import math


def yaw_rad(w: float, x: float, y: float, z: float) -> float:
    """Rotation about the vertical, in (-pi, pi]."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def tilt_rad(x: float, y: float) -> float:
    """Angle between its own vertical and the world's, in [0, pi]."""
    return math.acos(max(-1.0, 1.0 - 2.0 * (x * x + y * y)))
