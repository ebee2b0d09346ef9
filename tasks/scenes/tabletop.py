"""The room: physics options, visual quality, lights, table, the person's place and the cameras for people."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np

from . import constants as c

_TABLE_HALF_M = (0.34, 0.60, 0.02)
_TABLE_X_M = 0.72
_FLOOR_Z_M = -0.92
_LEG_INSET_M = 0.05

ROOM_CAMERAS: dict[str, tuple[c.Point, c.Point, float]] = {
    c.HUMAN_CAMERA: ((1.22, 0.62, 0.66), (0.55, -0.01, 0.13), 36.0),
    c.FAR_CAMERA: ((1.44, 1.14, 0.70), (0.46, 0.03, 0.215), 41.0),
}
"""Of each camera for people its place and the point that it looks at, in metres, and its field of view in degrees."""
_WOOD_PX = 256
_DRAWN_ONLY = {"contype": 0, "conaffinity": 0, "group": c.SETTING_GROUP}
"""Of geoms that only the human's view shows."""


def _set_visual(spec: mujoco.MjSpec) -> None:
    """Cheap frames: no shadow map, no multisampling, coarse primitives; the human's renderer asks for more itself."""
    visual = spec.visual
    visual.quality.shadowsize = 0
    visual.quality.offsamples = 0
    visual.quality.numslices = 12
    visual.quality.numstacks = 6
    visual.quality.numquads = 1
    visual.map.znear = 0.01
    visual.map.zfar = 20.0
    visual.global_.offwidth = 64
    visual.global_.offheight = 64
    spec.stat.extent = 1.0
    spec.stat.center = (c.ROW_X_M, 0.0, c.TABLE_HEIGHT_M)
    headlight = visual.headlight
    headlight.ambient = (0.42,) * 3
    headlight.diffuse = (0.12,) * 3
    headlight.specular = (0.0,) * 3


