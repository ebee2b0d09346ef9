"""A Gymnasium vector environment as Stable-Baselines3 wants it, so that its algorithms train in imagination."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv


class SB3VecEnv(VecEnv):
    """A vector environment that begins ended episodes in the same step, such as an imagined one, for the library.

    Per-environment infos hold ``TimeLimit.truncated`` and ``terminal_observation``, which the library bootstraps from,
    and whatever else the environment says of a transition. ``seed`` takes effect at the next ``reset``.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        self.env, self._actions = env, np.empty(0, np.int64)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[np.float32]:
        """First observations (N, Z)."""
        first, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return first

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Note the actions (N,)."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations, rewards, ends and infos of the noted actions."""
        seen, rewards, terminated, truncated, info = self.env.step(self._actions)
        plain = [name for name in info if not name.startswith(("_", "final_"))]
        infos = [{name: info[name][index] for name in plain} for index in range(self.num_envs)]
        for index, own in enumerate(infos):
            own["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
            if terminated[index] or truncated[index]:
                own["terminal_observation"] = info["final_obs"][index]
        return seen, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The environment's attribute, once for each of the episodes."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment, for all episodes."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **names: Any) -> list[Any]:
        """Call a method of the environment, for all episodes."""
        return [getattr(self.env, method_name)(*args, **names)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Of none: what one episode is wrapped in cannot be asked of a vector."""
        return [False] * self.num_envs

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """None: latents are not drawn."""
        return [None] * self.num_envs
