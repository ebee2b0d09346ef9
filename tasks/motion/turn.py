"""The arrow puzzle's macro-action: grip a cube where it stands, turn it by a quarter, let go, return."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from imagine_bench.errors import InvalidValueError

from ..scenes.constants import CUBE_EDGE_M, OBSERVATION_QPOS_RAD, SLOTS_XY_M, TABLE_HEIGHT_M
from .arm_model import ArmModel, Floats
from .executor import REST_OPENING_M, MacroExecutor, MacroResult
from .ik import ArmIK, UnreachableTargetError
from .trajectory import Waypoint, plan

_QUARTER_RAD = math.pi / 2
_MIDDLE_YAW_RAD = math.pi / 4
"""IK is solved halfway of the turn, which keeps the wrist's whole quarter within its limits."""

_WRIST_LIMIT_RAD = 4.70
"""The last joint's upper limit, nearly."""

_LIFT_M = 0.06
"""The fingers come from and go to so far above the grip: the cube's top and 16 mm."""
_SQUEEZE_M = 0.004
"""Each finger's command lies so far inside the cube: about 13 N."""
_CLOSE_S, _OPEN_S, _SETTLE_S = 0.15, 0.10, 0.05

_MAX_TILT_RAD = math.radians(10)
_MIN_GRIP_M = CUBE_EDGE_M / 2 - _SQUEEZE_M / 2
_ARM_AT_REST_RAD = 0.02


@dataclass(frozen=True, kw_only=True)
class _Grip:
    """Arm configurations over one place, both with the gripper's x axis at the middle yaw."""

    at_qpos_rad: Floats
    above_qpos_rad: Floats
    error_m: float


