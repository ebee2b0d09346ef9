"""The arrow puzzle's world at run time: puts a macrostate into the scene, lets the arm act, and reads it back."""

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
from ..motion.executor import MacroResult, at_rest
from ..scenes import constants as c
from ..scenes.appearance import Appearance, AppearanceSampler
from .rules import N_CUBES, TURNS
from .scene import compile_arrow_scene

if TYPE_CHECKING:
    from ..motion.turn import TurnExecutor

_QUARTER_RAD = math.pi / 2
_MATERIALS = ("table_top", "cube", "arrow", "skin")

MAX_SKEW_RAD = math.radians(20.0)
"""A cube further from a right angle than this is a fault."""
MAX_TILT_RAD = math.radians(10.0)
MAX_OFF_SLOT_M = 0.015
MAX_OTHER_SHIFT_M = 0.005


class ArrowWorld:
    """One scene of the arrow puzzle.

    Args:
        level: How much the appearance varies.

    Attributes:
        model: Compiled scene, this world's own.
        data: Its state; derived positions are up to date from the start and after every method.
    """

    def __init__(self, level: Appearance) -> None:
        self.model = compile_arrow_scene()
        self.data = mujoco.MjData(self.model)
        self._level = level
        self._appearance = AppearanceSampler(self.model, level, camera=c.AGENT_CAMERA, materials=_MATERIALS)
        starts = [int(self.model.joint(f"cube_{cube}_joint").qposadr[0]) for cube in range(N_CUBES)]
        self._cube_qpos = (np.array(starts)[:, None] + np.arange(7)).ravel()
        self._hand = int(self.model.body("hand").mocapid[0])
        self._pointed = 0
        self._rest_qpos, self._rest_ctrl = at_rest(self.model)
        self._executor: TurnExecutor | None = None
        self.data.qpos[:] = self._rest_qpos
        self._update()

    # --- putting -------------------------------------------------------------------------------------------------

    def place(self, macrostate: tuple[int, ...], rng: np.random.Generator) -> None:
        """Start anew from ``macrostate``, every cube a little off its slot as the appearance says."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.ctrl[:] = self._rest_qpos, self._rest_ctrl
        self._pointed = macrostate[N_CUBES]
        offset_m, offset_rad = self._level.object_offset_m, self._level.object_yaw_rad
        poses: list[float] = []
        for (x_m, y_m), direction, (right, up, turn) in zip(
            c.SLOTS_XY_M, macrostate, rng.uniform(-1.0, 1.0, (N_CUBES, 3)).tolist(), strict=False
        ):
            poses += (x_m + offset_m * right, y_m + offset_m * up, c.CUBE_REST_Z_M)
            poses += orientation.about_vertical(-_QUARTER_RAD * direction + offset_rad * turn)
        self.data.qpos[self._cube_qpos] = poses
        self._point()
        self._update()

    def vary(self, rng: np.random.Generator) -> None:
        """Draw this frame's light, colors, camera and hand as the appearance says."""
        if not self._level.varies_every_frame:
            return
        self._appearance.vary(rng)
        *wobble, turn = rng.uniform(-1.0, 1.0, 4).tolist()
        self._point([self._level.hand_offset_m * each for each in wobble], self._level.hand_yaw_rad * turn)
        self._update()

    def _point(self, offset_m: Sequence[float] = (0.0, 0.0, 0.0), yaw_rad: float = 0.0) -> None:
        slot_x_m, slot_y_m = c.SLOTS_XY_M[self._pointed]
        tip_x_m, tip_y_m, tip_z_m = c.FINGERTIP_IN_SLOT_M
        dx_m, dy_m, dz_m = offset_m
        self.data.mocap_pos[self._hand] = (
            slot_x_m + tip_x_m + dx_m, slot_y_m + tip_y_m + dy_m, c.CUBE_REST_Z_M + tip_z_m + dz_m,
        )  # fmt: skip
        self.data.mocap_quat[self._hand] = orientation.about_vertical(yaw_rad)

    def _update(self) -> None:
        """Bring geoms, cameras and lights up to date with positions."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    # --- acting --------------------------------------------------------------------------------------------------

    def set_outcome(self, action: int, intended: tuple[int, ...]) -> None:
        """Kinematic execution: the turned cube stands exactly on its slot, as a good turn leaves it."""
        cube = TURNS[action].cube
        quat = orientation.about_vertical(-_QUARTER_RAD * intended[cube])
        self.data.qpos[self._cube_qpos[7 * cube : 7 * cube + 7]] = (*c.SLOTS_XY_M[cube], c.CUBE_REST_Z_M, *quat)
        self._update()

    def execute(self, action: int, intended: tuple[int, ...], capture_motion_hz: float) -> MacroResult:
        """Physical execution: the arm turns the cube in contact physics, then everything is at rest again.

        Raises:
            DivergedError: The simulation blew up.
        """
        del intended  # the human keeps pointing
        if self._executor is None:
            from ..motion.turn import TurnExecutor  # noqa: PLC0415  (mink loads only where the arm really moves)

            self._executor = TurnExecutor(self.model)
        turn, before = TURNS[action], self._cube_poses()
        result = self._executor.turn(
            self.data, cube=turn.cube, clockwise=turn.clockwise, capture_motion_hz=capture_motion_hz
        )
        self._executor.executor.rest(self.data)
        self._update()
        return replace(result, fault=result.fault or self._pushed(turn.cube, before))

    # --- reading -------------------------------------------------------------------------------------------------

    def read(self) -> Reading:
        """The macrostate as the scene shows it: yaw of each cube, and the slot the fingertip is over."""
        poses = self._cube_poses().tolist()  # plain floats: three cubes are too few for numpy
        directions, problem = [], None
        for cube, pose in enumerate(poses):
            direction, skew_rad = _direction(pose)
            directions.append(direction)
            problem = problem or _problem(cube, pose, skew_rad)
        fingertip_y_m = float(self.data.mocap_pos[self._hand, 1])
        pointed = min(range(N_CUBES), key=lambda slot: abs(c.SLOTS_XY_M[slot][1] - fingertip_y_m))
        return Reading(macrostate=(*directions, pointed), problem=problem)

    def _cube_poses(self) -> NDArray[np.float64]:
        """Positions and quaternions of the cubes, copied. Shape (3, 7)."""
        return np.asarray(self.data.qpos[self._cube_qpos]).reshape(N_CUBES, 7)

    def _pushed(self, turned: int, before: NDArray[np.float64]) -> str | None:
        shift_m = np.linalg.norm(self._cube_poses()[:, :3] - before[:, :3], axis=1)
        for cube in range(N_CUBES):
            if cube != turned and shift_m[cube] > MAX_OTHER_SHIFT_M:
                return f"cube {cube} was pushed {1e3 * shift_m[cube]:.0f} mm while cube {turned} was turned"
        return None


def _direction(pose: list[float]) -> tuple[int, float]:
    """The nearest direction of a cube's arrow, and how far the cube is turned from it, in rad."""
    turned_rad = orientation.yaw_rad(*pose[3:])
    quarters = round(turned_rad / _QUARTER_RAD)
    return -quarters % 4, abs(turned_rad - quarters * _QUARTER_RAD)


def _problem(cube: int, pose: list[float], skew_rad: float) -> str | None:
    """What is wrong with how a cube stands, or None."""
    x_m, y_m, _, _, qx, qy, _ = pose
    tipped_rad = orientation.tilt_rad(qx, qy)
    slot_x_m, slot_y_m = c.SLOTS_XY_M[cube]
    off_m = math.hypot(x_m - slot_x_m, y_m - slot_y_m)
    if tipped_rad > MAX_TILT_RAD:
        return f"cube {cube} is tipped by {math.degrees(tipped_rad):.0f} degrees"
    if off_m > MAX_OFF_SLOT_M:
        return f"cube {cube} stands {1e3 * off_m:.0f} mm off its slot"
    if skew_rad > MAX_SKEW_RAD:
        return f"cube {cube} stands {math.degrees(skew_rad):.0f} degrees off a right angle"
    return None
