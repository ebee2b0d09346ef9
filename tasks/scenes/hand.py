"""A person's hands as mocap bodies: a right one that points and a left one that opens its palm.

The origin of the pointing hand is its index fingertip; it points along the body's -x, palm down, from the far side of
the table, so that its thumb is on the frame's right. The origin of the open hand is the middle of its palm; its fingers
point along -x. A plate and a rim of capsules carry an object that is laid into it; they are felt and not drawn. Hand
and sleeve are one mesh each, since every drawn geom costs more than its vertices do.
"""

from __future__ import annotations

import mujoco

from . import constants as c
from .meshes import Mesh, ellipsoid, limb, merge, rounded

Joint = tuple[float, float, float, float]
Limb = tuple[Joint, ...]
"""x, y, z and radius of a joint, metres; joints from the root to the tip."""

_INDEX: Limb = ((0.078, 0.003, 0.032, 0.0110), (0.030, 0.0, 0.010, 0.0088), (0.008, 0.0, 0.001, 0.0075))
_CURLED: tuple[Limb, ...] = (
    ((0.076, 0.022, 0.031, 0.0105), (0.050, 0.021, 0.016, 0.0095), (0.066, 0.021, -0.002, 0.0085)),
    ((0.080, 0.040, 0.028, 0.0100), (0.057, 0.038, 0.013, 0.0090), (0.072, 0.038, -0.003, 0.0080)),
    ((0.087, 0.055, 0.024, 0.0090), (0.068, 0.053, 0.010, 0.0080), (0.080, 0.052, -0.002, 0.0072)),
)
_THUMB: Limb = ((0.135, 0, 0.030, 0.0130), (0.102, -0.019, 0.016, 0.0105), (0.074, -0.014, 0.006, 0.0085))
_FOREARM: Limb = ((0.165, 0.030, 0.046, 0.024), (0.235, 0.034, 0.075, 0.029))
_SLEEVE: Limb = ((0.235, 0.034, 0.075, 0.038), (0.440, 0.048, 0.165, 0.050), (0.640, 0.075, 0.270, 0.062))
_PALM_CENTER_M = (0.118, 0.028, 0.037)
_PALM_RADII_M = (0.052, 0.040, 0.019)

PALM_REACH_M = 0.036
"""An object in the palm has its middle within so far of the palm's."""

_OPEN_FINGERS: tuple[Limb, ...] = tuple(
    (
        (-0.036, 0.8 * y, -0.012, 0.0105),
        (-0.036 - 0.45 * reach, 0.95 * y, -0.012, 0.0095),
        (-0.036 - 0.80 * reach, 1.1 * y, -0.004, 0.0088),
        (-0.036 - reach, 1.15 * y, 0.006, 0.0078),
    )
    for y, reach in ((-0.034, 0.058), (-0.012, 0.068), (0.011, 0.064), (0.033, 0.048))
)
_OPEN_THUMB: Limb = (
    (0.03, -0.034, -0.012, 0.014),
    (0, -0.060, -0.004, 0.011),
    (-0.026, -0.072, 0.004, 0.0088),
)
_HEEL: Limb = ((0.020, 0.0, -0.020, 0.022), (0.070, 0.004, -0.020, 0.024), (0.100, 0.006, -0.016, 0.023))
_OPEN_FOREARM: Limb = ((0.090, 0.006, -0.016, 0.024), (0.160, 0.010, 0.004, 0.029))
_OPEN_SLEEVE: Limb = (
    (0.160, 0.010, 0.004, 0.038),
    (0.365, 0.0, 0.094, 0.050),
    (0.565, -0.02, 0.200, 0.062),
)
_OPEN_PALM_CENTER_M = (0.004, 0.0, -0.014)
_OPEN_PALM_RADII_M = (0.056, 0.047, 0.015)

_PLATE_HALF_M = (0.050, 0.042, 0.008)
_RIM_M = (0.046, 0.040)
_RIM_RADIUS_M = 0.007


def hand_meshes() -> dict[str, Mesh]:
    """Index, curled fingers, thumb and palm, as agents' frames show them and smooth; the bare wrist; the sleeve."""
    fingers = (_INDEX, _THUMB, *_CURLED)
    coarse = [limb(finger, sides=7 if finger is _INDEX else 5) for finger in fingers]
    coarse.append(ellipsoid(_PALM_CENTER_M, _PALM_RADII_M, sides=9, rings=4))
    palm = ellipsoid(_PALM_CENTER_M, _PALM_RADII_M, sides=28, rings=14)
    return {
        "hand": merge(coarse),
        "hand_smooth": merge([*map(_smooth, fingers), palm]),
        "wrist": _smooth(_FOREARM),
        "sleeve": _smooth(_SLEEVE),
    }