def _add_wood(spec: mujoco.MjSpec) -> None:
    """The material ``wood``: planks along y whose grain is drawn once, from a fixed seed."""
    rng = np.random.default_rng(0)
    across, along = np.mgrid[0:_WOOD_PX, 0:_WOOD_PX] / _WOOD_PX
    bend = 0.02 * np.sin(2 * np.pi * along) + 0.01 * np.sin(6 * np.pi * along)
    grain = np.interp((across + bend) % 1.0, np.linspace(0.0, 1.0, 97), rng.normal(0.0, 0.04, 97), period=1.0)
    planks = np.repeat(rng.normal(0.0, 0.035, 4), _WOOD_PX // 4)[:, None]
    seams = np.where(across * 4 % 1.0 < 0.02, -0.15, 0.0)
    shade = 1.0 + grain + planks + seams
    pixels = np.clip(235 * shade[..., None], 0, 255).repeat(3, axis=2).astype(np.uint8)
    spec.add_texture(
        name="wood",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=_WOOD_PX,
        height=_WOOD_PX,
        nchannel=3,
        data=pixels.ravel().tolist(),
    )
    wood = spec.add_material(name="wood", rgba=(0.60, 0.47, 0.34, 1.0), specular=0.15, shininess=0.3)
    wood.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "wood"


def _add_table(spec: mujoco.MjSpec, timestep_s: float) -> None:
    """The table top, which carries the objects; its wood and legs, which only views for people show."""
    spec.add_material(name="table_top", rgba=(0.50, 0.44, 0.38, 1.0), specular=0.1, shininess=0.1)
    spec.add_material(name="table_leg", rgba=(0.30, 0.27, 0.25, 1.0), specular=0.1)
    table = spec.worldbody.add_body(name="table", pos=(_TABLE_X_M, 0.0, c.TABLE_HEIGHT_M - _TABLE_HALF_M[2]))
    table.add_geom(
        name="table_top",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=_TABLE_HALF_M,
        material="table_top",
        group=c.AGENT_GROUP,
        friction=(0.8, 0.005, 0.0001),
        solref=(2 * timestep_s, 1.0),
    )
    table.add_geom(
        name="table_wood", type=mujoco.mjtGeom.mjGEOM_BOX, size=_TABLE_HALF_M, material="wood", **_DRAWN_ONLY
    )
    leg_half_m = (c.TABLE_HEIGHT_M - 2 * _TABLE_HALF_M[2] - _FLOOR_Z_M) / 2
    x_m, y_m = (half_m - _LEG_INSET_M for half_m in _TABLE_HALF_M[:2])
    sides = itertools.product((("far", 1), ("near", -1)), (("left", 1), ("right", -1)))
    for (end, x_sign), (side, y_sign) in sides:
        table.add_geom(
            name=f"table_leg_{end}_{side}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(0.025, 0.025, leg_half_m),
            material="table_leg",
            pos=(x_sign * x_m, y_sign * y_m, -_TABLE_HALF_M[2] - leg_half_m),
            **_DRAWN_ONLY,
        )


def _add_floor(spec: mujoco.MjSpec) -> None:
    """Floor, sky and the arm's pedestal, for the human's view only."""
    kind = mujoco.mjtTexture
    builtin = mujoco.mjtBuiltin
    geom = mujoco.mjtGeom
    spec.add_texture(
        name="sky",
        type=kind.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=(0.86, 0.90, 0.94),
        rgb2=(0.60, 0.67, 0.75),
        width=64,
        height=384,
    )
    spec.add_texture(
        name="floor",
        type=kind.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_CHECKER,
        rgb1=(0.74, 0.75, 0.77),
        rgb2=(0.69, 0.70, 0.72),
        width=128,
        height=128,
    )
    floor = spec.add_material(name="floor", texrepeat=(8, 8), specular=0.05)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.add_material(name="pedestal", rgba=(0.22, 0.23, 0.25, 1.0), specular=0.2)
    spec.worldbody.add_geom(
        name="floor",
        type=geom.mjGEOM_PLANE,
        size=(4.0, 4.0, 0.1),
        pos=(0.5, 0.0, _FLOOR_Z_M),
        material="floor",
        **_DRAWN_ONLY,
    )
    for name, radius_m, half_m, z_m in (
        ("pedestal", 0.12, -_FLOOR_Z_M / 2, _FLOOR_Z_M / 2),
        ("pedestal_foot", 0.28, 0.02, _FLOOR_Z_M + 0.02),
    ):
        spec.worldbody.add_geom(
            name=name,
            type=geom.mjGEOM_CYLINDER,
            size=(radius_m, half_m, 0),
            pos=(0, 0, z_m),
            material="pedestal",
            **_DRAWN_ONLY,
        )


def add_room_camera(spec: mujoco.MjSpec, name: str, place_m: c.Point, target_m: c.Point, fovy_deg: float) -> None:
    """Add a camera that stands at a place in the world and looks at a target, upright."""
    backward = np.subtract(place_m, target_m)
    backward /= np.linalg.norm(backward)
    right = np.cross((0.0, 0.0, 1.0), backward)
    right /= np.linalg.norm(right)
    up = np.cross(backward, right)
    spec.worldbody.add_camera(name=name, pos=place_m, fovy=fovy_deg, xyaxes=(*right, *up))


def _add_cameras(spec: mujoco.MjSpec) -> None:
    """The views for people, from the human's left: of the objects on the table, and of everything."""
    for name, (place_m, target_m, fovy_deg) in ROOM_CAMERAS.items():
        add_room_camera(spec, name, place_m, target_m, fovy_deg)


def add_tabletop(spec: mujoco.MjSpec, timestep_s: float = c.TIMESTEP_S) -> None:
    """Everything around the arm, the loose objects and the person's hands.

    Args:
        spec: The scene.
        timestep_s: Of the simulation; contacts get a time constant of two of them.
    """
    option = spec.option  # solver settings in which friction alone holds a lifted object
    option.timestep = timestep_s
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.impratio = 1.0
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP.value  # resting cubes cost nothing: halves a macro-action
    _set_visual(spec)
    _add_wood(spec)
    spec.worldbody.add_light(  # over the human's left shoulder; shadows fall only where a renderer draws them
        name="key",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        castshadow=True,
        pos=(1.0, 0.9, 1.6),
        dir=(-0.28, -0.42, -1.0),
        diffuse=(0.5, 0.49, 0.47),
        specular=(0.06, 0.06, 0.06),
    )
    spec.worldbody.add_light(  # from the right, for people: a renderer that draws for them switches it on
        name="fill",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        active=False,
        castshadow=False,
        pos=(1.0, -1.2, 1.2),
        dir=(-0.5, 0.8, -0.75),
        diffuse=(0.17, 0.18, 0.20),
        specular=(0.45, 0.45, 0.45),
    )
    _add_table(spec, timestep_s)
    _add_floor(spec)
    _add_cameras(spec)
