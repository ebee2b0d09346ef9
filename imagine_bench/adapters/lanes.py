"""Infos of a Gymnasium vector environment lane by lane, as tools expect them that know lists of infos."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from imagine_bench.arrays import Info, Observed
from imagine_bench.environments import Lanes
from imagine_bench.errors import InvalidValueError


def vector_env(env: Lanes | str, **kwargs: Any) -> Lanes:
    """A vector environment that resets in the same step, or that of an id.

    Raises:
        InvalidValueError: Keywords of ``gymnasium.make_vec`` beside an environment, or another mode of reset.
    """
    if isinstance(env, str):
        env = gymnasium.make_vec(env, **kwargs)
    elif kwargs:
        raise InvalidValueError(f"{sorted(kwargs)} belong to gymnasium.make_vec; give them with an id.")
    if (mode := env.metadata.get("autoreset_mode")) != AutoresetMode.SAME_STEP:
        raise InvalidValueError(f"{env} has {mode}; give an environment with AutoresetMode.SAME_STEP.")
    return env


def info_of(infos: Info, lane: int) -> Info:
    """What the infos of all lanes say of one, copied; how it ended (``final_obs``, ``final_info``) left out."""
    info = {}
    for key, value in infos.items():
        if key in ("final_obs", "final_info") or not infos.get(f"_{key}", np.zeros(lane + 1))[lane]:
            continue
        info[key] = info_of(value, lane) if isinstance(value, dict) else deepcopy(value[lane])
    return info


def endings(infos: Info) -> dict[int, tuple[Observed, Info]]:
    """The last observation and info of each lane whose episode ended."""
    ended: dict[int, tuple[Observed, Info]] = {}
    for lane in np.flatnonzero(infos.get("_final_obs", ())).tolist():
        last = infos["final_obs"]
        seen = info_of(last, lane) if isinstance(last, dict) else last[lane]
        ended[lane] = seen, info_of(infos["final_info"], lane)
    return ended
