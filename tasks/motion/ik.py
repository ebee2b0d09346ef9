"""Inverse kinematics of the arm with mink, the gripper straight down."""

from __future__ import annotations

import functools
import math
from ctypes import c_int
from dataclasses import dataclass

import daqp
import mink
import numpy as np

from imagine_bench.arrays import Floats
from imagine_bench.errors import ImagineBenchError

from ..scenes.arm import TCP_SITE
from ..scenes.constants import HOME_QPOS_RAD
from .arm_model import ArmModel

POSITION_TOLERANCE_M = 2e-4
ANGLE_TOLERANCE_RAD = 2e-3
_MAX_STEPS = 40

_ORIENTATION_COST = 0.3
_POSTURE_COST = 1e-3  # ten times more leaves 0.3 mm and never converges
_FAR_DAMPING = 0.1  # Levenberg-Marquardt, fades as the error does: targets out of reach do not make the arm whirl
_DAMPING = 1e-12  # mink's default


class UnreachableTargetError(ImagineBenchError):
    """No configuration within the joint limits brings the gripper to the target."""


@dataclass(frozen=True, kw_only=True)
class IKSolution:
    """A configuration (7,) that reaches its target, and its distance from it."""

    qpos_rad: Floats
    error_m: float


@dataclass(frozen=True, kw_only=True)
class Reach:
    """Arm configurations at a place and above it, (7,) each, and the larger distance from their targets."""

    at_qpos_rad: Floats
    above_qpos_rad: Floats
    error_m: float


@functools.lru_cache(maxsize=64)
def pointing_down(yaw_rad: float) -> mink.SO3:
    """The tool's rotation when it points down and its x axis has heading ``yaw_rad`` (0 along world +x)."""
    return mink.SO3.from_z_radians(yaw_rad) @ mink.SO3.from_x_radians(math.pi)


class ArmIK:
    """Solves for the seven joints, one call a waypoint. A solution depends on the arguments alone."""

    def __init__(self, arm: ArmModel) -> None:
        self.configuration = mink.Configuration(arm.model)
        self.frame_task = mink.FrameTask(
            TCP_SITE, "site", position_cost=1.0, orientation_cost=_ORIENTATION_COST, lm_damping=_FAR_DAMPING
        )
        self._home_rad = np.array(HOME_QPOS_RAD)
        n_joints = arm.model.nv
        limits = mink.ConfigurationLimit(arm.model)
        self._lower_rad = limits.lower
        self._upper_rad = limits.upper
        self._gain = limits.gain
        self._weights = np.vstack([np.zeros((6, n_joints)), _POSTURE_COST * np.eye(n_joints)])  # of reach and posture
        self._bounded = np.vstack([np.eye(n_joints), -np.eye(n_joints)])
        self._unbounded = np.full(2 * n_joints, -1e30)
        self._kind = np.zeros(2 * n_joints, dtype=c_int)

    def solve(self, place_m: Floats, yaw_rad: float, start_qpos_rad: Floats) -> IKSolution:
        """Find the configuration nearest the home posture that points straight down at a place.

        Args:
            place_m: Where the tool centre point shall be, the base at the origin. Shape (3,).
            yaw_rad: Heading of the tool's x axis about the vertical.
            start_qpos_rad: Where the search starts, such as a known solution nearby. Shape (7,).

        Raises:
            UnreachableTargetError: No convergence; the message gives target and residual.
        """
        self.frame_task.set_target(mink.SE3.from_rotation_and_translation(pointing_down(yaw_rad), place_m))
        self.configuration.update(start_qpos_rad)
        for step in range(_MAX_STEPS + 1):
            error = self.frame_task.compute_error(self.configuration)  # [6], position then rotation vector
            error_m = math.hypot(*error[:3])
            angle_rad = math.hypot(*error[3:])
            if error_m < POSITION_TOLERANCE_M and angle_rad < ANGLE_TOLERANCE_RAD:
                return IKSolution(qpos_rad=self.configuration.q.copy(), error_m=error_m)
            if step < _MAX_STEPS:
                self.configuration.integrate_inplace(self.next_step(), 1.0)
        raise UnreachableTargetError(
            f"The gripper cannot reach {np.round(place_m, 4).tolist()} m at yaw {math.degrees(yaw_rad):.0f} deg: after "
            f"{_MAX_STEPS} steps {1000 * error_m:.1f} mm and {math.degrees(angle_rad):.1f} deg are missing; choose a "
            "target nearer to the middle of the table."
        )

    def next_step(self) -> Floats:
        """The next step in the joints (7,): ``mink.solve_ik``'s to the bit, in a third of its time.

        Nothing is made, looked up or checked again that is the same in every step.
        """
        joints_rad = self.configuration.data.qpos
        self._weights[:6], error, damping = self.frame_task.compute_qp_residual(self.configuration)
        hessian = self._weights.T @ self._weights
        hessian.flat[:: len(hessian) + 1] += _DAMPING + damping
        errors = np.concatenate([error, _POSTURE_COST * (self._home_rad - joints_rad)])
        room = self._gain * np.concatenate([self._upper_rad - joints_rad, joints_rad - self._lower_rad])
        solved, _, status, _ = daqp.solve(
            hessian, -(errors @ self._weights), self._bounded, room, self._unbounded, self._kind
        )
        if status <= 0:
            raise mink.NoSolutionFound("daqp")
        step: Floats = solved
        return step

    def reach(self, place_m: Floats, yaw_rad: float, lift_m: float, near: Reach) -> Reach:
        """Find the configurations with the tool centre point at ``place_m`` (3,) and ``lift_m`` above it.

        The searches start from a solution nearby.

        Raises:
            UnreachableTargetError: As :meth:`solve`.
        """
        at = self.solve(place_m, yaw_rad, near.at_qpos_rad)
        above = self.solve(place_m + np.array([0.0, 0.0, lift_m]), yaw_rad, near.above_qpos_rad)
        error_m = max(at.error_m, above.error_m)
        return Reach(at_qpos_rad=at.qpos_rad, above_qpos_rad=above.qpos_rad, error_m=error_m)
