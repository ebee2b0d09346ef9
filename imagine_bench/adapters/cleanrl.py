"""Our vector environments as scripts like CleanRL's expect them, which were written for Gymnasium 0.29.

In such a script this replaces ``gym.vector.SyncVectorEnv([...])``::

    envs = as_cleanrl("imagine_bench/ArrowPuzzle-vector-v0", num_envs=args.num_envs)
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper
from numpy.typing import NDArray

from imagine_bench.arrays import Arrays, Info, Observed
from imagine_bench.environments import Lanes

from .lanes import endings, vector_env


def as_cleanrl(env: Lanes | str, **kwargs: Any) -> FinalObservation:
    """A vector environment with the infos of Gymnasium 0.29.

    Args:
        env: A Gymnasium id, or a vector environment that resets in the same step.
        **kwargs: Of ``gymnasium.make_vec``, with an id only.

    Raises:
        InvalidValueError: Keywords beside an environment, or another mode of reset.
    """
    return FinalObservation(vector_env(env, **kwargs))


class FinalObservation(VectorWrapper):
    """Gymnasium 0.29's ``final_observation`` and ``final_info``; made by :func:`as_cleanrl`.

    At steps that end episodes, infos hold an array (N,) of each, None where the lane goes on. ``final_info`` is a
    dictionary with ``episode``: return ``r``, macro-actions ``l`` and seconds ``t``, as its ``RecordEpisodeStatistics``
    gave them, each an array (1,). Gymnasium's own ``final_obs`` is gone.
    """

    def __init__(self, env: Lanes) -> None:
        super().__init__(env)
        self._returns, self._lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=np.int64)
        self._begun_s = np.zeros(env.num_envs)

    def reset(self, *, seed: int | None = None, options: Arrays | None = None) -> tuple[Observed, Info]:
        """Begin an episode in every lane, or in those of ``options["reset_mask"]``."""
        fresh = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        first = self.env.reset(seed=seed, options=options)
        self._begin(fresh)
        return first

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observed, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """One macro-action in every lane."""
        seen, rewards, terminated, truncated, infos = self.env.step(actions)
        self._returns, self._lengths, over = self._returns + rewards, self._lengths + 1, terminated | truncated
        ended = endings(infos)
        infos = {key: value for key, value in infos.items() if key.lstrip("_") not in ("final_obs", "final_info")}
        if ended:
            last, final = (np.full(self.num_envs, None, dtype=object) for _ in range(2))
            for lane, (observation, info) in ended.items():
                last[lane], final[lane] = observation, {**info, "episode": self._statistics(lane)}
            infos |= {"final_observation": last, "_final_observation": over, "final_info": final, "_final_info": over}
            self._begin(over)
        return seen, rewards, terminated, truncated, infos

    def _statistics(self, lane: int) -> Arrays:
        lasted_s = time.perf_counter() - self._begun_s[lane]
        return {
            "r": self._returns[[lane]].astype(np.float32), "l": self._lengths[[lane]].astype(np.int32),
            "t": np.array([lasted_s], dtype=np.float32),
        }  # fmt: skip

    def _begin(self, lanes: NDArray[np.bool_]) -> None:
        self._returns[lanes], self._lengths[lanes], self._begun_s[lanes] = 0.0, 0, time.perf_counter()
