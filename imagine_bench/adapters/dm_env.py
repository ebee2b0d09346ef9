"""Our tasks through DeepMind's ``dm_env`` interface, and in dm_control's interactive viewer.

The only module that imports dm_env and dm_control::

    from dm_control import viewer
    from imagine_bench.adapters.dm_env import as_dm_env

    viewer.launch(as_dm_env("imagine_bench/ArrowPuzzle-v0", motion_hz=30))  # space begins, backspace restarts
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Action, Floats, Info
from imagine_bench.errors import InvalidValueError, SetupError
from imagine_bench.interfaces.environments import Env

try:
    registry.load("imagine_bench.tasks.graphics:choose_platform")()  # dm_control chooses another one while it loads
    import dm_env
    from dm_control import mujoco
    from dm_env import specs
except ImportError as error:
    raise SetupError(
        "dm_control is not installed. It needs Python 3.11 or 3.12 (labmaze, which it requires, has no wheel for later "
        "ones): run 'make setup', or \"pip install 'imagine-bench[dm-control]'\", with one of these. Everything "
        "else, such as gymnasium.make, works without it."
    ) from error

_STILL_S = 1.0
"""How far the viewer's clock goes on for a macro-action that took no simulated time."""
_POSE = mujoco.mjtState.mjSTATE_TIME | mujoco.mjtState.mjSTATE_QPOS
_POSE |= mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
"""The state of a scene at one moment, for a viewer: the time (s) first, then positions and mocap bodies."""


def as_dm_env(env: Env | str, *, seed: int | None = None, motion_hz: float = 0.0, **kwargs: Any) -> DmEnvironment:
    """An environment of ours as a ``dm_env.Environment``.

    Args:
        env: A Gymnasium id, or an environment with a Box of observations and Discrete actions.
        seed: Of the first reset; later resets go on with the same generator.
        motion_hz: 0: one step is one macro-action. Above 0, for the viewer: one step is one sample of its motion, so
            many a simulated second.
        **kwargs: Of ``gymnasium.make``, with an id only.

    Raises:
        InvalidValueError: Keywords beside an environment, a negative rate, other spaces, or a rate above 0 for an
            environment that captures no motion.
    """
    if isinstance(env, str):
        env = gymnasium.make(env, **kwargs)
    elif kwargs:
        raise InvalidValueError(f"{sorted(kwargs)} belong to gymnasium.make; give them with an id.")
    return DmEnvironment(env, seed=seed, motion_hz=motion_hz)


