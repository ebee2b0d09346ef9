"""The arrow puzzle's scene as one MJCF model, compiled by plain MuJoCo."""

from __future__ import annotations

import copy
import functools

import mujoco

from ..scenes.arm import arm_spec
from ..scenes.hand import add_hand
from ..scenes.tabletop import add_tabletop
from .cubes import add_cubes


def arrow_spec() -> mujoco.MjSpec:
    """The whole scene; it is added to the arm's own specification, so that every name stays without a prefix."""
    spec = arm_spec()
    spec.modelname = "arrow_puzzle"
    add_tabletop(spec)
    add_cubes(spec)
    add_hand(spec)
    return spec


@functools.cache
def _compiled() -> mujoco.MjModel:
    return arrow_spec().compile()


def compile_arrow_scene() -> mujoco.MjModel:
    """A model of the scene of one's own: appearance may write its colors, lights and cameras."""
    return copy.copy(_compiled())
