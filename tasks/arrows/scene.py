"""The arrow puzzle's scene as one MJCF model, compiled by plain MuJoCo."""

from __future__ import annotations

import copy
import functools

import mujoco

from ..scenes.arm import arm_spec, let_arm_touch
from ..scenes.constants import SLOTS_XY_M
from ..scenes.hand import add_pointing_hand, fingertip_m
from ..scenes.tabletop import add_tabletop
from .cubes import add_cubes


@functools.cache
def _compiled() -> mujoco.MjModel:
    spec = arm_spec()  # the scene is added to the arm's own specification, so that every name stays without a prefix
    spec.modelname = "arrow_puzzle"
    add_tabletop(spec)
    add_cubes(spec)
    add_pointing_hand(spec, fingertip_m(SLOTS_XY_M[1]))
    let_arm_touch(spec)
    return spec.compile()


def compile_arrow_scene() -> mujoco.MjModel:
    """A model of the scene of one's own: appearance may write its colors, lights and cameras."""
    return copy.copy(_compiled())
