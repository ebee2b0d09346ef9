"""The world of pick-and-place at run time: objects on the table, in the gripper or a palm, and a human who answers."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imagine_bench.arrays import State

from ..motion import orientation
from ..motion.executor import REST_OPENING_M, MacroResult
from ..scenes.appearance import Appearance
from ..scenes.arm import TCP_SITE, arm_columns
from ..scenes.constants import TABLE_HEIGHT_M, Point
from ..scenes.hand import PALM_REACH_M, fingertip_m
from ..scenes.objects import MATERIALS, OBJECTS, SLOTS_XY_M, standing_m
from ..world import MAX_SKEW_RAD, World
from .rules import HAND_OVER, HANDED_OVER, N_OBJECTS, OPEN_PALM, PICKED, PLACED, WITHDRAWN, PickPlace, held_object
from .scene import IDLE_FINGERTIP_M, IDLE_PALM_M, PALM_M, compile_pick_scene

if TYPE_CHECKING:
    from ..motion.carry import CarryExecutor

MAX_OFF_SLOT_M = 0.020
MAX_OFF_GRIP_M = 0.015
"""An object further from the tool centre point is not held."""
MAX_LIFT_OFF_M = 0.006
"""An object on the table or in the palm whose origin is higher or lower by so much lies on something else."""
_IN_THE_AIR_M = 0.15
"""An object held at the observation pose is at least so far above the table."""
_LIFTED_M = 0.05
"""An object that the fingers hold so far above its place is picked."""
_FAR_M = 0.30
"""A held object so far from its place has made no progress."""
_HANDS_FORWARD_X_M = 0.90
"""Fingertip or palm nearer to the robot than this say something."""
_VAIN_M = 0.09
"""The gripper stops so far above a thing that it reaches out for in vain, and its lift."""
_PLAIN = PickPlace()
_GRIP_SHARE = 0.5
"""Share of the objects' pose variation that remains in the grip, which centres them."""


