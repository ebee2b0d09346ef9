"""The arrow puzzle's macro-action: grip a cube where it stands, turn it by a quarter, let go, return."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from imagine_bench.arrays import Floats

from ..scenes.constants import CUBE_EDGE_M, CUBE_REST_Z_M, HOME_QPOS_RAD
from .executor import BLEND_S, REST_OPENING_M, MacroExecutor, MacroResult, back_to_rest
from .ik import ArmIK, Reach, UnreachableTargetError
from .orientation import ObjectPose, Sensing
from .trajectory import Waypoint

_QUARTER_RAD = math.pi / 2
_MIDDLE_YAW_RAD = math.pi / 4
"""IK is solved halfway of the turn, which keeps the wrist's whole quarter within its limits."""
_MAX_SKEW_RAD = math.radians(8)
"""Beyond it the last joint might leave its range, so the other pair of faces is gripped."""
_FINGER_M = 0.011
_FINGER_HALF_WIDTH_M = 0.014
_CLEARANCE_M = 0.003
"""How far a finger reaches beyond its opening, its back included, and the gap between it and other cubes."""
_LEAST_OPENING_M = CUBE_EDGE_M / 2 + 0.002
_LIFT_M = 0.06
"""The fingers come from and go to so far above the grip: the cube's top and 16 mm."""
_SQUEEZE_M = 0.004
"""Each finger's command lies so far inside the cube: about 13 N."""
_CLOSE_S = 0.10
_OPEN_S = 0.07
_SETTLE_S = 0.03
_MAX_TILT_RAD = math.radians(10)
_SQUEEZED_M = CUBE_EDGE_M / 2 - _SQUEEZE_M
_MISSED_M = 0.0001
"""Fingers that come so near to their command, on the average, have nothing between them; smooth ones sink in deep."""


