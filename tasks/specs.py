"""The common part of specs of worlds with parameters. MuJoCo loads when an environment or a frame is made."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, TaskSpec

from .parameters.parameters import WorldParameters, WorldRules

if TYPE_CHECKING:
    from .macro_env import MacroEnv
    from .world import World


@functools.cache
def world_maker(parameters: WorldParameters) -> Callable[..., World]:
    """Makes the scene of a world, given an appearance; always the same one, so that its renderers are shared."""
    module, name = parameters.SCENE.split(":")
    make: Callable[..., World] = getattr(importlib.import_module(module), name)
    return functools.partial(make, parameters=parameters)


def render_macrostates(
    rules: WorldRules, macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator
) -> Frame:
    """Frames of macrostates in the kinematic mode; see :func:`.observations.frames_of`."""
    from .observations import frames_of  # noqa: PLC0415  (MuJoCo loads on the first frame)

    return frames_of(world_maker(rules.world.plainest), rules, macrostates, appearance, rng)


def make_env(kind: type[WorldParameters], spec_of: Callable[..., TaskSpec], options: dict[str, Any]) -> MacroEnv:
    """The environment of a world; ``options`` are its parameters and the keyword arguments of MacroEnv."""
    from .macro_env import MacroEnv  # noqa: PLC0415  (MuJoCo loads with the first environment)

    world = kind.taken_from(options, MacroEnv.KEYWORDS)
    return MacroEnv(spec_of(world), world_maker(world), **options)
