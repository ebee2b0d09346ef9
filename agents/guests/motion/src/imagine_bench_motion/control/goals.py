"""Continuous control with goals, as hindsight experience replay takes it (Andrychowicz et al., 2017)."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from imagine_bench.tasks.continuous.env import MotionEnv
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Floats, Info, Observed, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.rules import shortest_plans, tabulate

WITHIN_M = 0.02
WITHIN_RAD = math.radians(20.0)
"""An object that is so near its goal, and turned off it by less, has reached it."""
_PER_OBJECT = 5
_SUCCESS = ("is_success", "success")
"""The keys of ``info`` that say whether the goal is reached."""
GoalObservation = dict[str, NDArray[Any]]


class GoalEnv(gymnasium.Wrapper[Observed, Any, Observed, Any]):
    """Bring each object to where a goal says; whatever the rules make of it, and with their ends.

    Observations are a dict: ``observation``, the parts of the environment's in one vector; ``achieved_goal`` and
    ``desired_goal``, for each object x, y, z (m), and the cosine and sine of its yaw, float32 (5 N,). A goal is where
    the optimal policy leaves the objects that it moves until its success, and where the others stand. The reward is 0
    where it is reached and -1 elsewhere. ``info["is_success"]`` and ``info["success"]`` say so.

    Args:
        env: Whose observation has vectors only: parts of ``proprio``, ``objects`` and ``state``.

    Raises:
        InvalidValueError: Images among the observed parts, a world whose images hide something or are late, or a dense
            reward.
    """

    def __init__(self, env: MotionEnv) -> None:
        super().__init__(env)
        if env.task.sight is not None:
            raise InvalidValueError("Goals say what the scene is like now; give a world without gesture and lag.")
        if env.reward != "sparse":
            raise InvalidValueError("The reward is 0 at the goal and -1 elsewhere; leave out reward.")
        parts = env.observation_space
        self._names: tuple[str, ...] = tuple(parts.spaces) if isinstance(parts, gymnasium.spaces.Dict) else ()
        spaces = [parts[name] for name in self._names] if self._names else [parts]
        if any(space.dtype == np.uint8 for space in spaces):
            raise InvalidValueError(
                'Goals take vectors; make the environment with observation="proprio,objects,state" or parts of it.'
            )
        self._motion = env
        self._planned = env.another_world()
        tables = tabulate(env.task.rules)
        lengths = dict(zip(tables.index, shortest_plans(tables).tolist(), strict=True))
        self._to_go = {macrostate: length for macrostate, length in lengths.items() if length > 0}
        low, high = (np.concatenate([getattr(space, end).ravel() for space in spaces]) for end in ("low", "high"))
        goal = gymnasium.spaces.Box(-2.0, 2.0, (_PER_OBJECT * len(env.world.object_names),), np.float32)
        vector = gymnasium.spaces.Box(low, high, dtype=np.float32)
        named: dict[str, gymnasium.Space[Any]] = {"observation": vector, "achieved_goal": goal, "desired_goal": goal}
        self.observation_space: gymnasium.Space[Any] = gymnasium.spaces.Dict(named)
        self._goal = np.zeros(goal.shape, dtype=np.float32)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observed, Info]:
        """Start an episode, as :class:`imagine_bench.tasks.continuous.env.MotionEnv` does; its goal follows from it."""
        seen, info = self.env.reset(seed=seed, options=options)
        self._planned.set_state(self._motion.world.get_state())
        self._carry_out_plan(self._motion.episode.macrostate)
        self._goal = _goal_of(self._planned.object_poses())
        observation = self._observation(seen)
        return observation, {**info, **dict.fromkeys(_SUCCESS, self._reached(observation) == 0.0)}

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, Info]:
        """Carry out a command."""
        seen, _, terminated, truncated, info = self.env.step(action)
        observation = self._observation(seen)
        reward = self._reached(observation)
        return observation, reward, terminated, truncated, {**info, **dict.fromkeys(_SUCCESS, reward == 0.0)}

    def compute_reward(self, achieved_goal: Floats, desired_goal: Floats, info: object) -> Floats:
        """0 where each object is at its goal, -1 elsewhere; goals (..., 5 N) give rewards (...)."""
        del info
        shape = (*np.shape(achieved_goal)[:-1], -1, _PER_OBJECT)
        achieved = np.reshape(achieved_goal, shape)
        desired = np.reshape(desired_goal, shape)
        away_m = np.linalg.norm(achieved[..., :3] - desired[..., :3], axis=-1)
        aligned = (achieved[..., 3:] * desired[..., 3:]).sum(axis=-1)
        reached = (away_m < WITHIN_M) & (aligned > math.cos(WITHIN_RAD))
        return np.where(reached.all(axis=-1), 0.0, -1.0)

    def _reached(self, observation: Arrays) -> float:
        return float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], None))

    def _observation(self, seen: Observed) -> GoalObservation:
        parts = [seen[name] for name in self._names] if isinstance(seen, dict) else [seen]
        return {
            "observation": np.concatenate([np.asarray(part, dtype=np.float32).ravel() for part in parts]),
            "achieved_goal": _goal_of(self._motion.world.object_poses()),
            "desired_goal": self._goal.copy(),
        }

    def _carry_out_plan(self, macrostate: State) -> None:
        """Set the planned scene to the optimal policy's success, where chance is as kind as it can be."""
        rules = self._motion.task.rules
        while macrostate in self._to_go:
            action = rules.optimal_action(macrostate)
            outcomes = rules.outcomes(macrostate, action)
            best = min(outcomes, key=lambda each: 0 if each.success else self._to_go.get(each.macrostate, math.inf))
            macrostate = best.macrostate
            self._planned.set_outcome(action, macrostate)
            if best.terminated:
                break


def _goal_of(poses: Floats) -> NDArray[np.float32]:
    """Positions, and cosine and sine of the yaw, of poses (N, 7). Shape (5 N,)."""
    w, x, y, z = poses[:, 3:].T
    yaw_rad = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([poses[:, :3], np.cos(yaw_rad), np.sin(yaw_rad)]).ravel().astype(np.float32)


def make(task: str, **options: Any) -> GoalEnv:
    """A task's environment of continuous control with goals, as Gymnasium's ids of this package make it.

    Args:
        task: A task of macro-actions that has continuous control.
        **options: Those of that environment; by default it observes ``proprio,objects``.

    Raises:
        InvalidValueError: Images among the observed parts, or another option out of its range.
    """
    entry = registry.task_entry(task)
    return GoalEnv(registry.load(entry.motion)(**{"observation": "proprio,objects", **entry.options, **options}))