class TurnExecutor(MacroExecutor):
    """Turns the cubes of a compiled scene: mink plans, the servos move the arm, and contact alone moves the cube.

    The jaws are flat, so a cube turns with them by its shape and hardly needs friction. The planner knows the cubes'
    true poses, unless ``sensing`` says otherwise.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        slots_xy_m: Sequence[tuple[float, float]],
        sensing: Sensing,
    ) -> None:
        super().__init__(model, data, sensing)
        self._ik = ArmIK(self.arm)
        self._cube_qpos = [int(model.joint(f"cube_{cube}_joint").qposadr[0]) for cube in range(len(slots_xy_m))]
        self._slots_xy_m = slots_xy_m
        home = np.array(HOME_QPOS_RAD)
        near = Reach(at_qpos_rad=home, above_qpos_rad=home, error_m=0.0)
        self._slots = [self._reach(np.array(slot), near) for slot in slots_xy_m]

    def turn(
        self,
        *,
        cube: int,
        clockwise: bool,
        slips: bool = False,
        noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> MacroResult:
        """Turn a cube by a quarter, as seen from above and in the frame, to a right angle on its nominal slot.

        ``noise`` has it come down so far off both: metres in x and y, and radians. One that ``slips`` stays: the
        fingers grip it, open too early, and turn above it. The outcome is a pure function of the loose objects'
        positions and the arguments, bit for bit.
        """
        poses = [
            self.sensing.pose(self.data.qpos[start : start + 7], np.array([*place_m, CUBE_REST_Z_M]))
            for start, place_m in zip(self._cube_qpos, self._slots_xy_m, strict=True)
        ]
        true = poses[cube]
        slot = self._slots[cube]
        right_m, up_m, turned_rad = noise
        pose = self.sensing.erring(true)
        if pose.tilt_rad > _MAX_TILT_RAD:
            return self.refused(f"cube {cube} is tipped by {math.degrees(pose.tilt_rad):.0f} degrees")
        place_m = np.add(self._slots_xy_m[cube], (right_m, up_m))
        try:
            grip = self._reach(pose.position_m[:2], slot)
            if any(noise):
                slot = self._reach(place_m, slot)
        except UnreachableTargetError as error:
            return self.refused(f"cube {cube} is out of reach: {error}")
        others = [each for each in poses if each is not true]
        along_x_m, along_y_m = _rooms_m(others, pose)
        skewed = abs(_skew_rad(pose)) > _MAX_SKEW_RAD
        begins_along_x = skewed or along_x_m > along_y_m or (clockwise and along_x_m == along_y_m)
        opening_m = max(along_x_m if begins_along_x else along_y_m, _LEAST_OPENING_M)
        leaves_m = REST_OPENING_M
        if any(noise):
            there = replace(pose, position_m=np.array([*place_m, CUBE_REST_Z_M]))
            beyond_m = _FINGER_HALF_WIDTH_M * abs(math.sin(turned_rad))  # a finger that is turned reaches further
            leaves_m = max(_rooms_m(others, there)[int(begins_along_x)] - beyond_m, _LEAST_OPENING_M)
        skews_rad = (_skew_rad(pose), turned_rad)
        openings_m = (opening_m, leaves_m)
        waypoints = _waypoints(grip, slot, skews_rad, clockwise, begins_along_x != clockwise, slips, openings_m)
        error_m = max(grip.error_m, slot.error_m)
        result, qpos, trajectory = self.perform(waypoints, ik_error_m=error_m)
        holding = qpos[trajectory.last_step["close" if slips else "turn"] + 1]
        if self.opening_m(holding).mean() < _SQUEEZED_M + _MISSED_M:
            return replace(result, fault=f"the fingers closed past cube {cube}")
        return result

    def _reach(self, place_xy_m: Floats, near: Reach) -> Reach:
        """Configurations that grip, and hover over, a cube standing at ``place_xy_m`` (2,), at the middle yaw."""
        place_m = np.array([*place_xy_m, CUBE_REST_Z_M])
        return self._ik.reach(place_m, _MIDDLE_YAW_RAD, _LIFT_M, near)


def _skew_rad(pose: ObjectPose) -> float:
    """Yaw beyond the nearest right angle, in [-pi/4, pi/4]."""
    return pose.yaw_rad - round(pose.yaw_rad / _QUARTER_RAD) * _QUARTER_RAD


def _rooms_m(others: Sequence[ObjectPose], gripped: ObjectPose) -> tuple[float, float]:
    """How far fingers along x, and along y, of the gripped cube can open for all the other ones."""
    along_x_m, along_y_m = (
        min((_room_m(each, gripped, axis) for each in others), default=REST_OPENING_M) for axis in (0, 1)
    )
    return along_x_m, along_y_m


def _room_m(other: ObjectPose, gripped: ObjectPose, axis: int) -> float:
    """How far fingers along x (axis 0) or y (1) of the gripped cube can open for another one, if that is that way."""
    offset_m = np.abs(other.position_m[:2] - gripped.position_m[:2])
    half_m = CUBE_EDGE_M / 2 * (math.cos(_skew_rad(other)) + abs(math.sin(_skew_rad(other)))) + _CLEARANCE_M
    if offset_m[axis] < offset_m[1 - axis] or offset_m[1 - axis] >= half_m + _FINGER_HALF_WIDTH_M:
        return REST_OPENING_M
    away_m = math.dist(other.position_m[:2], gripped.position_m[:2]) if axis else float(offset_m[0])
    return min(REST_OPENING_M, away_m - half_m - _FINGER_M)


def _waypoints(
    grip: Reach,
    slot: Reach,
    skews_rad: tuple[float, float],
    clockwise: bool,
    other_faces: bool,
    slips: bool,
    openings_m: tuple[float, float],
) -> list[Waypoint]:
    """Down over the cube as it stands, turned to where it shall stand, and back; or let go too early.

    ``skews_rad`` are how far the cube is turned off a right angle, and shall be; ``openings_m`` how far fingers open
    beside it where it stands, and shall stand.

    The wrist's axis points down: a larger last joint is a smaller yaw, that is clockwise from above. A clockwise turn
    begins with the fingers along x, clear of the row, and ends along y; a counter-clockwise one goes the other way,
    unless ``other_faces`` turns the wrist by a quarter more, which takes longer.
    """
    sense = 1.0 if clockwise else -1.0
    extra_rad = -_QUARTER_RAD if other_faces else 0.0
    opening_m, leaves_m = openings_m
    before = np.zeros(7)
    after = np.zeros(7)
    before[-1] = extra_rad - sense * _QUARTER_RAD / 2 - skews_rad[0]
    after[-1] = extra_rad + sense * _QUARTER_RAD / 2 - skews_rad[1]
    if slips:
        turn = [
            Waypoint("open", grip.at_qpos_rad + before, opening_m, min_duration_s=_OPEN_S),
            Waypoint("lift", grip.above_qpos_rad + before, opening_m),
            Waypoint("turn", slot.above_qpos_rad + after, REST_OPENING_M, blend_s=BLEND_S),
        ]
    else:
        turn = [
            Waypoint("turn", slot.at_qpos_rad + after, _SQUEEZED_M),
            Waypoint("open", slot.at_qpos_rad + after, leaves_m, min_duration_s=_OPEN_S),
            Waypoint("up", slot.above_qpos_rad + after, leaves_m, blend_s=BLEND_S),
        ]
    return [
        Waypoint("reach", grip.above_qpos_rad + before, opening_m, blend_s=BLEND_S),
        Waypoint("down", grip.at_qpos_rad + before, opening_m),
        Waypoint("close", grip.at_qpos_rad + before, _SQUEEZED_M, min_duration_s=_CLOSE_S),
        *turn,
        *back_to_rest(REST_OPENING_M, _SETTLE_S),
    ]
