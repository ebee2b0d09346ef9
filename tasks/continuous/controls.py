"""The meaning of an action of a control period: a hand twist, a hand pose, or joints; and the servos' commands for it.

Commands go on from the commands before, not from where the arm is: the hand does not drift while it is asked for
nothing. The joints' speeds and ranges hold for every action, the workspace for hand twists and poses alone; the servos'
forces are limited in the model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Floats
from imagine_bench.errors import InvalidValueError, brief, require_known

from ..motion.arm_model import ArmModel
from ..scenes.constants import TABLE_HEIGHT_M
from .differential import DifferentialIK

HAND_SPEED_M_S = 1.0
HAND_TURN_RAD_S = 6.0
"""The twist of an action's largest value, along and about each axis of the world."""
MOST_OPEN_M = 0.045
"""Each finger's distance from the grip's middle at the largest grip command; 0 at the smallest."""
FINGER_SPEED_M_S = 0.5
"""The fastest that a finger's command moves."""
WORKSPACE_LOW_M = (0.35, -0.45, TABLE_HEIGHT_M + 0.015)
WORKSPACE_HIGH_M = (0.90, 0.45, 0.45)
"""Corners of the box, in the world, that the point between the fingers is kept in."""
_POSE_STEPS = 3
"""Linear problems solved a period on the way to a pose."""
_HAND_TWIST = tuple(f"hand velocity {axis}" for axis in "xyz") + tuple(f"hand turn about {axis}" for axis in "xyz")
_HAND_POSE = tuple(f"hand {axis}" for axis in "xyz") + tuple(f"hand quaternion {part}" for part in "wxyz")
_JOINTS = tuple(f"joint {index}" for index in range(7))
CONTROL_NAMES = {
    "twist": (*_HAND_TWIST, "grip"),
    "pose": (*_HAND_POSE, "grip"),
    "joint_delta": (*(f"{name} velocity" for name in _JOINTS), "grip"),
    "joint": (*_JOINTS, "grip"),
}
"""The meaning of each number of an action, by the name of the control."""
Motion = NDArray[np.floating | np.integer]
"""An action of continuous control."""


class Command(NamedTuple):
    """Where the servos are told to be at the end of a period."""

    joints_rad: Floats  #: shape (7,)
    opening_m: float  #: of each finger
    #: the reason that kept it from the action: "workspace", "reach" (a joint's range, speed, a singularity), or ""
    limited: str


