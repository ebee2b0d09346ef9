"""Macro-actions that carry: pick an object up, put it back, lay it into a palm, or reach out in vain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from imagine_bench.interfaces import Floats

from ..scenes.arm import TCP_SITE
from ..scenes.constants import OBSERVATION_QPOS_RAD
from ..scenes.objects import OBJECTS, ObjectSpec, standing_m
from .executor import BLEND_S, REST_OPENING_M, MacroExecutor, MacroResult, back_to_rest
from .ik import ArmIK, Reach, UnreachableTargetError
from .orientation import ObjectPose
from .sensing import Sensing
from .trajectory import Waypoint

_LIFT_M = 0.075
"""The gripper comes from and goes to so far above where it grips or lets go."""
_CLOSE_S = 0.12
_OPEN_S = 0.08
_SETTLE_S = 0.05
_PLACE_DROP_M = 0.0005
_PALM_DROP_M = 0.003
"""An object is let go so far above the table, or the palm."""
_LOST_M = 0.003
"""Fingers that close so much further than the object is wide have lost it."""
_MAX_TILT_RAD = math.radians(12)


class CarryExecutor(MacroExecutor):
    """Carries objects, which friction alone holds: mink plans, the servos move the arm, contact moves the object.

    The planner knows the objects' true poses, unless ``sensing`` says otherwise.
    Every action starts and ends with the arm at its observation pose, an object that is held included: then the
    outcome is a pure function of the positions of objects, hands and fingers, and of the arguments, bit for bit.
    """

    def __init__(self, model: mujoco.MjModel, sensing: Sensing | None = None) -> None:
        super().__init__(model, sensing)
        self._ik = ArmIK(self.arm)
        self._qpos = [int(model.joint(f"{spec.name}_joint").qposadr[0]) for spec in OBJECTS]
        self._rest_tcp_m, _ = self.arm.tcp_in_base(np.array(OBSERVATION_QPOS_RAD))
        self._tcp_site = model.site(TCP_SITE).id
        self._slots = [self._solve(np.array(standing_m(each)), 0.0, None) for each in range(len(OBJECTS))]

    def pick(self, data: mujoco.MjData, *, index: int, capture_motion_hz: float = 0.0) -> MacroResult:
        """Lift object ``index`` from where it stands and bring it to the observation pose."""
        spec = OBJECTS[index]
        pose = self._measure(data, index, np.array(standing_m(index)))
        if spec.upright and pose.tilt_rad > _MAX_TILT_RAD:
            return self._refuse(data, None, f"the {spec.name} is tipped by {math.degrees(pose.tilt_rad):.0f} degrees")
        yaw_rad = pose.yaw_rad if spec.upright else 0.0
        try:
            reach = self._solve(pose.position_m, yaw_rad, self._slots[index])
        except UnreachableTargetError as error:
            return self._refuse(data, None, f"the {spec.name} is out of reach: {error}")
        waypoints = _waypoints(reach, REST_OPENING_M, spec.squeeze_m)
        result, qpos = self._run(data, waypoints, reach, None, capture_motion_hz)
        return self._unless_missed(spec, result, qpos)

    def place(
        self,
        data: mujoco.MjData,
        *,
        index: int,
        off: tuple[float, float, float] = (0.0, 0.0, 0.0),
        capture_motion_hz: float = 0.0,
    ) -> MacroResult:
        """Put the held object ``index`` back on its place, ``off`` it by metres in x and y, and turned by radians."""
        right_m, up_m, turned_rad = off
        target_m = np.array(standing_m(index)) + np.array([right_m, up_m, _PLACE_DROP_M])
        return self._put(data, index, target_m, turned_rad, capture_motion_hz)

    def hand_over(
        self, data: mujoco.MjData, *, index: int, palm_m: Floats, capture_motion_hz: float = 0.0
    ) -> MacroResult:
        """Lay the held object ``index`` into the palm whose middle is at ``palm_m``. Shape (3,)."""
        target_m = palm_m + _up(OBJECTS[index].grip_height_m + _PALM_DROP_M)
        return self._put(data, index, target_m, None, capture_motion_hz)

    def visit(
        self, data: mujoco.MjData, *, place_m: Floats, held: int | None, capture_motion_hz: float = 0.0
    ) -> MacroResult:
        """Reach out to above ``place_m`` (3,) and come back, holding object ``held`` or nothing."""
        try:
            reach = self._solve(place_m, 0.0, self._slots[1])
        except UnreachableTargetError as error:
            return self._refuse(data, held, f"there is no reaching out: {error}")
        opening_m = REST_OPENING_M if held is None else OBJECTS[held].squeeze_m
        out = Waypoint(name="reach", qpos_rad=reach.above_qpos_rad, opening_m=opening_m)
        waypoints = [out, *back_to_rest(opening_m, _SETTLE_S)]
        result, qpos = self._run(data, waypoints, reach, held, capture_motion_hz)
        return result if held is None else self._unless_missed(OBJECTS[held], result, qpos)

    def rest_holding(self, data: mujoco.MjData, held: int | None) -> None:
        """Bring ``data`` to the canonical start; object ``held`` goes with the gripper where the arm is corrected."""
        if held is None:
            self.rest(data)
            return
        before_m, before_quat = self._tcp(data)
        self.rest(data, squeeze_m=OBJECTS[held].squeeze_m)
        after_m, after_quat = self._tcp(data)
        row = self._qpos[held]
        turn = np.empty(4)
        inverse = np.empty(4)
        mujoco.mju_negQuat(inverse, before_quat)
        mujoco.mju_mulQuat(turn, after_quat, inverse)
        offset_m = np.empty(3)
        quat = np.empty(4)
        mujoco.mju_rotVecQuat(offset_m, data.qpos[row : row + 3] - before_m, turn)
        mujoco.mju_mulQuat(quat, turn, data.qpos[row + 3 : row + 7])
        data.qpos[row : row + 3] = after_m + offset_m
        data.qpos[row + 3 : row + 7] = quat / np.linalg.norm(quat)

    # --- details -------------------------------------------------------------------------------------------------

    def _put(
        self, data: mujoco.MjData, index: int, target_m: Floats, yaw_rad: float | None, capture_motion_hz: float
    ) -> MacroResult:
        """Let the held object go with its origin at ``target_m`` and its x axis at ``yaw_rad``, or as it comes."""
        spec = OBJECTS[index]
        pose = self._measure(data, index, self._rest_tcp_m)
        # At the observation pose the tool's yaw is 0, so the object's own yaw is its yaw in the gripper.
        turn_rad = 0.0 if yaw_rad is None or not spec.upright else yaw_rad - pose.yaw_rad
        cos = math.cos(turn_rad)
        sin = math.sin(turn_rad)
        held_m = pose.position_m - self._rest_tcp_m
        turned_m = np.array([cos * held_m[0] - sin * held_m[1], sin * held_m[0] + cos * held_m[1], held_m[2]])
        try:
            reach = self._solve(target_m - turned_m, turn_rad, self._slots[index])
        except UnreachableTargetError as error:
            return self._refuse(data, index, f"the {spec.name} cannot be put there: {error}")
        waypoints = _waypoints(reach, spec.squeeze_m, REST_OPENING_M)
        return self._run(data, waypoints, reach, index, capture_motion_hz)[0]

    def _measure(self, data: mujoco.MjData, index: int, nominal_m: Floats) -> ObjectPose:
        row = self._qpos[index]
        return self.sensing.erring(self.sensing.pose(data.qpos[row : row + 7], nominal_m))

    def _solve(self, place_m: Floats, yaw_rad: float, start: Reach | None) -> Reach:
        """Configurations with the tool centre point at ``place_m`` (3,), and above it."""
        first = np.array(OBSERVATION_QPOS_RAD) if start is None else start
        return self._ik.reach(place_m, yaw_rad=yaw_rad, lift_m=_LIFT_M, start=first)

    def _run(
        self, data: mujoco.MjData, waypoints: Sequence[Waypoint], reach: Reach, held: int | None, motion_hz: float
    ) -> tuple[MacroResult, Floats]:
        """Plan and execute; also the positions of the whole run (N + 1, nq), valid until the next one."""
        squeeze_m = None if held is None else OBJECTS[held].squeeze_m
        result, qpos, _ = self.perform(
            data, waypoints, ik_error_m=reach.error_m, squeeze_m=squeeze_m, capture_motion_hz=motion_hz
        )
        return result, qpos

    def _unless_missed(self, spec: ObjectSpec, result: MacroResult, qpos: Floats) -> MacroResult:
        """The result of a run (N + 1, nq), with a fault if the fingers closed past what they should hold."""
        if self.opening_m(qpos[-1]).max() < spec.grip_opening_m - _LOST_M:
            return replace(result, fault=f"the fingers closed and do not hold the {spec.name}")
        return result

    def _refuse(self, data: mujoco.MjData, held: int | None, reason: str) -> MacroResult:
        self.rest_holding(data, held)
        return self.refused(reason)

    def _tcp(self, data: mujoco.MjData) -> tuple[Floats, Floats]:
        """Position (3,) and quaternion (4,) of the tool centre point in the world, updated."""
        mujoco.mj_kinematics(self.model, data)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, data.site_xmat[self._tcp_site])
        return data.site_xpos[self._tcp_site].copy(), quat


def _up(height_m: float) -> Floats:
    return np.array([0.0, 0.0, height_m])


def _waypoints(reach: Reach, before_m: float, after_m: float) -> list[Waypoint]:
    """Down with one finger command, to another one there, and back with that."""
    change_s = _CLOSE_S if after_m < before_m else _OPEN_S
    return [
        Waypoint(name="reach", qpos_rad=reach.above_qpos_rad, opening_m=before_m, blend_s=BLEND_S),
        Waypoint(name="down", qpos_rad=reach.at_qpos_rad, opening_m=before_m),
        Waypoint(name="grip", qpos_rad=reach.at_qpos_rad, opening_m=after_m, min_duration_s=change_s),
        Waypoint(name="up", qpos_rad=reach.above_qpos_rad, opening_m=after_m, blend_s=BLEND_S),
        *back_to_rest(after_m, _SETTLE_S),
    ]
