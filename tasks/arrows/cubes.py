"""Free cubes on the table, each with an arrow on top that points along the body's +x at yaw 0."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from ..scenes import constants as c
from ..scenes.meshes import prism

_ARROW_THICKNESS_M = 0.0008
_HALF_M = c.CUBE_EDGE_M / 2
_TIP_M = 0.023
_BARB_M = 0.020
_TAIL_M = 0.022
_NECK_X_M = 0.001
_SHAFT_HALF_M = 0.0075


def arrow_outline() -> np.ndarray:
    """Corners of an arrow along +x, counter-clockwise, in metres. Shape (7, 2)."""
    upper = [(_NECK_X_M, _BARB_M), (_NECK_X_M, _SHAFT_HALF_M), (-_TAIL_M, _SHAFT_HALF_M)]
    return np.array([(_TIP_M, 0.0), *upper, *[(x, -y) for x, y in reversed(upper)]])


def add_cubes(spec: mujoco.MjSpec, slots_xy_m: Sequence[tuple[float, float]]) -> None:
    """Add bodies ``cube_0`` and on, one on each slot, with free joints ``cube_i_joint``."""
    arrow = prism(arrow_outline(), 0.0, _ARROW_THICKNESS_M)
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
