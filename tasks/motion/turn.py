"""The arrow puzzle's macro-action: grip a cube where it stands, turn it by a quarter, let go, return."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from imagine_bench.errors import InvalidValueError

from ..scenes.constants import CUBE_EDGE_M, OBSERVATION_QPOS_RAD, SLOTS_XY_M, TABLE_HEIGHT_M
from . import orientation as attitude
from .arm_model import ArmModel, Floats
from .executor import REST_OPENING_M, MacroExecutor, MacroResult
from .ik import ArmIK, UnreachableTargetError
from .trajectory import Waypoint, plan

_QUARTER_RAD = math.pi / 2
_MIDDLE_YAW_RAD = math.pi / 4
"""IK is solved halfway of the turn, which keeps the wrist's whole quarter within its limits."""

_MAX_SKEW_RAD = math.radians(8)
"""Beyond it the last joint might leave its range, so the other pair of faces is gripped."""
_PAD_THICKNESS_M, _CLEARANCE_M = 0.008, 0.003

_LIFT_M = 0.06
"""The fingers come from and go to so far above the grip: the cube's top and 16 mm."""
_SQUEEZE_M = 0.004
"""Each finger's command lies so far inside the cube: about 13 N."""
_CLOSE_S, _OPEN_S, _SETTLE_S = 0.10, 0.07, 0.03
_BLEND_S = 0.10
"""Going down begins so long before the reach ends, and the return so long before the fingers are fully up."""

_MAX_TILT_RAD = math.radians(10)
_MIN_GRIP_M = CUBE_EDGE_M / 2 - _SQUEEZE_M / 2
_ARM_AT_REST_RAD = 0.02


@dataclass(frozen=True, kw_only=True)
class _Stand:
    """How a cube stands on the table, as measured.

    Attributes:
        xy_m: Its centre. Shape (2,).
        yaw_rad: Heading of its x axis.
        tilt_rad: Of its z axis from the vertical.
    """

    xy_m: Floats
    yaw_rad: float
    tilt_rad: float

    @property
    def skew_rad(self) -> float:
        """Yaw beyond the nearest right angle, in [-pi/4, pi/4]."""
        return self.yaw_rad - round(self.yaw_rad / _QUARTER_RAD) * _QUARTER_RAD


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
        stands = [self._measure(data, each) for each in range(len(self._slots))]
        stand = stands[cube]
        if stand.tilt_rad > _MAX_TILT_RAD:
            return self._refuse(data, f"cube {cube} is tipped by {math.degrees(stand.tilt_rad):.0f} degrees")
        try:
            grip = self._solve(stand.xy_m, self._slots[cube])
        except UnreachableTargetError as error:
            return self._refuse(data, f"cube {cube} is out of reach: {error}")
        other_faces = not clockwise and (
            abs(stand.skew_rad) > _MAX_SKEW_RAD
            or any(_crowds(other, stand) for each, other in enumerate(stands) if each != cube)
        )
        waypoints = _waypoints(grip, self._slots[cube], stand.skew_rad, clockwise, other_faces)
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

    def _measure(self, data: mujoco.MjData, cube: int) -> _Stand:
        """Read how a cube stands from the simulation."""
        start = self._cube_qpos[cube]
        w, x, y, z = (data.qpos[start + 3 : start + 7] / np.linalg.norm(data.qpos[start + 3 : start + 7])).tolist()
        return _Stand(
            xy_m=data.qpos[start : start + 2].copy(),
            yaw_rad=attitude.yaw_rad(w, x, y, z),
            tilt_rad=attitude.tilt_rad(x, y),
        )

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


def _crowds(other: _Stand, gripped: _Stand) -> bool:
    """Whether a finger between the two cubes would touch the other one."""
    reach_m = CUBE_EDGE_M / 2 * (math.cos(other.skew_rad) + abs(math.sin(other.skew_rad)))
    needed_m = REST_OPENING_M + _PAD_THICKNESS_M + _CLEARANCE_M + reach_m
    return math.dist(other.xy_m, gripped.xy_m) < needed_m


def _waypoints(grip: _Grip, slot: _Grip, skew_rad: float, clockwise: bool, other_faces: bool) -> list[Waypoint]:
    """Down over the cube as it stands, turned to the nominal slot's right angle, and back.

    The wrist's axis points down: a larger last joint is a smaller yaw, that is clockwise from above. A clockwise turn
    begins with the fingers along x, clear of the row, and ends along y; a counter-clockwise one goes the other way,
    unless ``other_faces`` turns the wrist by a quarter more, which takes longer.
    """
    sense = 1.0 if clockwise else -1.0
    extra_rad = -_QUARTER_RAD if other_faces else 0.0
    before, after = np.zeros(7), np.zeros(7)
    before[-1] = extra_rad - sense * _QUARTER_RAD / 2 - skew_rad
    after[-1] = extra_rad + sense * _QUARTER_RAD / 2
    squeezed_m = CUBE_EDGE_M / 2 - _SQUEEZE_M
    observe = np.array(OBSERVATION_QPOS_RAD)
    return [
        Waypoint(name="reach", qpos_rad=grip.above_qpos_rad + before, opening_m=REST_OPENING_M, blend_s=_BLEND_S),
        Waypoint(name="down", qpos_rad=grip.at_qpos_rad + before, opening_m=REST_OPENING_M),
        Waypoint(name="close", qpos_rad=grip.at_qpos_rad + before, opening_m=squeezed_m, min_duration_s=_CLOSE_S),
        Waypoint(name="turn", qpos_rad=slot.at_qpos_rad + after, opening_m=squeezed_m),
        Waypoint(name="open", qpos_rad=slot.at_qpos_rad + after, opening_m=REST_OPENING_M, min_duration_s=_OPEN_S),
        Waypoint(name="up", qpos_rad=slot.above_qpos_rad + after, opening_m=REST_OPENING_M, blend_s=_BLEND_S),
        Waypoint(name="return", qpos_rad=observe, opening_m=REST_OPENING_M),
        Waypoint(name="settle", qpos_rad=observe, opening_m=REST_OPENING_M, min_duration_s=_SETTLE_S),
    ]
