"""The arrow puzzle's scene as one MJCF model, compiled by plain MuJoCo.

Cubes carry an arrow on top that points along the body's +x at yaw 0. Up to three cubes stand in one row. More stand in
two, alternately far and near, so that each has a column of its own and the finger reaches a near one through a gap of
the far row, without covering an arrow.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from imagine_bench.arrays import Floats

from ..parameters.distractors import add_distractors
from ..scenes import constants as c
from ..scenes.arm import arm_spec, let_arm_touch
from ..scenes.control_views import add_control_views
from ..scenes.hand import add_pointing_hand, fingertip_m
from ..scenes.meshes import stack
from ..scenes.tabletop import add_tabletop

_ONE_ROW = 3
_NEAR_M = 0.56
_FAR_M = 0.65
_WIDTH_M = 0.225
_BACK_M = 0.027
"""So much further from a near cube the fingertip stays, beside those of the far row, and the palm behind them."""
_ONE_ROW_FOVY_DEG = 38.0
_TWO_ROWS_FOVY_DEG = 45.2

_ARROW_THICKNESS_M = 0.0008
_HALF_M = c.CUBE_EDGE_M / 2
_TIP_M = 0.023
_BARB_M = 0.020
_TAIL_M = 0.022
_NECK_X_M = 0.001
_SHAFT_HALF_M = 0.0075


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Places of N cubes, left to right in the agent's frame."""

    slots_xy_m: tuple[tuple[float, float], ...]  #: nominal centres on the table
    fingertips_m: tuple[c.Point, ...]  #: nominal, in the world, pointing at each
    fovy_deg: float  #: field of view of the agent's camera


@functools.cache
def layout(cubes: int) -> Layout:
    """The places of 1 to 6 cubes; more would not fit into the view."""
    two_rows = cubes > _ONE_ROW
    spacing_m = _WIDTH_M / (cubes - 1) if two_rows else c.SLOT_SPACING_M
    middle = (cubes - 1) / 2
    rows_m = [(_NEAR_M if cube % 2 else _FAR_M) if two_rows else c.ROW_X_M for cube in range(cubes)]
    slots = tuple((x_m, spacing_m * (middle - cube)) for cube, x_m in enumerate(rows_m))
    tips = tuple(fingertip_m((x_m + (_BACK_M if x_m == _NEAR_M else 0.0), y_m)) for x_m, y_m in slots)
    fovy_deg = _TWO_ROWS_FOVY_DEG if two_rows else _ONE_ROW_FOVY_DEG
    return Layout(slots_xy_m=slots, fingertips_m=tips, fovy_deg=fovy_deg)


def arrow_outline() -> Floats:
    """Corners of an arrow along +x, counter-clockwise, in metres. Shape (7, 2)."""
    upper = [(_NECK_X_M, _BARB_M), (_NECK_X_M, _SHAFT_HALF_M), (-_TAIL_M, _SHAFT_HALF_M)]
    return np.array([(_TIP_M, 0.0), *upper, *[(x, -y) for x, y in reversed(upper)]])


def add_cubes(spec: mujoco.MjSpec, slots_xy_m: Sequence[tuple[float, float]]) -> None:
    """Add bodies ``cube_0`` and on, one on each slot, with free joints ``cube_i_joint``."""
    outline = arrow_outline()
    arrow = stack([outline, outline], (0.0, _ARROW_THICKNESS_M), outline.mean(axis=0))
    spec.add_mesh(name="arrow", uservert=arrow.vertices.ravel(), userface=arrow.faces.ravel())
    spec.add_material(name="cube", rgba=(0.93, 0.90, 0.82, 1.0), specular=0.1, shininess=0.1)
    spec.add_material(name="arrow", rgba=(0.09, 0.10, 0.13, 1.0), specular=0.0)
    for cube, (x_m, y_m) in enumerate(slots_xy_m):
        body = spec.worldbody.add_body(name=f"cube_{cube}", pos=(x_m, y_m, c.TABLE_HEIGHT_M + _HALF_M))
        body.add_freejoint(name=f"cube_{cube}_joint")
        body.add_geom(
            name=f"cube_{cube}_box",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(_HALF_M,) * 3,
            mass=c.CUBE_MASS_KG,
            material="cube",
            group=c.SCENE_GROUP,
            condim=3,
            friction=(0.8, 0.005, 0.0001),
            solref=(2 * c.TIMESTEP_S, 1.0),
        )
        body.add_geom(
            name=f"cube_{cube}_arrow",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname="arrow",
            material="arrow",
            pos=(0.0, 0.0, _HALF_M),
            mass=0.0,
            contype=0,
            conaffinity=0,
            group=c.SCENE_GROUP,
        )


@functools.cache
def _compiled(cubes: int, distractors: int, control: bool) -> mujoco.MjModel:
    spec = arm_spec()  # the scene is added to the arm's own specification, so that every name stays without a prefix
    spec.modelname = "arrow_puzzle"
    add_tabletop(spec)
    places = layout(cubes)
    add_cubes(spec, places.slots_xy_m)
    add_pointing_hand(spec, places.fingertips_m[cubes // 2])
    add_distractors(spec, distractors)
    let_arm_touch(spec)
    spec.camera(c.AGENT_CAMERA).fovy = places.fovy_deg
    if control:
        add_control_views(spec)
    return spec.compile()


def compile_arrow_scene(cubes: int = 3, distractors: int = 0, *, control: bool = False) -> mujoco.MjModel:
    """A model of the scene of one's own, with 1 to 6 cubes: appearance may write its colors, lights and cameras.

    ``control`` adds the cameras of continuous control.
    """
    return copy.copy(_compiled(cubes, distractors, control))