class DmEnvironment(dm_env.Environment):  # type: ignore[misc]  # dm_env is not typed
    """A Gymnasium environment behind ``dm_env.Environment``; made by :func:`as_dm_env`.

    Termination has discount 0, truncation and every other step 1. After a last step, and at the start, ``step`` begins
    an episode and ignores its action. With ``motion_hz`` above 0, an action is carried out at once and then shown
    sample by sample: until the last sample, ``step`` ignores its action and the reward is 0.

    Attributes:
        info: The info that Gymnasium's latest ``reset`` or ``step`` gave beside the observation.
    """

    def __init__(self, env: Env, *, seed: int | None, motion_hz: float) -> None:
        space = env.observation_space
        actions = env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or not isinstance(actions, gymnasium.spaces.Discrete):
            raise InvalidValueError(f"No adapter for the spaces {space} and {actions}; give a Box and a Discrete one.")
        self._env = env
        self._seed = seed
        self._motion_hz = motion_hz
        scene: Any = env.unwrapped
        self._scene: Any = scene if hasattr(scene, "replay") else None
        if not motion_hz >= 0 or (motion_hz > 0 and self._scene is None):
            raise InvalidValueError(f"No motion at {motion_hz} Hz; give 0, or more for a task of imagine_bench.")
        if motion_hz > 0:
            scene.capture_motion_hz = motion_hz
        if self._scene is not None:
            scene.agent_view()  # contexts end in reverse order at exit; after ours the display is closed
        self._observation_spec = specs.BoundedArray(space.shape, space.dtype, space.low, space.high, "observation")
        self._action_spec = specs.DiscreteArray(int(actions.n), name="action")
        self.info: Info = {}
        self._physics: mujoco.Physics | None = None
        self._time_s = 0.0
        self._shown = self._pose(0.0)
        self._to_show: list[Floats] = []
        self._before = dm_env.restart(None)
        self._latest: dm_env.TimeStep | None = None

    # --- dm_env --------------------------------------------------------------------------------------------------

    def observation_spec(self) -> specs.BoundedArray:
        """Bounds, shape and type of an observation."""
        return self._observation_spec

    def action_spec(self) -> specs.DiscreteArray:
        """The actions' numbers, from 0."""
        return self._action_spec

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode; the first time with the seed."""
        observation, self.info = self._env.reset(seed=self._seed)
        self._seed = None
        self._to_show = []
        self._latest = dm_env.restart(observation)
        self._show(self._pose(self._time_s))
        return self._latest

    def step(self, action: Action) -> dm_env.TimeStep:
        """Carry out a macro-action, show more of its motion, or begin an episode."""
        if not self._to_show:
            if self._latest is None or self._latest.last():
                return self.reset()
            self._before = self._latest
            observation, reward, terminated, truncated, self.info = self._env.step(action)
            kind = dm_env.termination if terminated else dm_env.truncation if truncated else dm_env.transition
            self._latest = kind(reward=float(reward), observation=observation)
            self._to_show = self._poses()
        self._show(self._to_show.pop(0))
        if self._to_show:
            return dm_env.transition(reward=0.0, observation=self._before.observation)
        return self._latest

    def close(self) -> None:
        """Close the Gymnasium environment."""
        self._env.close()

    def __getstate__(self) -> dict[str, Any]:
        """The attributes of a copy or a pickle: all but the physics, which show the scene of this environment alone."""
        return {**vars(self), "_physics": None}

    # --- the viewer ----------------------------------------------------------------------------------------------

    @property
    def physics(self) -> mujoco.Physics:
        """dm_control's ``Physics`` of the scene that is shown: the task's own model, and data of its own.

        Changes of the data, such as by the viewer's mouse, do not reach the task.

        Raises:
            InvalidValueError: The environment is no task of imagine_bench.
        """
        if self._scene is None:
            raise InvalidValueError(f"{self._env} has no MuJoCo scene to show; give a task of imagine_bench.")
        if self._physics is None:
            quality = self._scene.model.vis.quality  # of contexts still to be made; our own renderers bring theirs
            quality.shadowsize = 2048
            quality.offsamples = 4
            quality.numslices = 28
            quality.numstacks = 14
            self._physics = mujoco.Physics(mujoco.wrapper.MjData(mujoco.wrapper.MjModel(self._scene.model)))
            self._show(self._shown)
        return self._physics

    def _pose(self, time_s: float) -> Floats:
        """The scene as it is now, :data:`_POSE`; empty without one."""
        if self._scene is None:
            return np.empty(0)
        pose = np.empty(mujoco.mj_stateSize(self._scene.model, _POSE))
        mujoco.mj_getState(self._scene.model, self._scene.data, pose, _POSE)
        pose[0] = time_s
        return pose

    def _poses(self) -> list[Floats]:
        """The latest macro-action: its motion, if that is to be shown, and how it ended."""
        begin_s = self._time_s
        self._time_s += self.info.get("sim_time_s") or _STILL_S
        moving = [self._pose(begin_s + time_s) for time_s in self._scene.replay()] if self._motion_hz else []
        return [*moving, self._pose(self._time_s)]

    def _show(self, pose: Floats) -> None:
        self._shown = pose
        if self._physics is not None:
            mujoco.mj_setState(self._scene.model, self._physics.data.ptr, pose, _POSE)
            self._physics.forward()
