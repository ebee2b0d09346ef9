"""The room: physics options, visual quality, lights, table, the person's place and the human's camera."""

from __future__ import annotations

import numpy as np

from . import constants as c
from .composing import mjcf

_TABLE_HALF_M = (0.34, 0.60, 0.02)
_TABLE_X_M = 0.72
_FLOOR_Z_M = -0.92
_LEG_INSET_M = 0.05

_HUMAN_EYE_M, _HUMAN_TARGET_M, _HUMAN_FOVY_DEG = (1.44, 1.14, 0.70), (0.46, 0.03, 0.215), 41.0


def set_options(root: mjcf.RootElement, timestep_s: float) -> None:
    """Solver settings that hold an object by friction alone; `make speed` measures how well."""
    option = root.option
    option.timestep = timestep_s
    option.integrator, option.solver = "implicitfast", "Newton"
    option.cone, option.impratio = "pyramidal", 1.0
    option.jacobian = "dense"
    option.flag.sleep = "enable"  # resting cubes cost nothing: halves a macro-action


def set_quality(root: mjcf.RootElement) -> None:
    """Cheap frames: no shadow map, no multisampling, coarse primitives; the human's renderer asks for more itself."""
    quality = root.visual.quality
    quality.shadowsize, quality.offsamples = 0, 0
    quality.numslices, quality.numstacks, quality.numquads = 12, 6, 1
    root.visual.map.znear, root.visual.map.zfar = 0.01, 20.0
    getattr(root.visual, "global").offwidth = 64
    getattr(root.visual, "global").offheight = 64
    root.statistic.extent, root.statistic.center = 1.0, (c.ROW_X_M, 0.0, c.TABLE_HEIGHT_M)
    headlight = root.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = (0.42,) * 3, (0.12,) * 3, (0.0,) * 3


def add_lights(root: mjcf.RootElement) -> None:
    """One key light over the human's left shoulder; shadows fall only where a renderer draws them."""
    root.worldbody.add(
        "light", name="key", type="directional", castshadow="true", pos=(1.0, 0.9, 1.6), dir=(-0.28, -0.42, -1.0),
        diffuse=(0.5, 0.49, 0.47), specular=(0.06, 0.06, 0.06),
    )  # fmt: skip


def add_table(root: mjcf.RootElement, timestep_s: float) -> None:
    """The table top, which carries the objects, and its legs and the floor, which only the human's view shows."""
    root.asset.add("material", name="table_top", rgba=(0.50, 0.44, 0.38, 1.0), specular=0.1, shininess=0.1)
    root.asset.add("material", name="table_leg", rgba=(0.30, 0.27, 0.25, 1.0), specular=0.1)
    table = root.worldbody.add("body", name="table", pos=(_TABLE_X_M, 0.0, c.TABLE_HEIGHT_M - _TABLE_HALF_M[2]))
    table.add(
        "geom", name="table_top", type="box", size=_TABLE_HALF_M, material="table_top", group=c.SCENE_GROUP,
        friction=(0.8, 0.005, 0.0001), solref=(2 * timestep_s, 1.0),
    )  # fmt: skip
    leg_half_m = (c.TABLE_HEIGHT_M - 2 * _TABLE_HALF_M[2] - _FLOOR_Z_M) / 2
    for name, x_sign, y_sign in (
        ("far_left", 1, 1),
        ("far_right", 1, -1),
        ("near_left", -1, 1),
        ("near_right", -1, -1),
    ):
        table.add(
            "geom", name=f"table_leg_{name}", type="box", size=(0.025, 0.025, leg_half_m), material="table_leg",
            pos=(x_sign * (_TABLE_HALF_M[0] - _LEG_INSET_M), y_sign * (_TABLE_HALF_M[1] - _LEG_INSET_M),
                 -_TABLE_HALF_M[2] - leg_half_m),
            contype=0, conaffinity=0, group=c.SETTING_GROUP,
        )  # fmt: skip


def add_floor(root: mjcf.RootElement) -> None:
    """Floor, sky and the arm's pedestal, for the human's view only."""
    root.asset.add("texture", name="sky", type="skybox", builtin="gradient", rgb1=(0.86, 0.90, 0.94),
                   rgb2=(0.60, 0.67, 0.75), width=64, height=384)  # fmt: skip
    root.asset.add("texture", name="floor", type="2d", builtin="checker", rgb1=(0.74, 0.75, 0.77),
                   rgb2=(0.69, 0.70, 0.72), width=128, height=128)  # fmt: skip
    root.asset.add("material", name="floor", texture="floor", texrepeat=(8, 8), specular=0.05)
    root.asset.add("material", name="pedestal", rgba=(0.22, 0.23, 0.25, 1.0), specular=0.2)
    setting = {"contype": 0, "conaffinity": 0, "group": c.SETTING_GROUP}
    root.worldbody.add("geom", name="floor", type="plane", size=(4.0, 4.0, 0.1), pos=(0.5, 0.0, _FLOOR_Z_M),
                       material="floor", **setting)  # fmt: skip
    root.worldbody.add("geom", name="pedestal", type="cylinder", size=(0.12, -_FLOOR_Z_M / 2), material="pedestal",
                       pos=(0.0, 0.0, _FLOOR_Z_M / 2), **setting)  # fmt: skip
    root.worldbody.add("geom", name="pedestal_foot", type="cylinder", size=(0.28, 0.02), material="pedestal",
                       pos=(0.0, 0.0, _FLOOR_Z_M + 0.02), **setting)  # fmt: skip


def add_human_camera(root: mjcf.RootElement) -> None:
    """The view a person wants: arm, cubes and pointing hand from the far left."""
    eye, target = np.array(_HUMAN_EYE_M), np.array(_HUMAN_TARGET_M)
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross((0.0, 0.0, 1.0), backward)
    right /= np.linalg.norm(right)
    up = np.cross(backward, right)
    root.worldbody.add("camera", name=c.HUMAN_CAMERA, pos=eye, fovy=_HUMAN_FOVY_DEG, xyaxes=(*right, *up))


def add_tabletop(root: mjcf.RootElement, timestep_s: float = c.TIMESTEP_S) -> None:
    """Everything around the arm, the loose objects and the person's hands.

    Args:
        root: The scene.
        timestep_s: Of the simulation; contacts get a time constant of two of them.
    """
    set_options(root, timestep_s)
    set_quality(root)
    add_lights(root)
    add_table(root, timestep_s)
    add_floor(root)
    add_human_camera(root)
