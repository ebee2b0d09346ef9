"""Our vector environments as Stable-Baselines3's ``VecEnv``; extra ``peers``.

The same to the bit as its ``DummyVecEnv`` of single environments, but simulated on all cores::

    from stable_baselines3 import PPO
    from imagine_bench.adapters.sb3 import as_sb3

    PPO("CnnPolicy", as_sb3("imagine_bench/ArrowPuzzle-vector-v0", num_envs=8)).learn(10_000)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from imagine_bench.environments import Env, Lanes
from imagine_bench.errors import lacking

from .lanes import endings, info_of, vector_env

try:
    from stable_baselines3.common import env_util
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
except ImportError as error:
    raise lacking("stable_baselines3") from error


def as_sb3(env: Lanes | str, **kwargs: Any) -> Sb3VecEnv:
    """A vector environment of Gymnasium as one of Stable-Baselines3.

    Args:
        env: A Gymnasium id, or a vector environment that resets in the same step.
        **kwargs: Of ``gymnasium.make_vec``, with an id only.

    Raises:
        InvalidValueError: Keywords beside an environment, or another mode of reset.
    """
    return Sb3VecEnv(vector_env(env, **kwargs))


class Sb3VecEnv(VecEnv):
    """A Gymnasium vector environment behind ``VecEnv``; made by :func:`as_sb3`.

    Seeds and options are taken by the next ``reset``. ``VecMonitor`` around it counts episodes. Attributes and methods
    are those of the lanes, ``env.envs``; a vector environment without lanes of its own stands for each.
    """

    def __init__(self, env: Lanes) -> None:
        self.env = env
        self._laned = hasattr(env, "envs")
        self._lanes: Sequence[Env] = getattr(env, "envs", [env] * env.num_envs)
        self._begun, self._actions = False, np.zeros(env.num_envs, dtype=np.int64)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Begin an episode in every lane: observations (N, ...)."""
        seeds: Any = self._seeds if self._laned else self._seeds[0]
        each_its_own = any(options != self._options[0] for options in self._options)
        if not each_its_own or not self._begun:
            seen, infos = self.env.reset(seed=seeds, options=self._options[0])
            self.reset_infos, self._begun = [info_of(infos, lane) for lane in range(self.num_envs)], True
        for lane, options in enumerate(self._options if each_its_own else ()):
            chosen = {**options, "reset_mask": np.arange(self.num_envs) == lane}
            seen, infos = self.env.reset(seed=seeds, options=chosen)
            self.reset_infos[lane] = info_of(infos, lane)
        self._reset_seeds()
        self._reset_options()
        return seen

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the actions (N,)."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Carry them out: observations, rewards, ends, infos."""
        seen, rewards, terminated, truncated, infos = self.env.step(self._actions)
        ends, rows = endings(infos), [info_of(infos, lane) for lane in range(self.num_envs)]
        for lane, (last, info) in ends.items():
            self.reset_infos[lane], rows[lane] = rows[lane], {**info, "terminal_observation": last}
        for lane, row in enumerate(rows):
            row["TimeLimit.truncated"] = bool(truncated[lane] and not terminated[lane])
        return seen, rewards.astype(np.float32), terminated | truncated, rows

    def close(self) -> None:
        """Close the Gymnasium environment."""
        self.env.close()

    def get_images(self) -> Sequence[Any]:
        """An image of each lane, for render mode ``"rgb_array"``."""
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of these lanes, or all."""
        return [getattr(env, attr_name) for env in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set it."""
        for env in self._chosen(indices):
            setattr(env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """What a method of these lanes, or all, returns."""
        return [getattr(env, method_name)(*args, **kwargs) for env in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Whether such a wrapper is around these lanes, or all."""
        return [env_util.is_wrapped(env, wrapper_class) for env in self._chosen(indices)]

    def _chosen(self, indices: VecEnvIndices) -> list[Env]:
        return [self._lanes[lane] for lane in self._get_indices(indices)]
