"""Our tasks through the interfaces of other packages; each adapter is one file, imported only when asked for."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.environments import Lanes


def vector_env(env: Lanes | str, **kwargs: Any) -> Lanes:
    """A vector environment that resets in the same step, or that of an id.

    Raises:
        InvalidValueError: Keywords of ``gymnasium.make_vec`` beside an environment, or another mode of reset.
    """
    if isinstance(env, str):
        env = gymnasium.make_vec(env, **kwargs)
    elif kwargs:
        raise InvalidValueError(f"{sorted(kwargs)} belong to gymnasium.make_vec; give them with an id.")
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise InvalidValueError(f"{env} has {mode}; give an environment with AutoresetMode.SAME_STEP.")
    return env
