"""Our vector environments as scripts like CleanRL's expect them, which were written for Gymnasium 0.29.

In such a script this replaces ``gym.vector.SyncVectorEnv([...])``::

    envs = as_cleanrl("imagine_bench/ArrowPuzzle-vector-v0", num_envs=args.num_envs)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from imagine_bench.adapters import vector_env
from imagine_bench.arrays import Bools, Floats, Info, Ints, Observed
from imagine_bench.interfaces.environments import Lanes


def as_cleanrl(env: Lanes | str, **kwargs: Any) -> FinalObservation:
    """A vector environment with the infos of Gymnasium 0.29.

    Args:
        env: A Gymnasium id, or a vector environment that resets in the same step.
        **kwargs: Of ``gymnasium.make_vec``, with an id only.

    Raises:
        InvalidValueError: Keywords beside an environment, or another mode of reset.
    """
    return FinalObservation(RecordEpisodeStatistics(vector_env(env, **kwargs)))


class FinalObservation(VectorWrapper):
    """Gymnasium 0.29's ``final_observation`` and ``final_info``; made by :func:`as_cleanrl`.

    At steps that end episodes, infos hold an array (N,) of each, None where the lane goes on. ``final_info`` is a
    dictionary with ``episode``: return ``r``, macro-actions ``l`` and seconds ``t`` as Gymnasium counts them, each an
    array (1,). Gymnasium's own ``final_obs`` is gone.
    """

    def step(self, actions: Ints) -> tuple[Observed, Floats, Bools, Bools, Info]:
        """One macro-action in every lane."""
        seen, rewards, terminated, truncated, infos = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            ends = {key: infos.pop(key) for key in ("final_obs", "final_info", "episode")}
            last = np.full(self.num_envs, None, dtype=object)
            final = last.copy()
            for lane in np.flatnonzero(over).tolist():
                of_lane = _of_lane({**ends, "_final_obs": over, "_final_info": over}, lane)
                statistics = {name: values[[lane]] for name, values in ends["episode"].items()}
                last[lane] = of_lane["final_obs"]
                final[lane] = {**of_lane["final_info"], "episode": statistics}
            del infos["_final_obs"], infos["_episode"]
            infos |= {"final_observation": last, "_final_observation": over, "final_info": final}
        return seen, rewards, terminated, truncated, infos


def _of_lane(infos: Info, lane: int) -> Info:
    """The entries of all lanes' infos for one lane."""
    said = {key: value for key, value in infos.items() if f"_{key}" in infos and infos[f"_{key}"][lane]}
    return {key: _of_lane(value, lane) if isinstance(value, dict) else value[lane] for key, value in said.items()}
