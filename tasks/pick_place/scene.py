"""The scene of pick-and-place with a human as one MJCF model, compiled by plain MuJoCo."""

from __future__ import annotations

import copy
import functools
import math

import mujoco

from ..parameters.distractors import add_distractors
from ..scenes import constants as c
from ..scenes.arm import arm_spec, let_arm_touch
from ..scenes.control_views import add_control_views
from ..scenes.hand import add_open_hand, add_pointing_hand
from ..scenes.objects import add_objects
from ..scenes.tabletop import add_tabletop

TIMESTEP_S = 0.003
"""Objects are carried here: contacts are as stiff as two steps, and in softer ones a held object creeps as the arm
accelerates, since the servos' damping is integrated implicitly and contacts are not."""

CONTROL_TIMESTEP_S = 0.0025
"""Of continuous control: a period of 40 ms has 16 of them."""
_SOLIMP = (0.988, 0.995)
"""Stiffer than MuJoCo's (0.9, 0.95), where a ball sinks by 2 mm in each carry; beyond 0.995 grips chatter and fail."""

PALM_M = (c.ROW_X_M + 0.145, 0.0, c.TABLE_HEIGHT_M + 0.055)
"""Middle of the palm that asks for a handover, in the world."""

IDLE_FINGERTIP_M = (0.96, 0.26, c.TABLE_HEIGHT_M + 0.02)
IDLE_PALM_M = (1.00, -0.26, c.TABLE_HEIGHT_M + 0.04)
"""Where the human's hands rest when they say nothing: at the table's far edge, outside the agent's frame."""

_FOVY_DEG = 57.0
_PITCH_RAD = math.radians(5.5)
"""Wide, and tilted toward the tool: the frame shows the row, the hands, and at its bottom the object in the gripper."""


def pick_scene_spec(distractors: int = 0, *, control: bool = False) -> mujoco.MjSpec:
    """The specification of the scene, as :func:`compile_pick_scene`."""
    spec = arm_spec()  # the scene is added to the arm's own specification, so that every name stays without a prefix
    spec.modelname = "pick_place"
    timestep_s = CONTROL_TIMESTEP_S if control else TIMESTEP_S
    add_tabletop(spec, timestep_s)
    add_objects(spec)
    add_pointing_hand(spec, IDLE_FINGERTIP_M)
    add_open_hand(spec, IDLE_PALM_M)
    add_distractors(spec, distractors)
    for geom in spec.geoms:
        geom.solref = (2 * timestep_s, 1.0)
        geom.solimp[:2] = _SOLIMP
    let_arm_touch(spec)
    camera = spec.camera(c.AGENT_CAMERA)
    camera.fovy = _FOVY_DEG
    camera.alt.xyaxes = (0.0, 1.0, 0.0, math.cos(_PITCH_RAD), 0.0, math.sin(_PITCH_RAD))
    if control:
        add_control_views(spec)
    return spec


@functools.cache
def _compiled(distractors: int, control: bool) -> mujoco.MjModel:
    return pick_scene_spec(distractors, control=control).compile()


def compile_pick_scene(distractors: int = 0, *, control: bool = False) -> mujoco.MjModel:
    """A model of the scene of one's own: appearance may write its colors, lights and cameras.

    ``control`` adds the cameras of continuous control, and has a timestep of which its periods are multiples.
    """
    return copy.copy(_compiled(distractors, control))