class PickWorld(World):
    """One scene of pick-and-place, its appearance varied as ``level`` says; ``control``: for continuous control."""

    def __init__(self, level: Appearance, parameters: PickPlace = _PLAIN, *, control: bool = False) -> None:
        objects = {spec.name: f"the {spec.name}" for spec in OBJECTS}
        model = compile_pick_scene(parameters.distractors, control=control)
        materials = ("table_top", "skin", *MATERIALS)
        super().__init__(model, level, objects=objects, materials=materials, distractors=parameters.distractors)
        columns = arm_columns(model)
        self._finger_qpos = columns.qpos[-2:]
        self._finger_ctrl = columns.ctrl[-2:]
        self._hand, self._palm = (int(self.model.body(name).mocapid[0]) for name in ("hand", "palm"))
        self._tcp = model.site(TCP_SITE).id
        self._tcp_at_rest_m = tuple(self.data.site_xpos[self._tcp].tolist())

    @functools.cached_property
    def executor(self) -> CarryExecutor:
        """The executor of macro-actions in contact physics, made when it is first needed."""
        from ..motion.carry import CarryExecutor  # noqa: PLC0415  (mink loads only where the arm really moves)

        return CarryExecutor(self.model, self.data, self.sensing)

    # --- putting -------------------------------------------------------------------------------------------------

    def _slot_m(self, index: int) -> tuple[float, float]:
        return SLOTS_XY_M[index]

    def _put(self, index: int, value: int, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Put an object on its place, into the gripper or into the palm."""
        spec = OBJECTS[index]
        right_m, up_m, turned_rad = self._scaled(offset)
        share = 1.0
        if value == PLACED:
            base_m = standing_m(index)
            right_m, up_m, turned_rad = self._off(index, offset)
        elif value == PICKED:
            base_m = self._tcp_at_rest_m
            share = _GRIP_SHARE
            up_m = 0.0
            self._fingers(spec.grip_opening_m, spec.squeeze_m)
        else:
            base_m = (*PALM_M[:2], PALM_M[2] + spec.grip_height_m)
        x_m, y_m, z_m = base_m
        turned = orientation.about_vertical(turned_rad * share)
        self.data.qpos[self.object_qpos[index]] = (x_m + share * right_m, y_m + up_m, z_m, *turned)

    def _fingers(self, opening_m: float, command_m: float) -> None:
        self.data.qpos[self._finger_qpos] = opening_m
        self.data.ctrl[self._finger_ctrl] = command_m

    def _hands_m(self, gesture: int) -> dict[int, Point]:
        """The right hand points, the left one opens its palm; idle hands rest at the table's edge."""
        points = gesture not in (OPEN_PALM, WITHDRAWN)
        return {
            self._hand: fingertip_m(self._place_m(gesture)) if points else IDLE_FINGERTIP_M,
            self._palm: PALM_M if gesture == OPEN_PALM else IDLE_PALM_M,
        }

    def _hands_vary(self) -> bool:
        """A hand that carries something keeps still."""
        return HANDED_OVER not in self._objects()[0]

    # --- acting --------------------------------------------------------------------------------------------------

    def set_outcome(self, action: int, intended: State) -> None:
        """Kinematic execution: a moved object is where a good macro-action leaves it."""
        del action
        for index, (now, then) in enumerate(zip(self._objects()[0], intended, strict=False)):
            if now != then:
                self._put(index, then, self._placement_noise[index])
                if now == PICKED:
                    self._fingers(REST_OPENING_M, REST_OPENING_M)
        self.set_gesture(intended[N_OBJECTS])
        self.update()

    def execute(self, action: int, intended: State) -> MacroResult:
        """Physical execution: the arm acts in contact, everything comes to rest, and then the human answers.

        The human answers as ``intended`` says if the objects are where that says, and stand as they should; any other
        result is not the one that they asked for, so they withdraw.
        """
        before = self._objects()[0]
        poses = self.object_poses()
        stays = before == intended[:N_OBJECTS]
        result = self._act(action, before, stays)
        self.update()
        self.rest()
        after, problem = self._objects()
        if HANDED_OVER not in after:  # a palm stays as it is under an object in it
            as_asked = problem is None and after == intended[:N_OBJECTS]
            self.set_gesture(intended[N_OBJECTS] if as_asked else WITHDRAWN)
            self.update()
        moving = [index for index in range(N_OBJECTS) if PICKED in (before[index], intended[index])]
        return replace(result, fault=result.fault or self._pushed(moving, poses, "by the way"))

    def rest(self) -> None:
        """Bring the arm to its observation pose, and a held object with it."""
        self.executor.rest_holding(held_object(self._objects()[0]))
        self.update()

    def _act(self, action: int, objects: State, stays: bool) -> MacroResult:
        """The robot's motion, possible or not: for an impossible thing, or one that slips, it reaches out in vain."""
        held = held_object(objects)
        executor = self.executor
        if action == HAND_OVER:
            palm_m = self.data.mocap_pos[self._palm].copy()
            if held is not None and self._read_gesture() == OPEN_PALM and not stays:
                return executor.hand_over(index=held, palm_m=palm_m)
            place_m = np.array([*PALM_M[:2], PALM_M[2] + _VAIN_M])
        elif HANDED_OVER not in objects and held == action and not stays:
            noise = self._off(action, self._placement_noise[action])
            return executor.place(index=action, noise=noise)
        elif HANDED_OVER not in objects and held is None and not stays:
            return executor.pick(index=action)
        else:
            place_m = np.array([*self._place_m(action), standing_m(action)[2] + _VAIN_M])
        return executor.visit(place_m=place_m, held=held)

    # --- reading -------------------------------------------------------------------------------------------------

    def read_object(self, index: int, pose: list[float]) -> tuple[int, str | None]:
        """Where an object is, by its pose (7), and the fault of its pose there."""
        spec = OBJECTS[index]
        name = self.object_names[index]
        position_m = pose[:3]
        in_the_air = position_m[2] > TABLE_HEIGHT_M + _IN_THE_AIR_M
        if in_the_air and math.dist(position_m, self.data.site_xpos[self._tcp].tolist()) < MAX_OFF_GRIP_M:
            return PICKED, None
        palm_m = self.data.mocap_pos[self._palm].tolist()
        in_palm = math.dist(position_m[:2], palm_m[:2]) < PALM_REACH_M
        if in_palm and abs(position_m[2] - palm_m[2] - spec.grip_height_m) < MAX_LIFT_OFF_M:
            return HANDED_OVER, self._tipped(index, pose) if spec.upright else None
        off_m = math.dist(position_m[:2], self._place_m(index))
        if abs(position_m[2] - standing_m(index)[2]) > MAX_LIFT_OFF_M:
            return PLACED, f"{name} is neither on the table nor held nor in the palm"
        if off_m > MAX_OFF_SLOT_M:
            return PLACED, f"{name} stands {1e3 * off_m:.0f} mm off its place"
        if not spec.upright:
            return PLACED, None
        turned_rad = abs(math.remainder(orientation.yaw_rad(*pose[3:]) - self.places[index][2], 2 * math.pi))
        skewed = f"{name} is turned by {math.degrees(turned_rad):.0f} degrees" if turned_rad > MAX_SKEW_RAD else None
        return PLACED, self._tipped(index, pose) or skewed

    def progress(self, index: int, pose: list[float], before: int, after: int) -> float:
        """The share of its lift, or of its way to its place or to the palm, that an object has made."""
        del before
        if after == PICKED:
            return (pose[2] - standing_m(index)[2]) / _LIFTED_M
        place_m = (*self._place_m(index), standing_m(index)[2]) if after == PLACED else PALM_M
        return 1.0 - math.dist(pose[:3], place_m) / _FAR_M

    def value_in_hand(self, index: int, pose: list[float], value: int, *, gripped: bool) -> int:
        """Picked, once it is gripped and lifted by 5 cm; else as before."""
        lifted = pose[2] > standing_m(index)[2] + _LIFTED_M
        return PICKED if gripped and lifted else value

    def _read_gesture(self) -> int:
        fingertip_x_m, fingertip_y_m, _ = self.data.mocap_pos[self._hand].tolist()
        if self.data.mocap_pos[self._palm, 0] < _HANDS_FORWARD_X_M:
            return OPEN_PALM
        if fingertip_x_m > _HANDS_FORWARD_X_M:
            return WITHDRAWN
        return min(range(N_OBJECTS), key=lambda index: abs(self._place_m(index)[1] - fingertip_y_m))
