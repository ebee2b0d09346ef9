"""The arm alone, compiled for planning and for hand commands; mink, which loads slowly, is not needed for it."""

from __future__ import annotations

import mujoco
import numpy as np

from imagine_bench.arrays import Floats

from ..scenes.arm import ARM_JOINTS, FINGER_JOINTS, JOINT_SPEED_LIMITS_RAD_S, TCP_SITE, arm_spec


class ArmModel:
    """Kinematics, inertia, servo gains and limits of the arm, its base at the world's origin.

    The fingers are frozen, so that configurations are the seven arm joints in rad, from base to wrist.

    Attributes:
        model: The compiled arm. ``nq == nv == 7``.
        speed_limit_rad_s: Shape (7,).
        effort_limit_nm: Shape (7,).
        stiffness_nm_rad: Position gain of each servo. Shape (7,).
        damping_nms_rad: Servo and joint damping together. Shape (7,).
    """

    def __init__(self) -> None:
        spec = arm_spec()
        for name in FINGER_JOINTS:
            spec.delete(spec.actuator(name.replace("_slide", "_servo")))
            spec.delete(spec.joint(name))
        self.model = spec.compile()
        self._data = mujoco.MjData(self.model)
        self._tcp = self.model.site(TCP_SITE).id
        servos = [self.model.actuator(f"{name}_servo").id for name in ARM_JOINTS]
        self.speed_limit_rad_s: Floats = np.array(JOINT_SPEED_LIMITS_RAD_S)
        self.effort_limit_nm: Floats = self.model.actuator_forcerange[servos, 1].copy()
        self.stiffness_nm_rad: Floats = self.model.actuator_gainprm[servos, 0].copy()
        self.damping_nms_rad: Floats = self.model.dof_damping - self.model.actuator_biasprm[servos, 2]

    def inertia(self, qpos_rad: Floats) -> Floats:
        """Joint-space inertia matrix, rotor armature included, in kg·m². Shape (7, 7)."""
        self._data.qpos[:] = qpos_rad
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        mujoco.mj_makeM(self.model, self._data)
        dense = np.empty((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self._data, dense)
        return dense

    def tcp_in_base(self, qpos_rad: Floats) -> tuple[Floats, Floats]:
        """Position (3,) in m and rotation matrix (3, 3) of the tool centre point, by forward kinematics."""
        self._data.qpos[:] = qpos_rad
        mujoco.mj_kinematics(self.model, self._data)
        return self._data.site_xpos[self._tcp].copy(), self._data.site_xmat[self._tcp].reshape(3, 3).copy()
