"""A pointing human hand as a mocap body: its origin is the index fingertip, and it points along the body's -x.

It is a right hand, palm down, that comes from the far side of the table: the thumb is on the frame's right. Hand and
sleeve are one mesh each, since every drawn geom costs more than its vertices do.
"""

from __future__ import annotations

from . import constants as c
from .composing import mjcf
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


def add_hand(root: mjcf.RootElement) -> None:
    """Add the mocap body ``hand``, pointing at the middle slot."""
    x_m, y_m = c.SLOTS_XY_M[1]
    tip = c.FINGERTIP_IN_SLOT_M
    add_person_materials(root)
    add_pointing_hand(root, (x_m + tip[0], y_m + tip[1], c.TABLE_HEIGHT_M + c.CUBE_EDGE_M / 2 + tip[2]))


def add_person_materials(root: mjcf.RootElement) -> None:
    """What every part of the person is made of."""
    root.asset.add("material", name="skin", rgba=(0.91, 0.68, 0.55, 1.0), specular=0.15, shininess=0.2)
    root.asset.add("material", name="cloth", rgba=(0.20, 0.35, 0.55, 1.0), specular=0.05)


def add_pointing_hand(root: mjcf.RootElement, fingertip_m: tuple[float, float, float]) -> None:
    """Add the mocap body ``hand`` with its index fingertip at a place in the world."""
    add_limb(root, "hand", fingertip_m, {"hand": hand_mesh(), "wrist": wrist_mesh(), "sleeve": sleeve_mesh()})


def add_limb(
    root: mjcf.RootElement, name: str, pos_m: tuple[float, float, float], parts: dict[str, Mesh]
) -> mjcf.Element:
    """Add a mocap body drawn by three meshes, which touch nothing.

    Args:
        root: The scene.
        name: Of the body.
        pos_m: Of its origin, in the world.
        parts: The hand, the bare wrist and the sleeve, in this order; the agent's frame shows the hand alone.
    """
    body = root.worldbody.add("body", name=name, mocap="true", pos=pos_m)
    looks = (("skin", c.SCENE_GROUP), ("skin", c.SETTING_GROUP), ("cloth", c.SETTING_GROUP))
    for (part, mesh), (material, group) in zip(parts.items(), looks, strict=True):
        root.asset.add("mesh", name=part, vertex=mesh.vertices.ravel(), face=mesh.faces.ravel(), inertia="shell")
        body.add("geom", name=f"{part}_skin", type="mesh", mesh=part, material=material, mass=0.0, contype=0,
                 conaffinity=0, group=group)  # fmt: skip
    return body
