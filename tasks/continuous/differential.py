"""Differential inverse kinematics: the joint step that moves the hand as asked, within the arm's limits."""

from __future__ import annotations

import daqp
import mujoco
import numpy as np

from imagine_bench.arrays import Floats

from ..motion.arm_model import ArmModel
from ..scenes.arm import TCP_SITE
from ..scenes.constants import OBSERVATION_QPOS_RAD

_ROTATION_WEIGHT = 0.3
"""Metres that a radian of the hand's rotation weighs."""
_POSTURE_WEIGHT = 0.005
"""Metres that a radian off the posture weighs: it decides where the hand leaves a choice, and nowhere else."""
_WRIST_SHARE = 0.01
"""Of that, the last joint, which turns freely: so a turn of the hand about its own axis leaves the elbow still."""
_POSTURE_GAIN = 0.15
"""Share of the way back to the posture that a step takes where the hand leaves a choice."""
_MAX_RESIDUAL = 2e-3
"""A step that misses the hand's motion by more (m, weighted) is held up by a limit or a singular posture."""


class DifferentialIK:
    """One joint step a call: a least-squares problem with bounds, solved to the end.

    It minimises |W (J dq - e)|² + w² |dq - g (q0 - q)|², where e is the hand's motion (m, rad) in the world, J its
    Jacobian, and q0 the observation posture, subject to the joints' ranges and to the speeds that the period allows.
    This is the problem that ``mink.solve_ik`` builds of a frame task, a posture task and its two limits.

    Args:
        arm: The arm alone.
    """

    def __init__(self, arm: ArmModel) -> None:
        self._model = arm.model
        self._data = mujoco.MjData(arm.model)
        self._tcp = arm.model.site(TCP_SITE).id
        self._range_rad = arm.model.jnt_range.T.copy()
        self.lower_rad, self.upper_rad = self._range_rad
        self._posture_rad = np.array(OBSERVATION_QPOS_RAD)
        self._squares = np.array([1.0, 1.0, 1.0, *[_ROTATION_WEIGHT**2] * 3])
        self._jacobian = np.empty((6, arm.model.nv))
        posture = np.full(arm.model.nv, _POSTURE_WEIGHT**2)
        posture[-1] *= _WRIST_SHARE
        self._regular = np.diag(posture)
        self._pull = _POSTURE_GAIN * posture
        self._no_rows = np.empty((0, arm.model.nv))
        self._kinds = np.zeros(arm.model.nv, dtype=np.intc)

    def hand_pose(self, qpos_rad: Floats) -> tuple[Floats, Floats]:
        """Position (3,) in m and rotation matrix (3, 3) of the tool centre point at some joints (7,), in the world.

        :meth:`step` goes on from these joints.
        """
        data = self._data
        data.qpos[:] = qpos_rad
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        return data.site_xpos[self._tcp].copy(), data.site_xmat[self._tcp].reshape(3, 3).copy()

    def step(self, motion: Floats, most_rad: Floats) -> tuple[Floats, bool]:
        """The joint step (7,) from where :meth:`hand_pose` was asked, and whether limits kept the hand from its motion.

        Args:
            motion: Translation (m) and rotation vector (rad) of the hand, in the world. Shape (6,).
            most_rad: The largest step of each joint. Shape (7,).
        """
        jacobian = self._jacobian
        data = self._data
        mujoco.mj_jacSite(self._model, data, jacobian[:3], jacobian[3:], self._tcp)
        hessian = np.empty_like(self._regular)
        mujoco.mju_sqrMatTD(hessian, jacobian, self._squares)
        hessian += self._regular
        gradient = self._pull * (data.qpos - self._posture_rad) - (self._squares * motion) @ jacobian
        low, high = self._range_rad - data.qpos
        lower = np.maximum(-most_rad, low)
        upper = np.minimum(most_rad, high)
        solved, _, status, _ = daqp.solve(hessian, gradient, self._no_rows, upper, lower, self._kinds)
        step_rad: Floats = np.minimum(np.maximum(solved, lower), upper) if status > 0 else np.zeros(len(upper))
        missed = jacobian @ step_rad - motion
        return step_rad, bool(missed**2 @ self._squares > _MAX_RESIDUAL**2)
