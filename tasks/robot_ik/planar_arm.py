"""The planar arm in MuJoCo: what a joint configuration really reaches, mink's solution, motion."""

from __future__ import annotations

import functools
import math
from importlib import resources

import mink
import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats, Motion, Shape3D

from ..scene_reader import body_poses, motion_of, shapes_of

MOVE_S = 1.6
"""Simulated seconds of a movement; the servos have come to rest by then (a test says how near)."""
_REMEMBERED = 50_000
"""Movements whose end is kept: every variant of a network's data begins with the same ones."""
_START_RAD = np.zeros(3)
_TIP = "tip"
_IK_TOLERANCE_M = 1e-4
_IK_STEPS = 60
_IK_STARTS = 8


class PlanarArm:
    """The arm above its table. It holds one simulation; use it from one thread."""

    def __init__(self) -> None:
        xml = (resources.files("imagine_bench.assets") / "planar_arm.xml").read_text()
        self.model = mujoco.MjModel.from_xml_string(xml)
        self._data = mujoco.MjData(self.model)
        self._site = self.model.site(_TIP).id
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
        return tuple(self._data.site_xpos[self._site, :2].tolist())

    def solve(self, targets_m: Floats, rng: np.random.Generator) -> Floats:
        """Joint configurations that mink finds for targets in the plane, from up to 8 random starts each.

        Args:
            targets_m: Shape (N, 2).
            rng: Draws the starts.

        Returns:
            The best found, in radians. Shape (N, 3).
        """
        configuration = mink.Configuration(self.model)
        task = mink.FrameTask(_TIP, "site", position_cost=1.0, orientation_cost=0.0, lm_damping=0.01)
        limits = [mink.ConfigurationLimit(self.model)]
        low, high = self.model.jnt_range.T
        return np.stack([
            _solve_one(configuration, task, limits, target, [_START_RAD, *rng.uniform(low, high, (_IK_STARTS - 1, 3))])
            for target in targets_m
        ])  # fmt: skip

    def movement(self, joints_rad: Floats, hz: float) -> Motion:
        """How every body moves while the servos go from zero to one configuration (3,), sampled ``hz`` a second.

        Samples are whole timesteps apart, at most ``hz`` a second but for the last: it is where the arm has come to
        rest.
        """
        data = self._data
        every = max(1, math.ceil(1.0 / (hz * self.model.opt.timestep) - 1e-9))
        mujoco.mj_resetData(self.model, data)
        data.ctrl[:] = joints_rad
        mujoco.mj_kinematics(self.model, data)
        times = [0.0]
        poses = [body_poses(data)]
        for step in range(0, self._steps, every):
            mujoco.mj_step(self.model, data, min(every, self._steps - step))
            mujoco.mj_kinematics(self.model, data)
            times.append(float(data.time))
            poses.append(body_poses(data))
        return motion_of(self.model, times, poses)

    def shapes(self) -> tuple[Shape3D, ...]:
        """Every drawable part."""
        return shapes_of(self.model)


def _solve_one(
    configuration: mink.Configuration,
    task: mink.FrameTask,
    limits: list[mink.ConfigurationLimit],
    target_m: Floats,
    starts_rad: list[NDArray[np.float64]],
) -> Floats:
    best_rad = starts_rad[0]
    best_m = np.inf  # of an error that also grows with the tool's angle: not below the distance
    for start in starts_rad:
        configuration.update(start)
        height = configuration.get_transform_frame_to_world(_TIP, "site").translation()[2]
        task.set_target(mink.SE3.from_translation(np.array([*target_m, height])))
        for _ in range(_IK_STEPS):
            missing_m = float(np.linalg.norm(task.compute_error(configuration)[:3]))
            if missing_m < best_m:
                best_m = missing_m
                best_rad = configuration.q.copy()
            if best_m < _IK_TOLERANCE_M:
                return best_rad
            configuration.integrate_inplace(mink.solve_ik(configuration, [task], 1.0, "daqp", limits=limits), 1.0)
    return best_rad


@functools.cache
def planar_arm() -> PlanarArm:
    """This process' arm."""
    return PlanarArm()