def _smooth(joints: Limb) -> Mesh:
    """A limb for people, who look closely."""
    return limb(rounded(joints), sides=20)


def fingertip_m(slot_xy_m: tuple[float, float]) -> c.Point:
    """Nominal tip of the index finger that points at an object on a slot, in the world."""
    dx_m, dy_m, dz_m = c.FINGERTIP_IN_SLOT_M
    return (slot_xy_m[0] + dx_m, slot_xy_m[1] + dy_m, c.CUBE_REST_Z_M + dz_m)


def add_pointing_hand(spec: mujoco.MjSpec, tip_m: c.Point) -> None:
    """Add a person's materials and the mocap body ``hand`` with its index fingertip at a place in the world."""
    spec.add_material(name="skin", rgba=(0.91, 0.68, 0.55, 1.0), specular=0.15, shininess=0.2)
    spec.add_material(name="cloth", rgba=(0.20, 0.35, 0.55, 1.0), specular=0.05)
    add_limb(spec, "hand", tip_m, hand_meshes())


def add_limb(spec: mujoco.MjSpec, name: str, pos_m: c.Point, meshes: dict[str, Mesh]) -> mujoco.MjsBody:
    """Add a mocap body drawn by four meshes, which touch nothing: hand, smooth hand, bare wrist, sleeve, in this order.

    The agent's frame shows the first alone, and views for people the others.
    """
    body = spec.worldbody.add_body(name=name, mocap=True, pos=pos_m)
    seen = c.SETTING_GROUP
    materials = (("skin", c.AGENT_GROUP), ("skin", seen), ("skin", seen), ("cloth", seen))
    for (part, mesh), (material, group) in zip(meshes.items(), materials, strict=True):
        add_drawn_mesh(spec, body, part, mesh, material=material, group=group, suffix="_skin")
    return body


def open_hand_meshes() -> dict[str, Mesh]:
    """Palm, four fingers bent up a little, thumb and heel, as agents' frames show them and smooth; wrist; sleeve."""
    fingers = [limb(finger, sides=5) for finger in _OPEN_FINGERS]
    palm = ellipsoid(_OPEN_PALM_CENTER_M, _OPEN_PALM_RADII_M, sides=11, rings=4)
    coarse = merge([palm, limb(_OPEN_THUMB, sides=5), *fingers, limb(_HEEL, sides=7)])
    palm = ellipsoid(_OPEN_PALM_CENTER_M, _OPEN_PALM_RADII_M, sides=28, rings=14)
    return {
        "palm": coarse,
        "palm_smooth": merge([palm, *map(_smooth, (_OPEN_THUMB, *_OPEN_FINGERS, _HEEL))]),
        "palm_wrist": _smooth(_OPEN_FOREARM),
        "palm_sleeve": _smooth(_OPEN_SLEEVE),
    }


def add_open_hand(spec: mujoco.MjSpec, palm_m: c.Point) -> None:
    """Add the mocap body ``palm`` with the middle of its palm at a place in the world."""
    body = add_limb(spec, "palm", palm_m, open_hand_meshes())
    touch = {"mass": 0.0, "group": c.COLLISION_GROUP, "friction": (0.9, 0.01, 0.002)}
    body.add_geom(
        name="palm_plate", type=mujoco.mjtGeom.mjGEOM_BOX, size=_PLATE_HALF_M, pos=(0, 0, -_PLATE_HALF_M[2]), **touch
    )
    x, y, z = *_RIM_M, 0.5 * _RIM_RADIUS_M
    corners = ((-x, -y, z), (-x, y, z), (x, y, z), (x, -y, z))
    for number, (start, end) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
        body.add_geom(
            name=f"palm_rim_{number}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(_RIM_RADIUS_M, 0, 0),
            fromto=(*start, *end),
            **touch,
        )


def add_drawn_mesh(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    mesh: Mesh,
    *,
    material: str,
    group: int = c.SCENE_GROUP,
    suffix: str = "",
) -> None:
    """Add a geom that is drawn, weighs nothing and touches nothing.

    MuJoCo moves a mesh into its own inertial frame and the geom back: positions stay as given.
    """
    spec.add_mesh(
        name=name,
        smoothnormal=group == c.SETTING_GROUP,
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body.add_geom(
        name=name + suffix,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=material,
        mass=0.0,
        contype=0,
        conaffinity=0,
        group=group,
    )
