"""Where the planner takes objects to be: the executor measures true poses unless a setting makes it blind or wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from imagine_bench.interfaces import Floats, PhysicsSettings

from .orientation import ObjectPose


@dataclass
class Sensing:
    """What a world tells its executor of objects' poses."""

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
