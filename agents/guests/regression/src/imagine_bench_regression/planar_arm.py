"""The planar arm that carries predicted configurations out, in MuJoCo."""

from __future__ import annotations

import functools
from importlib import resources

import mujoco
import numpy as np
from imagine_bench.tasks.scene_reader import body_poses, motion_of, shapes_of

from imagine_bench.arrays import Floats
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Motion, Shape3D

MOVE_S = 1.6
"""Simulated seconds of a movement; the servos have come to rest by then (a test says how near)."""
_REMEMBERED = 50_000
"""Movements whose end is kept: every variant of a network's data begins with the same ones."""


class PlanarArm:
    """The arm above its table. It holds one simulation; use it from one thread."""

    def __init__(self) -> None:
        xml = (resources.files(__package__) / "planar_arm.xml").read_text()
        self.model = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self.model)
        self._steps = round(MOVE_S / self.model.opt.timestep)
        self._tip_at_rest = functools.lru_cache(maxsize=_REMEMBERED)(self._carry_out)

    def execute(self, joints_rad: Floats) -> Floats:
        """Let the servos move the arm from rest at zero to each configuration, and measure where its tip comes to rest.

        Joints stop at their limits, so that a configuration beyond them is not reached.

        Args:
            joints_rad: Shape (N, 3).

        Returns:
            Positions of the tip in the plane, in metres. Shape (N, 2).

        Raises:
            InvalidValueError: A joint is NaN or infinite, which MuJoCo would take for 0.
        """
        if not np.isfinite(joints_rad).all():
            raise InvalidValueError("Joints that are NaN or infinite cannot be carried out; give finite radians.")
        places = [self._tip_at_rest(*target) for target in joints_rad.tolist()]
        return np.array(places).reshape(-1, 2)

    def _carry_out(self, *target_rad: float) -> tuple[float, ...]:
        mujoco.mj_resetData(self.model, self._data)
        self._data.ctrl[:] = target_rad
        mujoco.mj_step(self.model, self._data, self._steps)
        mujoco.mj_kinematics(self.model, self._data)
        return tuple(self._data.site("tip").xpos[:2].tolist())

    def movement(self, joints_rad: Floats, hz: float) -> Motion:
        """How every body moves while the servos go from zero to one configuration (3,), sampled ``hz`` a second.

        Samples are whole steps apart; the last one is where the arm has come to rest, if that divides the movement.
        """
        data = self._data
        mujoco.mj_resetData(self.model, data)
        data.ctrl[:] = joints_rad
        every = round(1 / (hz * self.model.opt.timestep))
        times_s = []
        poses = []
        for _ in range(0, self._steps + 1, every):
            mujoco.mj_kinematics(self.model, data)
            times_s.append(data.time)
            poses.append(body_poses(data))
            mujoco.mj_step(self.model, data, every)
        return motion_of(self.model, times_s, poses)

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable part."""
        return shapes_of(self.model)
