"""A pointing human hand as a mocap body: its origin is the index fingertip, and it points along the body's -x.

It is a right hand, palm down, that comes from the far side of the table: the thumb is on the frame's right. Hand and
sleeve are one mesh each, since every drawn geom costs more than its vertices do.
"""

from __future__ import annotations

import mujoco

from . import constants as c
from .meshes import Mesh, ellipsoid, limb, merge

Joint = tuple[float, float, float, float]
"""x, y, z and radius of a joint, metres."""

_INDEX: tuple[Joint, ...] = ((0.078, 0.003, 0.032, 0.0110), (0.030, 0.0, 0.010, 0.0088), (0.008, 0.0, 0.001, 0.0075))
_CURLED: tuple[tuple[Joint, ...], ...] = (
    ((0.076, 0.022, 0.031, 0.0105), (0.050, 0.021, 0.016, 0.0095), (0.066, 0.021, -0.002, 0.0085)),
    ((0.080, 0.040, 0.028, 0.0100), (0.057, 0.038, 0.013, 0.0090), (0.072, 0.038, -0.003, 0.0080)),
    ((0.087, 0.055, 0.024, 0.0090), (0.068, 0.053, 0.010, 0.0080), (0.080, 0.052, -0.002, 0.0072)),
)
_THUMB: tuple[Joint, ...] = ((0.135, 0, 0.030, 0.0130), (0.102, -0.019, 0.016, 0.0105), (0.074, -0.014, 0.006, 0.0085))
_FOREARM: tuple[Joint, ...] = ((0.165, 0.030, 0.046, 0.024), (0.235, 0.034, 0.075, 0.029))
_SLEEVE: tuple[Joint, ...] = ((0.235, 0.034, 0.075, 0.038), (0.440, 0.048, 0.165, 0.050), (0.640, 0.075, 0.270, 0.062))
_PALM_CENTER_M = (0.118, 0.028, 0.037)
_PALM_RADII_M = (0.052, 0.040, 0.019)


def hand_meshes() -> dict[str, Mesh]:
    """Index, curled fingers, thumb and palm, which the agent's frame shows; the bare wrist; the sleeve."""
    curled = [limb(finger, sides=5) for finger in _CURLED]
    palm = ellipsoid(_PALM_CENTER_M, _PALM_RADII_M, sides=9, rings=4)
    hand = merge([limb(_INDEX, sides=7), limb(_THUMB, sides=5), *curled, palm])
    return {"hand": hand, "wrist": limb(_FOREARM, sides=10), "sleeve": limb(_SLEEVE, sides=12)}


def fingertip_m(slot_xy_m: tuple[float, float]) -> tuple[float, float, float]:
    """Nominal tip of the index finger that points at what stands on a slot, in the world."""
    dx_m, dy_m, dz_m = c.FINGERTIP_IN_SLOT_M
    return (slot_xy_m[0] + dx_m, slot_xy_m[1] + dy_m, c.CUBE_REST_Z_M + dz_m)


def add_pointing_hand(spec: mujoco.MjSpec, tip_m: tuple[float, float, float]) -> None:
    """Add a person's materials and the mocap body ``hand`` with its index fingertip at a place in the world."""
    spec.add_material(name="skin", rgba=(0.91, 0.68, 0.55, 1.0), specular=0.15, shininess=0.2)
    spec.add_material(name="cloth", rgba=(0.20, 0.35, 0.55, 1.0), specular=0.05)
    add_limb(spec, "hand", tip_m, hand_meshes())


def add_limb(
    spec: mujoco.MjSpec, name: str, pos_m: tuple[float, float, float], meshes: dict[str, Mesh]
) -> mujoco.MjsBody:
    """Add a mocap body drawn by three meshes, which touch nothing: hand, bare wrist and sleeve, in this order.

    The agent's frame shows the hand alone.
    """
    body = spec.worldbody.add_body(name=name, mocap=True, pos=pos_m)
    materials = (("skin", c.SCENE_GROUP), ("skin", c.SETTING_GROUP), ("cloth", c.SETTING_GROUP))
    for (part, mesh), (material, group) in zip(meshes.items(), materials, strict=True):
        add_drawn_mesh(spec, body, part, mesh, material=material, group=group, geom=f"{part}_skin")
    return body


def add_drawn_mesh(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: Mesh, *, material: str, group: int, geom: str
) -> None:
    """Add a geom that is drawn, weighs nothing and touches nothing.

    MuJoCo moves a mesh into its own inertial frame and the geom back: positions stay as given.
    """
    spec.add_mesh(
        name=name,
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body.add_geom(
        name=geom,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=material,
        mass=0.0,
        contype=0,
        conaffinity=0,
        group=group,
    )
