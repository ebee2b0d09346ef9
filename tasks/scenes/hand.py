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
_CURLED = {
    "middle": ((0.076, 0.022, 0.031, 0.0105), (0.050, 0.021, 0.016, 0.0095), (0.066, 0.021, -0.002, 0.0085)),
    "ring": ((0.080, 0.040, 0.028, 0.0100), (0.057, 0.038, 0.013, 0.0090), (0.072, 0.038, -0.003, 0.0080)),
    "little": ((0.087, 0.055, 0.024, 0.0090), (0.068, 0.053, 0.010, 0.0080), (0.080, 0.052, -0.002, 0.0072)),
}
_THUMB: tuple[Joint, ...] = (
    (0.135, 0.000, 0.030, 0.0130),
    (0.102, -0.019, 0.016, 0.0105),
    (0.074, -0.014, 0.006, 0.0085),
)
_FOREARM: tuple[Joint, ...] = ((0.165, 0.030, 0.046, 0.024), (0.235, 0.034, 0.075, 0.029))
_SLEEVE: tuple[Joint, ...] = ((0.235, 0.034, 0.075, 0.038), (0.440, 0.048, 0.165, 0.050), (0.640, 0.075, 0.270, 0.062))
_PALM_CENTER_M, _PALM_RADII_M = (0.118, 0.028, 0.037), (0.052, 0.040, 0.019)


def hand_mesh() -> Mesh:
    """Index, curled fingers, thumb and palm: what the agent's frame shows."""
    curled = [limb(finger, sides=5) for finger in _CURLED.values()]
    palm = ellipsoid(_PALM_CENTER_M, _PALM_RADII_M, sides=9, rings=4)
    return merge([limb(_INDEX, sides=7), limb(_THUMB, sides=5), *curled, palm])


def wrist_mesh() -> Mesh:
    """Wrist and bare forearm, beyond the agent's frame."""
    return limb(_FOREARM, sides=10)


def sleeve_mesh() -> Mesh:
    """The forearm's sleeve."""
    return limb(_SLEEVE, sides=12)


def add_hand(spec: mujoco.MjSpec) -> None:
    """Add the mocap body ``hand``, pointing at the middle slot."""
    x_m, y_m = c.SLOTS_XY_M[1]
    tip = c.FINGERTIP_IN_SLOT_M
    add_person_materials(spec)
    add_pointing_hand(spec, (x_m + tip[0], y_m + tip[1], c.TABLE_HEIGHT_M + c.CUBE_EDGE_M / 2 + tip[2]))


def add_person_materials(spec: mujoco.MjSpec) -> None:
    """What every part of the person is made of."""
    spec.add_material(name="skin", rgba=(0.91, 0.68, 0.55, 1.0), specular=0.15, shininess=0.2)
    spec.add_material(name="cloth", rgba=(0.20, 0.35, 0.55, 1.0), specular=0.05)


def add_pointing_hand(spec: mujoco.MjSpec, fingertip_m: tuple[float, float, float]) -> None:
    """Add the mocap body ``hand`` with its index fingertip at a place in the world."""
    add_limb(spec, "hand", fingertip_m, {"hand": hand_mesh(), "wrist": wrist_mesh(), "sleeve": sleeve_mesh()})


def add_limb(
    spec: mujoco.MjSpec, name: str, pos_m: tuple[float, float, float], meshes: dict[str, Mesh]
) -> mujoco.MjsBody:
    """Add a mocap body drawn by three meshes, which touch nothing.

    Args:
        spec: The scene.
        name: Of the body.
        pos_m: Of its origin, in the world.
        meshes: The hand, the bare wrist and the sleeve, in this order; the agent's frame shows the hand alone.
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
    spec.add_mesh(name=name, uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel(),
                  inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)  # fmt: skip
    body.add_geom(name=geom, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=material, mass=0.0, contype=0,
                  conaffinity=0, group=group)  # fmt: skip
