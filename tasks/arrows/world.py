"""The arrow puzzle's world at run time: cubes on their slots, their yaw, and a pointing hand."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from imagine_bench.arrays import State

from ..motion import orientation
from ..motion.executor import MacroResult
from ..scenes import constants as c
from ..scenes.appearance import Appearance
from ..world import MAX_SKEW_RAD, World
from .rules import Arrows
from .scene import compile_arrow_scene, layout

if TYPE_CHECKING:
    from ..motion.turn import TurnExecutor

_QUARTER_RAD = math.pi / 2
_THESIS = Arrows()
"""The puzzle of three cubes."""
MAX_OFF_SLOT_M = 0.015
MAX_LIFT_OFF_M = 0.010
"""A cube whose middle is higher than that above where it stands is held, or lies on something."""


class ArrowWorld(World):
    """One scene of the arrow puzzle, its appearance varied as ``level`` says; ``control``: for continuous control."""

    def __init__(self, level: Appearance, parameters: Arrows = _THESIS, *, control: bool = False) -> None:
        self._turns = parameters.turns
        self.layout = layout(parameters.cubes)
        objects = {f"cube_{cube}": f"cube {cube}" for cube in range(parameters.cubes)}
        materials = ("table_top", "cube", "arrow", "skin")
        model = compile_arrow_scene(parameters.cubes, parameters.distractors, control=control)
        super().__init__(model, level, objects=objects, materials=materials, distractors=parameters.distractors)
        self._hand = int(self.model.body("hand").mocapid[0])

    @functools.cached_property
    def executor(self) -> TurnExecutor:
        """The executor of macro-actions in contact physics, made when it is first needed."""
        from ..motion.turn import TurnExecutor  # noqa: PLC0415  (mink loads only where the arm really moves)

        return TurnExecutor(self.model, self.data, self.layout.slots_xy_m, self.sensing)

    def set_outcome(self, action: int, intended: State) -> None:
        """Kinematic execution: a turned cube stands where a good turn leaves it."""
        for turn in self._turns[action]:
            if not self._slipped(turn.cube, intended):
                self._put(turn.cube, intended[turn.cube], self._placement_noise[turn.cube])
        self.set_gesture(intended[-1])
        self.update()

    def execute(self, action: int, intended: State) -> MacroResult:
        """Physical execution: the arm turns cubes in contact physics, one after another, then everything is at rest.

        A cube that is due and shall stay as it is slips out of the fingers.
        """
        turns = self._turns[action]
        before = self.object_poses()
        slipping = [turn.cube for turn in turns if self._slipped(turn.cube, intended)]
        results = [
            self.executor.turn(
                cube=turn.cube,
                clockwise=turn.clockwise,
                slips=turn.cube in slipping,
                noise=self._off(turn.cube, self._placement_noise[turn.cube]),
            )
            for turn in turns
        ]
        self.rest()
        self.set_gesture(intended[-1])
        self.update()
        result = functools.reduce(MacroResult.then, results)
        turned = [turn.cube for turn in turns if turn.cube not in slipping]
        pushed = self._pushed(turned, before, f"while cube {turns[0].cube} was turned")
        return replace(result, fault=result.fault or pushed)

    def rest(self) -> None:
        """Bring the arm to its observation pose."""
        self.executor.rest()

    def _slipped(self, cube: int, intended: State) -> bool:
        """Whether a cube whose turn is due has slipped: its direction is to be the one that it has."""
        return self._objects()[0][cube] == intended[cube]

    def _slot_m(self, index: int) -> tuple[float, float]:
        return self.layout.slots_xy_m[index]

    def _put(self, index: int, value: int, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        x_m, y_m = self.layout.slots_xy_m[index]
        right_m, up_m, turned_rad = self._off(index, offset)
        self.data.qpos[self.object_qpos[index]] = (
            x_m + right_m,
            y_m + up_m,
            c.CUBE_REST_Z_M,
            *orientation.about_vertical(-(_QUARTER_RAD * value - turned_rad)),
        )

    def _hands_m(self, gesture: int) -> dict[int, c.Point]:
        x_m, y_m, z_m = self.layout.fingertips_m[gesture]
        return {self._hand: (x_m + self.places[gesture][0], y_m + self.places[gesture][1], z_m)}

    def read_object(self, index: int, pose: list[float]) -> tuple[int, str | None]:
        """The nearest direction of a cube's arrow, and the fault of the cube's pose."""
        turned_rad = orientation.yaw_rad(*pose[3:]) - self.places[index][2]
        quarters = round(turned_rad / _QUARTER_RAD)
        skew_rad = abs(turned_rad - quarters * _QUARTER_RAD)
        problem = self._misplaced(index, pose)
        if problem is None and skew_rad > MAX_SKEW_RAD:
            problem = f"{self.object_names[index]} stands {math.degrees(skew_rad):.0f} degrees off a right angle"
        return -quarters % 4, problem

    def progress(self, index: int, pose: list[float], before: int, after: int) -> float:
        """The share of its quarter turn that a cube has made."""
        sense = math.remainder(after - before, 4)
        return sense * self._turned_rad(index, pose, before) / _QUARTER_RAD

    def _turned_rad(self, index: int, pose: list[float], value: int) -> float:
        """How far a cube is turned clockwise, as seen in the frame, from a direction. In (-pi, pi]."""
        turned_rad = orientation.yaw_rad(*pose[3:]) - self.places[index][2]
        return math.remainder(-turned_rad - value * _QUARTER_RAD, 2 * math.pi)

    def _misplaced(self, index: int, pose: list[float]) -> str | None:
        """The difference of a cube's pose from one on its slot, however it is turned."""
        name = self.object_names[index]
        tipped = self._tipped(index, pose)
        off_m = math.dist(pose[:2], self._place_m(index))
        if tipped is not None or off_m > MAX_OFF_SLOT_M:
            return tipped or f"{name} stands {1e3 * off_m:.0f} mm off its slot"
        return f"{name} is not on the table" if abs(pose[2] - c.CUBE_REST_Z_M) > MAX_LIFT_OFF_M else None

    def value_in_hand(self, index: int, pose: list[float], value: int, *, gripped: bool) -> int:
        """The direction that a cube on its slot has been turned past by more than 20 degrees, or ``value``."""
        del gripped
        if self._misplaced(index, pose):
            return value
        turned_rad = self._turned_rad(index, pose, value)
        if abs(turned_rad) <= _QUARTER_RAD + MAX_SKEW_RAD:
            return value
        return (value + (1 if turned_rad > 0 else -1)) % 4

    def _read_gesture(self) -> int:
        """The cube whose place the fingertip is over."""
        tip_m = self.data.mocap_pos[self._hand, :2].tolist()
        tips_m = [self._hands_m(cube)[self._hand][:2] for cube in range(len(self.places))]
        return min(range(len(tips_m)), key=lambda cube: math.dist(tips_m[cube], tip_m))
