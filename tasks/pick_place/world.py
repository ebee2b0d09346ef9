"""The world of pick-and-place at run time: puts a macrostate into the scene, lets arm and human act, reads it back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..macro_env import Reading
from ..motion import orientation
from ..motion.executor import REST_OPENING_M, MacroResult, at_rest
from ..scenes import constants as c
from ..scenes.appearance import Appearance, AppearanceSampler
from ..scenes.arm import FINGER_JOINTS, TCP_SITE
from ..scenes.objects import MATERIALS, OBJECTS, standing_m
from .open_hand import PALM_REACH_M
from .rules import HAND_OVER, HANDED_OVER, N_OBJECTS, OPEN_PALM, PICKED, PLACED, WITHDRAWN, held_object
from .scene import IDLE_FINGERTIP_M, IDLE_PALM_M, PALM_M, compile_pick_scene, fingertip_m

if TYPE_CHECKING:
    from ..motion.carry import CarryExecutor

Floats = NDArray[np.float64]

MAX_TILT_RAD = math.radians(10.0)
MAX_SKEW_RAD = math.radians(20.0)
"""A car or cup on the table that is turned further from its nominal heading is a problem."""
MAX_OFF_SLOT_M = 0.020
MAX_OFF_GRIP_M = 0.015
"""An object further from the tool centre point is not held."""
MAX_LIFT_OFF_M = 0.006
"""An object on the table or in the palm whose origin is higher or lower by so much lies on something else."""
MAX_OTHER_SHIFT_M = 0.005
_IN_THE_AIR_M = 0.15
"""What is held at the observation pose is at least so far above the table."""
_HANDS_FORWARD_X_M = 0.90
"""Fingertip or palm nearer to the robot than this say something."""
_VAIN_M = 0.09
"""The gripper stops so far above what it reaches out for in vain, and its lift."""
_GRIP_SHARE = 0.5
"""Share of the objects' pose variation that remains in the grip, which centres them."""