class TurnExecutor:
    """Turns cubes by friction alone: mink plans, the servos move the arm, contact moves the cube.

    Args:
        model: The compiled scene with arm and cubes.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.executor = MacroExecutor(model)
        self._arm = ArmModel()
        self._ik = ArmIK(self._arm)
        self._cube_qpos = [int(model.joint(f"cube_{cube}_joint").qposadr[0]) for cube in range(len(SLOTS_XY_M))]
        self._slots = [self._solve(np.array(slot), None) for slot in SLOTS_XY_M]

    def turn(self, data: mujoco.MjData, *, cube: int, clockwise: bool, capture_motion_hz: float = 0.0) -> MacroResult:
        """Turn a cube by a quarter, to the nearest right angle and onto its nominal slot.

        The outcome is a pure function of the loose objects' positions and the arguments, bit for bit.

        Args:
            data: The scene, changed in place.
            cube: Which one, left to right in the agent's frame.
            clockwise: As seen from above, which is as seen in the frame.
            capture_motion_hz: Samples of the motion a second to keep; 0 keeps none.

        Raises:
            InvalidValueError: No such cube.
            DivergedError: The simulation blew up.
        """
        if not 0 <= cube < len(self._slots):
            raise InvalidValueError(f"No cube {cube}; there are 0 to {len(self._slots) - 1}.")
        position_m, quat = self._cube_pose(data, cube)
        tilt_rad = math.acos(min(1.0, 1.0 - 2.0 * (quat[1] ** 2 + quat[2] ** 2)))
        if tilt_rad > _MAX_TILT_RAD:
            return self._refuse(data, f"cube {cube} is tipped by {math.degrees(tilt_rad):.0f} degrees")
        try:
            grip = self._solve(position_m[:2], self._slots[cube])
        except UnreachableTargetError as error:
            return self._refuse(data, f"cube {cube} is out of reach: {error}")
        yaw_rad = math.atan2(2.0 * (quat[0] * quat[3] + quat[1] * quat[2]), 1.0 - 2.0 * (quat[2] ** 2 + quat[3] ** 2))
        skew_rad = yaw_rad - round(yaw_rad / _QUARTER_RAD) * _QUARTER_RAD
        waypoints = _waypoints(grip, self._slots[cube], skew_rad, clockwise)
        trajectory = plan(
            self._arm,
            start_qpos_rad=np.array(OBSERVATION_QPOS_RAD),
            start_opening_m=REST_OPENING_M,
            waypoints=waypoints,
            timestep_s=self.executor.model.opt.timestep,
        )
        qpos = self.executor.run(data, trajectory)
        time_s, samples = self.executor.capture(qpos, capture_motion_hz)
        return MacroResult(
            sim_time_s=(len(qpos) - 1) * self.executor.model.opt.timestep,
            ik_error_m=max(grip.error_m, self._slots[cube].error_m),
            fault=self._fault(cube, qpos, trajectory.last_step["turn"] + 1),
            time_s=time_s,
            qpos=samples,
        )

    def _cube_pose(self, data: mujoco.MjData, cube: int) -> tuple[Floats, Floats]:
        """Measured position (3,) in m and unit quaternion (4,) of a cube."""
        start = self._cube_qpos[cube]
        quat = data.qpos[start + 3 : start + 7]
        return data.qpos[start : start + 3].copy(), quat / np.linalg.norm(quat)

    def _solve(self, place_xy_m: Floats, warm_start: _Grip | None) -> _Grip:
        """Configurations that grip, and hover over, a cube standing at ``place_xy_m``. Shape (2,)."""
        grip_z_m = TABLE_HEIGHT_M + CUBE_EDGE_M / 2
        solutions = [
            self._ik.solve(
                position_in_base_m=np.array([*place_xy_m, grip_z_m + lift_m]),
                yaw_rad=_MIDDLE_YAW_RAD,
                start_qpos_rad=start,
            )
            for lift_m, start in (
                (0.0, warm_start.at_qpos_rad if warm_start else None),
                (_LIFT_M, warm_start.above_qpos_rad if warm_start else None),
            )
        ]
        at, above = solutions
        error_m = max(at.position_error_m, above.position_error_m)
        return _Grip(at_qpos_rad=at.qpos_rad, above_qpos_rad=above.qpos_rad, error_m=error_m)

    def _refuse(self, data: mujoco.MjData, reason: str) -> MacroResult:
        """The arm stays where it is."""
        self.executor.rest(data)
        mujoco.mj_forward(self.executor.model, data)
        return MacroResult(
            sim_time_s=0.0, ik_error_m=0.0, fault=reason, time_s=np.empty(0), qpos=np.empty((0, self.executor.model.nq))
        )

    def _fault(self, cube: int, qpos: Floats, turned_step: int) -> str | None:
        """What went wrong as far as the robot itself can feel."""
        if self.executor.opening_m(qpos[turned_step]).min() < _MIN_GRIP_M:
            return f"the fingers closed past cube {cube}"
        off_rad = float(np.abs(self.executor.arm_qpos_rad(qpos[-1]) - OBSERVATION_QPOS_RAD).max())
        if off_rad > _ARM_AT_REST_RAD:
            return f"the arm ended {off_rad:.3f} rad off its observation pose"
        return None


def _waypoints(grip: _Grip, slot: _Grip, skew_rad: float, clockwise: bool) -> list[Waypoint]:
    """Down over the cube as it stands, turned to the nominal slot's right angle, and back.

    The wrist's axis points down: a larger last joint is a smaller yaw, that is clockwise from above.
    """
    sense = 1.0 if clockwise else -1.0
    before = np.zeros(7)
    before[-1] = -sense * _QUARTER_RAD / 2 - skew_rad
    after = np.zeros(7)
    after[-1] = sense * _QUARTER_RAD / 2
    if max(grip.at_qpos_rad[-1], grip.above_qpos_rad[-1]) + before[-1] > _WRIST_LIMIT_RAD:  # a very skew cube
        before[-1] -= math.pi  # the gripper is the same after half a turn
        after[-1] -= math.pi
    squeezed_m = CUBE_EDGE_M / 2 - _SQUEEZE_M
    observe = np.array(OBSERVATION_QPOS_RAD)
    return [
        Waypoint(name="reach", qpos_rad=grip.above_qpos_rad + before, opening_m=REST_OPENING_M),
        Waypoint(name="down", qpos_rad=grip.at_qpos_rad + before, opening_m=REST_OPENING_M),
        Waypoint(name="close", qpos_rad=grip.at_qpos_rad + before, opening_m=squeezed_m, min_duration_s=_CLOSE_S),
        Waypoint(name="turn", qpos_rad=slot.at_qpos_rad + after, opening_m=squeezed_m),
        Waypoint(name="open", qpos_rad=slot.at_qpos_rad + after, opening_m=REST_OPENING_M, min_duration_s=_OPEN_S),
        Waypoint(name="up", qpos_rad=slot.above_qpos_rad + after, opening_m=REST_OPENING_M),
        Waypoint(name="return", qpos_rad=observe, opening_m=REST_OPENING_M),
        Waypoint(name="settle", qpos_rad=observe, opening_m=REST_OPENING_M, min_duration_s=_SETTLE_S),
    ]