class HandControl:
    """Turns actions into commands.

    Args:
        control: A name of :data:`CONTROL_NAMES`. ``"twist"``: the hand's velocity and turning in the world, as shares
            of 1 m/s and 6 rad/s, and the grip. ``"pose"``: the hand's position (m) and quaternion (w, x, y, z) in the
            world, and the grip. ``"joint_delta"``: each joint's velocity as a share of its limit, and the grip.
            ``"joint"``: joints (rad), and the grip. The grip is -1 (closed) to 1 (open).
        arm: The arm alone.
        period_s: Length of a control period.

    Raises:
        UnknownNameError: Another control.
    """

    def __init__(self, control: str, arm: ArmModel, period_s: float) -> None:
        self.control = require_known("control", control, CONTROL_NAMES)
        self.names = CONTROL_NAMES[control]
        self._ik = DifferentialIK(arm)
        self.most_rad = arm.speed_limit_rad_s * period_s
        self._most_m = FINGER_SPEED_M_S * period_s
        self._per_unit = np.array([HAND_SPEED_M_S] * 3 + [HAND_TURN_RAD_S] * 3) * period_s
        self._lowest_m = np.array(WORKSPACE_LOW_M)
        self._highest_m = np.array(WORKSPACE_HIGH_M)
        self.space = self._space()
        self._low = self.space.low.astype(np.float64)
        self._high = self.space.high.astype(np.float64)

    def _space(self) -> gymnasium.spaces.Box[np.float32]:
        if self.control == "joint":
            low, high = self._ik.lower_rad, self._ik.upper_rad
        elif self.control == "pose":
            low, high = np.array([*WORKSPACE_LOW_M, *[-1.0] * 4]), np.array([*WORKSPACE_HIGH_M, *[1.0] * 4])
        else:
            low, high = -np.ones(len(self.names) - 1), np.ones(len(self.names) - 1)
        return gymnasium.spaces.Box(np.append(low, -1.0).astype(np.float32), np.append(high, 1.0).astype(np.float32))

    def checked(self, action: Motion, count: int | None = None) -> Floats:
        """An action, or ``count`` in rows, as float64 within the space; values beyond are taken for the nearest within.

        Raises:
            InvalidValueError: Another shape, no numbers, NaN, or a quaternion of zeros.
        """
        try:
            given = np.asarray(action)
        except (TypeError, ValueError) as error:
            raise self._refused(action, "is no array of numbers") from error
        if given.dtype.kind not in "biuf" or (isinstance(action, np.ma.MaskedArray) and np.ma.is_masked(action)):
            raise self._refused(action, "has parts that are no real numbers")
        given = given.astype(np.float64)
        shape = (len(self.names),) if count is None else (count, len(self.names))
        if given.shape != shape or not all(map(math.isfinite, given.ravel().tolist())):
            raise self._refused(action, "has another shape or a value that is not finite")
        if self.control == "pose" and not given[..., 3:7].any(axis=-1).all():
            raise InvalidValueError("The quaternion of the action is all zeros; give (1, 0, 0, 0) for no rotation.")
        return np.minimum(np.maximum(given, self._low), self._high)

    def _refused(self, action: Motion, why: str) -> InvalidValueError:
        names = ", ".join(self.names)
        return InvalidValueError(f"Action {brief(action)} {why}; give {len(self.names)} numbers: {names}.")

    def command(self, action: Floats, joints_rad: Floats, opening_m: float) -> Command:
        """The command for a checked action, from the command before: joints (7,) and the opening of each finger."""
        wanted_m = MOST_OPEN_M * (float(action[-1]) + 1.0) / 2.0
        opening_m = min(max(wanted_m, opening_m - self._most_m), opening_m + self._most_m)
        if self.control == "twist":
            joints_rad, limited = self._by_twist(self._per_unit * action[:6], joints_rad)
        elif self.control == "pose":
            joints_rad, limited = self._by_pose(action[:3], action[3:7], joints_rad)
        else:
            most_rad = self.most_rad
            asked_rad = action[:-1] * most_rad if self.control == "joint_delta" else action[:-1] - joints_rad
            step_rad = np.minimum(np.maximum(asked_rad, -most_rad), most_rad)
            within_rad = np.minimum(np.maximum(joints_rad + step_rad, self._ik.lower_rad), self._ik.upper_rad)
            limited = "" if within_rad.tolist() == (joints_rad + asked_rad).tolist() else "reach"
            joints_rad = within_rad
        return Command(joints_rad, opening_m, limited)

    def _by_twist(self, motion: Floats, joints_rad: Floats) -> tuple[Floats, str]:
        place_m, _ = self._ik.hand_pose(joints_rad)
        target_m = place_m + motion[:3]
        inside_m = np.minimum(np.maximum(target_m, self._lowest_m), self._highest_m)
        motion[:3] = inside_m - place_m
        step_rad, missed = self._ik.step(motion, self.most_rad)
        outside = inside_m.tolist() != target_m.tolist()
        return joints_rad + step_rad, "workspace" if outside else "reach" if missed else ""

    def _by_pose(self, target_m: Floats, quat: Floats, joints_rad: Floats) -> tuple[Floats, str]:
        target_quat = quat / np.linalg.norm(quat)
        room_rad = self.most_rad.copy()
        missed = False
        at_quat = np.empty(4)
        in_hand_rad = np.empty(3)
        for _ in range(_POSE_STEPS):
            place_m, rotation = self._ik.hand_pose(joints_rad)
            mujoco.mju_mat2Quat(at_quat, rotation.ravel())
            mujoco.mju_subQuat(in_hand_rad, target_quat, at_quat)
            motion = np.concatenate([target_m - place_m, rotation @ in_hand_rad])
            step_rad, missed = self._ik.step(motion, room_rad)
            joints_rad = joints_rad + step_rad
            room_rad = np.maximum(room_rad - np.abs(step_rad), 0.0)
        return joints_rad, "reach" if missed else ""

    def hand_pose(self, joints_rad: Floats) -> tuple[Floats, Floats]:
        """Position (3,) in m and rotation matrix (3, 3) of the point between the fingers, by forward kinematics."""
        return self._ik.hand_pose(joints_rad)
