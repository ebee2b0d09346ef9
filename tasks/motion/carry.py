"""Macro-actions that carry: pick an object up, put it back, lay it into a palm, or reach out in vain."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np

from imagine_bench.arrays import Floats

from ..scenes.arm import TCP_SITE, tcp_in_world
from ..scenes.constants import OBSERVATION_QPOS_RAD
from ..scenes.objects import OBJECTS, standing_m
from .executor import BLEND_S, REST_OPENING_M, MacroExecutor, MacroResult, back_to_rest
from .ik import ArmIK, Reach, UnreachableTargetError
from .orientation import ObjectPose, Sensing
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

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, sensing: Sensing) -> None:
        super().__init__(model, data, sensing)
        self._ik = ArmIK(self.arm)
        self._qpos = [int(model.joint(f"{spec.name}_joint").qposadr[0]) for spec in OBJECTS]
        self._rest_tcp_m, _ = self.arm.tcp_in_base(np.array(OBSERVATION_QPOS_RAD))
        self._tcp_site = model.site(TCP_SITE).id
        observing = np.array(OBSERVATION_QPOS_RAD)
        near = Reach(at_qpos_rad=observing, above_qpos_rad=observing, error_m=0.0)
        self._slots = [self._ik.reach(np.array(standing_m(each)), 0.0, _LIFT_M, near) for each in range(len(OBJECTS))]

    def pick(self, *, index: int) -> MacroResult:
        """Lift object ``index`` from where it stands and bring it to the observation pose."""
        spec = OBJECTS[index]
        pose = self._measure(index, np.array(standing_m(index)))
        if spec.upright and pose.tilt_rad > _MAX_TILT_RAD:
            return self.refused(f"the {spec.name} is tipped by {math.degrees(pose.tilt_rad):.0f} degrees")
        yaw_rad = pose.yaw_rad if spec.upright else 0.0
        near = self._slots[index]
        return self._go(pose.position_m, yaw_rad, near, None, index, f"the {spec.name} is out of reach")

    def place(self, *, index: int, noise: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> MacroResult:
        """Put the held object ``index`` back, off its place by metres in x and y, and turned by radians."""
        right_m, up_m, turned_rad = noise
        return self._put(index, np.add(standing_m(index), (right_m, up_m, _PLACE_DROP_M)), turned_rad)

    def hand_over(self, *, index: int, palm_m: Floats) -> MacroResult:
        """Lay the held object ``index`` into the palm whose middle is at ``palm_m``. Shape (3,)."""
        return self._put(index, np.add(palm_m, (0.0, 0.0, OBJECTS[index].grip_height_m + _PALM_DROP_M)), None)

    def visit(self, *, place_m: Floats, held: int | None) -> MacroResult:
        """Reach out to above ``place_m`` (3,) and come back, holding object ``held`` or nothing."""
        return self._go(place_m, 0.0, self._slots[1], held, held, "there is no reaching out")

    def rest_holding(self, held: int | None) -> None:
        """Bring ``data`` to the canonical start; object ``held`` goes with the gripper where the arm is corrected."""
        if held is None:
            self.rest()
            return
        before = self._tcp()
        self.rest(squeeze_m=OBJECTS[held].squeeze_m)
        after = self._tcp()
        row = self._qpos[held]
        turn = np.empty(4)
        inverse = np.empty(4)
        mujoco.mju_negQuat(inverse, before[3:])
        mujoco.mju_mulQuat(turn, after[3:], inverse)
        offset_m = np.empty(3)
        quat = np.empty(4)
        mujoco.mju_rotVecQuat(offset_m, self.data.qpos[row : row + 3] - before[:3], turn)
        mujoco.mju_mulQuat(quat, turn, self.data.qpos[row + 3 : row + 7])
        self.data.qpos[row : row + 3] = after[:3] + offset_m
        self.data.qpos[row + 3 : row + 7] = quat / np.linalg.norm(quat)

    # --- details -------------------------------------------------------------------------------------------------

    def _put(self, index: int, target_m: Floats, yaw_rad: float | None) -> MacroResult:
        """Let the held object go with its origin at ``target_m`` and its x axis at ``yaw_rad``, or as it comes."""
        spec = OBJECTS[index]
        pose = self._measure(index, self._rest_tcp_m)
        # At the observation pose the tool's yaw is 0, so the object's own yaw is its yaw in the gripper.
        turn_rad = 0.0 if yaw_rad is None or not spec.upright else yaw_rad - pose.yaw_rad
        cos = math.cos(turn_rad)
        sin = math.sin(turn_rad)
        held_m = pose.position_m - self._rest_tcp_m
        turned_m = np.array([cos * held_m[0] - sin * held_m[1], sin * held_m[0] + cos * held_m[1], held_m[2]])
        near = self._slots[index]
        return self._go(target_m - turned_m, turn_rad, near, index, None, f"the {spec.name} cannot be put there")

    def _measure(self, index: int, nominal_m: Floats) -> ObjectPose:
        row = self._qpos[index]
        return self.sensing.erring(self.sensing.pose(self.data.qpos[row : row + 7], nominal_m))

    def _go(
        self,
        place_m: Floats,
        yaw_rad: float,
        near: Reach,
        held: int | None,
        then: int | None,
        why: str,
    ) -> MacroResult:
        """Reach for ``place_m`` with object ``held`` or nothing, and come back with ``then``; a visit if they are one.

        ``near`` is a solution nearby, and ``why`` says the consequence where the place cannot be reached.
        """
        before_m = REST_OPENING_M if held is None else OBJECTS[held].squeeze_m
        after_m = REST_OPENING_M if then is None else OBJECTS[then].squeeze_m
        try:
            reach = self._ik.reach(place_m, yaw_rad, _LIFT_M, near)
        except UnreachableTargetError as error:
            self.rest_holding(held)
            return MacroResult(fault=f"{why}: {error}", motion=self.no_samples())
        if held == then:
            waypoints = [Waypoint("reach", reach.above_qpos_rad, before_m)]
        else:
            waypoints = _waypoints(reach, before_m, after_m)
        waypoints += back_to_rest(after_m, _SETTLE_S)
        squeeze_m = None if held is None else before_m
        result, qpos, _ = self.perform(waypoints, ik_error_m=reach.error_m, squeeze_m=squeeze_m)
        if then is not None and self.opening_m(qpos[-1]).max() < OBJECTS[then].grip_opening_m - _LOST_M:
            return replace(result, fault=f"the fingers closed and do not hold the {OBJECTS[then].name}")
        return result

    def _tcp(self) -> Floats:
        mujoco.mj_kinematics(self.model, self.data)
        return tcp_in_world(self.data, self._tcp_site)


def _waypoints(reach: Reach, before_m: float, after_m: float) -> list[Waypoint]:
    """Down with one finger command, to another one there, and up with that."""
    change_s = _CLOSE_S if after_m < before_m else _OPEN_S
    return [
        Waypoint("reach", reach.above_qpos_rad, before_m, blend_s=BLEND_S),
        Waypoint("down", reach.at_qpos_rad, before_m),
        Waypoint("grip", reach.at_qpos_rad, after_m, min_duration_s=change_s),
        Waypoint("up", reach.above_qpos_rad, after_m, blend_s=BLEND_S),
    ]