class PickWorld:
    """One scene of pick-and-place.

    Args:
        level: How much the appearance varies.

    Attributes:
        model: Compiled scene, this world's own.
        data: Its state; derived positions are up to date from the start and after every method.
    """

    def __init__(self, level: Appearance) -> None:
        self.model = compile_pick_scene()
        self.data = mujoco.MjData(self.model)
        self._level = level
        self._appearance = AppearanceSampler(
            self.model, level, camera=c.AGENT_CAMERA, materials=("table_top", "skin", *MATERIALS)
        )
        starts = [int(self.model.joint(f"{spec.name}_joint").qposadr[0]) for spec in OBJECTS]
        self._object_qpos = np.array(starts)[:, None] + np.arange(7)  # [3, 7]
        self._finger_qpos = [int(self.model.joint(name).qposadr[0]) for name in FINGER_JOINTS]
        self._finger_ctrl = [self.model.actuator(name.replace("_slide", "_servo")).id for name in FINGER_JOINTS]
        self._tcp = self.model.site(TCP_SITE).id
        self._hand, self._palm = (int(self.model.body(name).mocapid[0]) for name in ("hand", "palm"))
        self._rest_qpos, self._rest_ctrl = at_rest(self.model)
        self._tcp_at_rest_m = self._tcp_of(self._rest_qpos)
        self._executor: CarryExecutor | None = None
        self._update()

    def _tcp_of(self, qpos: Floats) -> Floats:
        """The tool centre point in the world. Shape (3,)."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        return np.asarray(self.data.site_xpos[self._tcp].copy())

    # --- putting -------------------------------------------------------------------------------------------------

    def place(self, macrostate: tuple[int, ...], rng: np.random.Generator) -> None:
        """Start anew from ``macrostate``, every object a little off its place as the appearance says."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.ctrl[:] = self._rest_qpos, self._rest_ctrl
        offsets = rng.uniform(-1.0, 1.0, (N_OBJECTS, 3))
        for index in range(N_OBJECTS):
            self._put(index, macrostate[index], offsets[index])
        self._gesture(macrostate[N_OBJECTS])
        self._update()

    def _put(self, index: int, where: int, offset: NDArray[np.float64]) -> None:
        """Put an object on its place, into the gripper or into the palm.

        Args:
            index: Which object.
            where: A value of the macrostate.
            offset: Along x, along y and in yaw, as shares of what the appearance allows. Shape (3,).
        """
        level, spec = self._level, OBJECTS[index]
        across, along, turn = offset.tolist()
        if where == PLACED:
            base_m, share_x, share_y = standing_m(index), 1.0, 1.0
        elif where == PICKED:
            base_m, share_x, share_y = tuple(self._tcp_at_rest_m.tolist()), _GRIP_SHARE, 0.0
            self._fingers(spec.grip_opening_m, spec.squeeze_m)
        else:
            base_m, share_x, share_y = (*PALM_M[:2], PALM_M[2] + spec.grip_height_m), 1.0, 1.0
        self.data.qpos[self._object_qpos[index]] = (
            base_m[0] + share_x * level.object_offset_m * across,
            base_m[1] + share_y * level.object_offset_m * along,
            base_m[2],
            *orientation.about_vertical(level.object_yaw_rad * turn * share_x),
        )

    def _fingers(self, opening_m: float, command_m: float) -> None:
        self.data.qpos[self._finger_qpos] = opening_m
        self.data.ctrl[self._finger_ctrl] = command_m

    def vary(self, rng: np.random.Generator) -> None:
        """Draw this frame's light, colors, camera and hands as the appearance says."""
        if not self._level.varies_every_frame:
            return
        self._appearance.vary(rng)
        *wobble, turn = rng.uniform(-1.0, 1.0, 4).tolist()
        objects, gesture = self._objects()[0], self._read_gesture()
        if HANDED_OVER not in objects:  # a hand that carries something keeps still
            self._gesture(
                gesture, [self._level.hand_offset_m * each for each in wobble], self._level.hand_yaw_rad * turn
            )
        self._update()

    def _gesture(self, gesture: int, offset_m: Sequence[float] = (0.0, 0.0, 0.0), yaw_rad: float = 0.0) -> None:
        """Pose both hands: the right one points, the left one opens its palm; idle hands rest at the table's edge."""
        poses = {self._hand: IDLE_FINGERTIP_M, self._palm: IDLE_PALM_M}
        if gesture == OPEN_PALM:
            poses[self._palm] = PALM_M
        elif gesture != WITHDRAWN:
            poses[self._hand] = fingertip_m(gesture)
        for mocap, (x_m, y_m, z_m) in poses.items():
            self.data.mocap_pos[mocap] = (x_m + offset_m[0], y_m + offset_m[1], z_m + offset_m[2])
            self.data.mocap_quat[mocap] = orientation.about_vertical(yaw_rad)

    def _update(self) -> None:
        """Bring geoms, sites, cameras and lights up to date with positions."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    # --- acting --------------------------------------------------------------------------------------------------

    def set_outcome(self, action: int, intended: tuple[int, ...]) -> None:
        """Kinematic execution: what moved is exactly where a good macro-action leaves it."""
        del action
        for index, (now, then) in enumerate(zip(self._objects()[0], intended, strict=False)):
            if now != then:
                self._put(index, then, np.zeros(3))
                if now == PICKED:
                    self._fingers(REST_OPENING_M, REST_OPENING_M)
        self._gesture(intended[N_OBJECTS])
        self._update()

    def execute(self, action: int, intended: tuple[int, ...], capture_motion_hz: float) -> MacroResult:
        """Physical execution: the arm acts in contact, everything comes to rest, and then the human answers.

        The human answers as ``intended`` says if the objects are where that says, and stand as they should; whatever
        else happened is not what they asked for, so they withdraw.

        Raises:
            DivergedError: The simulation blew up.
        """
        if self._executor is None:
            from ..motion.carry import CarryExecutor  # noqa: PLC0415  (mink loads only where the arm really moves)

            self._executor = CarryExecutor(self.model)
        before, poses = self._objects()[0], self._poses()
        result = self._act(self._executor, action, before, capture_motion_hz)
        self._update()
        self._executor.rest(self.data, held_object(self._objects()[0]))
        self._update()
        after, problem = self._objects()
        if HANDED_OVER not in after:  # a palm stays as it is under what lies in it
            as_asked = problem is None and after == intended[:N_OBJECTS]
            self._gesture(intended[N_OBJECTS] if as_asked else WITHDRAWN)
            self._update()
        moving = {index for index in range(N_OBJECTS) if PICKED in (before[index], intended[index])}
        return replace(result, fault=result.fault or self._pushed(moving, poses))

    def _act(
        self, executor: CarryExecutor, action: int, objects: tuple[int, ...], capture_motion_hz: float
    ) -> MacroResult:
        """What the robot does, possible or not: what it cannot do it reaches out for in vain."""
        held = held_object(objects)
        if action == HAND_OVER:
            palm_m = self.data.mocap_pos[self._palm].copy()
            if held is not None and self._read_gesture() == OPEN_PALM:
                return executor.hand_over(self.data, index=held, palm_m=palm_m, capture_motion_hz=capture_motion_hz)
            place_m = np.array([*PALM_M[:2], PALM_M[2] + _VAIN_M])
        elif HANDED_OVER not in objects and held == action:
            return executor.place(self.data, index=action, capture_motion_hz=capture_motion_hz)
        elif HANDED_OVER not in objects and held is None:
            return executor.pick(self.data, index=action, capture_motion_hz=capture_motion_hz)
        else:
            x_m, y_m, z_m = standing_m(action)
            place_m = np.array([x_m, y_m, z_m + _VAIN_M])
        return executor.visit(self.data, place_m=place_m, held=held, capture_motion_hz=capture_motion_hz)

    # --- reading -------------------------------------------------------------------------------------------------

    def read(self) -> Reading:
        """Read the macrostate back from where objects, gripper and hands are."""
        objects, problem = self._objects()
        return Reading(macrostate=(*objects, self._read_gesture()), problem=problem)

    def _poses(self) -> Floats:
        """Positions and quaternions of the objects, copied. Shape (3, 7)."""
        return np.asarray(self.data.qpos[self._object_qpos])

    def _objects(self) -> tuple[tuple[int, ...], str | None]:
        """Where each object is, and what is wrong with the first that is nowhere in particular."""
        tcp_m, palm_m = self.data.site_xpos[self._tcp].tolist(), self.data.mocap_pos[self._palm].tolist()
        where, problem = [], None
        for index, pose in enumerate(self._poses().tolist()):
            place, wrong = _place_of(index, pose, tcp_m, palm_m)
            where.append(place)
            problem = problem or wrong
        return tuple(where), problem

    def _read_gesture(self) -> int:
        """What the hands say."""
        fingertip_x_m, fingertip_y_m, _ = self.data.mocap_pos[self._hand].tolist()
        if self.data.mocap_pos[self._palm, 0] < _HANDS_FORWARD_X_M:
            return OPEN_PALM
        if fingertip_x_m > _HANDS_FORWARD_X_M:
            return WITHDRAWN
        return min(range(N_OBJECTS), key=lambda index: abs(standing_m(index)[1] - fingertip_y_m))

    def _pushed(self, moving: set[int], before: Floats) -> str | None:
        shift_m = np.linalg.norm(self._poses()[:, :3] - before[:, :3], axis=1)
        for index in set(range(N_OBJECTS)) - moving:
            if shift_m[index] > MAX_OTHER_SHIFT_M:
                return f"the {OBJECTS[index].name} was pushed {1e3 * shift_m[index]:.0f} mm by the way"
        return None


def _place_of(index: int, pose: list[float], tcp_m: list[float], palm_m: list[float]) -> tuple[int, str | None]:
    """The value of the macrostate for an object's pose, and what is wrong with how it is there."""
    spec, position_m = OBJECTS[index], pose[:3]
    if position_m[2] > c.TABLE_HEIGHT_M + _IN_THE_AIR_M and math.dist(position_m, tcp_m) < MAX_OFF_GRIP_M:
        return PICKED, None
    in_palm = math.dist(position_m[:2], palm_m[:2]) < PALM_REACH_M
    if in_palm and abs(position_m[2] - palm_m[2] - spec.grip_height_m) < MAX_LIFT_OFF_M:
        return HANDED_OVER, _lean(spec.name, pose) if spec.upright else None
    slot_m = standing_m(index)
    off_m = math.dist(position_m[:2], slot_m[:2])
    if abs(position_m[2] - slot_m[2]) > MAX_LIFT_OFF_M:
        return PLACED, f"the {spec.name} is neither on the table nor held nor in the palm"
    if off_m > MAX_OFF_SLOT_M:
        return PLACED, f"the {spec.name} stands {1e3 * off_m:.0f} mm off its place"
    if not spec.upright:
        return PLACED, None
    return PLACED, _lean(spec.name, pose) or _skew(spec.name, pose)


def _lean(name: str, pose: list[float]) -> str | None:
    tipped_rad = orientation.tilt_rad(*pose[4:6])
    return f"the {name} is tipped by {math.degrees(tipped_rad):.0f} degrees" if tipped_rad > MAX_TILT_RAD else None


def _skew(name: str, pose: list[float]) -> str | None:
    turned_rad = abs(orientation.yaw_rad(*pose[3:]))
    return f"the {name} is turned by {math.degrees(turned_rad):.0f} degrees" if turned_rad > MAX_SKEW_RAD else None
