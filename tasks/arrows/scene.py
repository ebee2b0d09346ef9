"""The arrow puzzle's scene as one MJCF model, compiled by plain MuJoCo."""

from __future__ import annotations

import copy
import functools

import mujoco

from ..parameters.distractors import add_distractors
from ..scenes.arm import arm_spec, let_arm_touch
from ..scenes.constants import AGENT_CAMERA
from ..scenes.hand import add_pointing_hand
from ..scenes.layout import layout
from ..scenes.tabletop import add_tabletop
from .cubes import add_cubes


@functools.cache
def _compiled(cubes: int, distractors: int) -> mujoco.MjModel:
    spec = arm_spec()  # the scene is added to the arm's own specification, so that every name stays without a prefix
    spec.modelname = "arrow_puzzle"
    add_tabletop(spec)
    places = layout(cubes)
    add_cubes(spec, places.slots_xy_m)
    add_pointing_hand(spec, places.fingertips_m[cubes // 2])
    add_distractors(spec, distractors)
    let_arm_touch(spec)
    spec.camera(AGENT_CAMERA).fovy = places.fovy_deg
    return spec.compile()


def compile_arrow_scene(cubes: int = 3, distractors: int = 0) -> mujoco.MjModel:
    """A model of the scene of one's own, with 1 to 6 cubes: appearance may write its colors, lights and cameras."""
    return copy.copy(_compiled(cubes, distractors))
