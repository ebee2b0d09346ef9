"""Poses of objects, as they are and as the planner takes them to be.

How an object stands, is turned and tipped, read from its pose: x, y, z (m), and unit quaternion w, x, y, z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from imagine_bench.interfaces import Floats, PhysicsSettings


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

    position_m: Floats  #: of its origin in the world. Shape (3,).
    yaw_rad: float  #: heading of its x axis
    tilt_rad: float  #: of its z axis from the vertical

    @classmethod
    def of(cls, qpos: Floats) -> ObjectPose:
        """From a free joint's coordinates (7,), whose quaternion may have lost its unit length."""
        w, x, y, z = (qpos[3:] / math.sqrt(qpos[3:] @ qpos[3:])).tolist()
        return cls(position_m=qpos[:3].copy(), yaw_rad=yaw_rad(w, x, y, z), tilt_rad=tilt_rad(x, y))


@dataclass
class Sensing:
    """The poses of objects, as a world tells them to its executor."""

    settings: PhysicsSettings = field(default_factory=PhysicsSettings)
    aside_m: tuple[float, float] = (0.0, 0.0)  #: error of this macro-action, in the world's x and y
    turned_rad: float = 0.0  #: error of this macro-action, about the vertical

    def draw(self, rng: np.random.Generator) -> None:
        """Draw the errors of the next macro-action; nothing is drawn where they are 0."""
        if self.settings.plan_error_mm:
            angle_rad = rng.uniform(-math.pi, math.pi)
            off_m = 1e-3 * self.settings.plan_error_mm
            self.aside_m = (off_m * math.cos(angle_rad), off_m * math.sin(angle_rad))
        if self.settings.plan_error_deg:
            self.turned_rad = math.radians(self.settings.plan_error_deg) * (1 if rng.random() < 0.5 else -1)

    def pose(self, qpos: Floats, nominal_m: Floats) -> ObjectPose:
        """An object's pose without error: true, from its free joint (7,), or nominal, upright at a right angle."""
        if self.settings.sense == "nominal":
            return ObjectPose(position_m=np.array(nominal_m), yaw_rad=0.0, tilt_rad=0.0)
        return ObjectPose.of(qpos)

    def erring(self, pose: ObjectPose) -> ObjectPose:
        """The pose, with the error of this macro-action, of the object that it is about."""
        if self.aside_m == (0.0, 0.0) and self.turned_rad == 0.0:
            return pose
        position_m = pose.position_m + np.array([*self.aside_m, 0.0])
        return replace(pose, position_m=position_m, yaw_rad=pose.yaw_rad + self.turned_rad)
