"""The scripted expert: motions that are planned for a macro-action, as hand commands. It sees the true scene."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from imagine_bench.arrays import Floats

from ..motion.arm_model import ArmModel
from ..motion.trajectory import Waypoint, plan
from ..scenes.arm import ARM_JOINTS, arm_columns
from ..scenes.constants import OBSERVATION_QPOS_RAD
from ..world import World
from .controls import HAND_SPEED_M_S, HAND_TURN_RAD_S, MOST_OPEN_M, Motion
from .env import MotionEnv

_AT_REST_RAD = 0.05
"""An arm that is further off its observation pose goes there first."""


class HandTarget(NamedTuple):
    """Where the hand shall be at the end of a control period."""

    joints_rad: Floats  #: as commanded by the plan, ahead of the arm by its lag. Shape (7,).
    opening_m: float  #: command to each finger


class Expert:
    """Carries out macro-actions in an environment of continuous control, by any of its controls.

    The planner of macro-actions plans in a scene of its own, which stands as the environment's does; the hand then
    follows the plan, a period a step.

    Args:
        env: The environment; its scene is read, never changed.
        planner: A world like the environment's, this expert's own; by default a new one.
    """

    def __init__(self, env: MotionEnv, planner: World | None = None) -> None:
        self._env = env
        self._planner = env.another_world() if planner is None else planner
        self._arm = ArmModel()
        self._columns = arm_columns(env.model)
        self._due: deque[HandTarget] = deque()
        self.macro_action = -1  #: the macro-action under way
        self.refused: str | None = None  #: why the planner knows no motion for it, or None

    def begin(self, macro_action: int, *, fails: bool = False) -> None:
        """Plan a macro-action from where the scene stands.

        One that ``fails`` changes nothing: the fingers let go of a cube before they turn it, or reach out in vain.
        """
        env = self._env
        self.macro_action = macro_action
        planner = self._planner
        planner.places = env.world.places
        data = planner.data
        mujoco.mj_resetData(planner.model, data)
        for array, now in ((data.qpos, env.data.qpos), (data.ctrl, env.data.ctrl)):
            array[:] = now
        data.mocap_pos[:] = env.data.mocap_pos
        data.mocap_quat[:] = env.data.mocap_quat
        planner.update()
        planner.rest()
        planner.update()
        before = env.episode.macrostate
        intended = before if fails else env.task.rules.outcomes(before, macro_action)[0].macrostate
        executor = planner.executor
        executor.trajectory = None
        result = planner.execute(macro_action, intended)
        self.refused = result.fault
        self._due.clear()
        self._due.extend(self._approach())
        if executor.trajectory is not None:
            self._due.extend(self._sampled(executor.trajectory.arm_command_rad, executor.trajectory.opening_m))

    @property
    def is_done(self) -> bool:
        """Whether the motion that was begun is over."""
        return not self._due

    def act(self) -> Motion:
        """The next action of the motion, as the environment's control takes it. Shape and dtype of its space."""
        env = self._env
        ctrl = env.data.ctrl[self._columns.ctrl]
        target = self._due.popleft()
        grip = 2.0 * target.opening_m / MOST_OPEN_M - 1.0
        action = np.append(self._arm_action(target.joints_rad, ctrl[: len(ARM_JOINTS)]), grip)
        space = env.controls.space
        return np.clip(action.astype(space.dtype), space.low, space.high)

    def _arm_action(self, target_rad: Floats, joints_rad: Floats) -> Floats:
        control = self._env.controls.control
        if control == "joint":
            return target_rad
        if control == "joint_delta":
            return (target_rad - joints_rad) / (self._arm.speed_limit_rad_s * self._env.period_s)
        place_m, rotation = self._arm.tcp_in_base(target_rad)
        if control == "pose":
            quat = np.empty(4)
            mujoco.mju_mat2Quat(quat, rotation.ravel())
            return np.concatenate([place_m, quat])
        now_m, now = self._arm.tcp_in_base(joints_rad)
        turned = np.empty(4)
        mujoco.mju_mat2Quat(turned, (rotation @ now.T).ravel())
        turn_rad = np.empty(3)
        mujoco.mju_quat2Vel(turn_rad, turned, 1.0)
        period_s = self._env.period_s
        return np.concatenate([(place_m - now_m) / HAND_SPEED_M_S, turn_rad / HAND_TURN_RAD_S]) / period_s

    def _approach(self) -> Sequence[HandTarget]:
        """The way to the observation pose, where macro-actions begin; nothing for an arm that is there."""
        ctrl = self._env.data.ctrl[self._columns.ctrl]
        start_rad = ctrl[: len(ARM_JOINTS)]
        home_rad = np.array(OBSERVATION_QPOS_RAD)
        if np.abs(start_rad - home_rad).max() < _AT_REST_RAD:
            return []
        way = plan(
            self._arm,
            start_qpos_rad=start_rad,
            start_opening_m=float(ctrl[-1]),
            waypoints=[Waypoint("observe", home_rad, float(ctrl[-1]))],
            timestep_s=self._env.model.opt.timestep,
        )
        return self._sampled(way.arm_command_rad, way.opening_m)

    def _sampled(self, joints_rad: Floats, opening_m: Floats) -> list[HandTarget]:
        """A plan by steps of the simulation, at the end of each control period."""
        every = round(self._env.period_s / self._env.model.opt.timestep)
        rows = [*range(every - 1, len(joints_rad) - 1, every), len(joints_rad) - 1]
        return [HandTarget(joints_rad[row], float(opening_m[row])) for row in rows]
