"""Our vector environments as Stable-Baselines3's ``VecEnv``; extra ``peers``.

The same to the bit as its ``DummyVecEnv`` of single environments, but simulated on all cores. ``VecMonitor`` counts the
episodes, without which the library logs no ``ep_rew_mean``::

    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor
    from imagine_bench.adapters.sb3 import as_sb3

    env = VecMonitor(as_sb3("imagine_bench/ArrowPuzzle-vector-v0", num_envs=8))
    PPO("CnnPolicy", env).learn(10_000)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.wrappers.vector import DictInfoToList

from imagine_bench.adapters import vector_env
from imagine_bench.errors import lacking
from imagine_bench.interfaces.environments import Lanes

try:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
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


class Sb3VecEnv(DummyVecEnv):
    """A Gymnasium vector environment behind ``VecEnv``; made by :func:`as_sb3`.

    Seeds and options are taken by the next ``reset``. Attributes and methods
    are those of the lanes, ``env.envs``; a vector environment without lanes of its own has none.
    """

    def __init__(self, env: Lanes) -> None:
        self.env = DictInfoToList(env)
        self.envs = getattr(env.unwrapped, "envs", [env] * env.num_envs)
        self._begun = False
        VecEnv.__init__(self, env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Begin an episode in every lane: observations (N, ...)."""
        seeds: Any = self._seeds if hasattr(self.env.unwrapped, "envs") else self._seeds[0]
        each_its_own = any(options != self._options[0] for options in self._options)
        if not each_its_own or not self._begun:
            seen, self.reset_infos = self.env.reset(seed=seeds, options=self._options[0])
            self._begun = True
        for lane, options in enumerate(self._options if each_its_own else ()):
            chosen = {**options, "reset_mask": np.arange(self.num_envs) == lane}
            seen, infos = self.env.reset(seed=seeds, options=chosen)
            self.reset_infos[lane] = infos[lane]
        self._reset_seeds()
        self._reset_options()
        return seen

    def step_wait(self) -> VecEnvStepReturn:
        """Carry the actions out: observations, rewards, ends, infos."""
        seen, rewards, terminated, truncated, infos = self.env.step(self.actions)
        for lane, info in enumerate(infos):
            if "final_info" in info:
                last = info.pop("final_obs")
                final = info.pop("final_info")
                self.reset_infos[lane] = info
                infos[lane] = {**final, "terminal_observation": last}
            infos[lane]["TimeLimit.truncated"] = bool(truncated[lane] and not terminated[lane])
        return seen, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Close the Gymnasium environment."""
        self.env.close()

    def get_images(self) -> Sequence[Any]:
        """An image of each lane, for render mode ``"rgb_array"``."""
        return self.env.render() or [None] * self.num_envs
