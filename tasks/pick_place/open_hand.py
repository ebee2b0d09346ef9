"""An open human hand, palm up, as a mocap body: its origin is the middle of the palm, its fingers point along -x.

It is a left hand, so the thumb is on the frame's right. A plate and a rim of capsules carry what is laid into it; they
are felt and not drawn.
"""

from __future__ import annotations

import mujoco

from ..scenes import constants as c
from ..scenes.hand import Joint, add_limb
from ..scenes.meshes import Mesh, ellipsoid, limb, merge

PALM_REACH_M = 0.036
"""What lies in the palm has its middle within so far of the palm's."""

_FINGERS: tuple[tuple[Joint, ...], ...] = tuple(
    (
        (-0.036, 0.8 * y, -0.012, 0.0105),
        (-0.036 - 0.45 * reach, 0.95 * y, -0.012, 0.0095),
        (-0.036 - 0.80 * reach, 1.1 * y, -0.004, 0.0088),
        (-0.036 - reach, 1.15 * y, 0.006, 0.0078),
    )
    for y, reach in ((-0.034, 0.058), (-0.012, 0.068), (0.011, 0.064), (0.033, 0.048))
)
_THUMB: tuple[Joint, ...] = ((0.03, -0.034, -0.012, 0.014), (0, -0.060, -0.004, 0.011), (-0.026, -0.072, 0.004, 0.0088))
_HEEL: tuple[Joint, ...] = ((0.020, 0.0, -0.020, 0.022), (0.070, 0.004, -0.020, 0.024), (0.100, 0.006, -0.016, 0.023))
_FOREARM: tuple[Joint, ...] = ((0.090, 0.006, -0.016, 0.024), (0.160, 0.010, 0.004, 0.029))
_SLEEVE: tuple[Joint, ...] = ((0.160, 0.010, 0.004, 0.038), (0.365, 0.0, 0.094, 0.050), (0.565, -0.02, 0.200, 0.062))
_PALM_CENTER_M = (0.004, 0.0, -0.014)
_PALM_RADII_M = (0.056, 0.047, 0.015)

_PLATE_HALF_M = (0.050, 0.042, 0.008)
_RIM_M = (0.046, 0.040)
_RIM_RADIUS_M = 0.007


def open_hand_meshes() -> dict[str, Mesh]:
    """Palm, four fingers bent up a little and the thumb, which the agent's frame shows; the bare wrist; the sleeve."""
    fingers = [limb(finger, sides=5) for finger in _FINGERS]
    palm = ellipsoid(_PALM_CENTER_M, _PALM_RADII_M, sides=11, rings=4)
    hand = merge([palm, limb(_THUMB, sides=5), *fingers, limb(_HEEL, sides=7)])
    return {"palm": hand, "palm_wrist": limb(_FOREARM, sides=10), "palm_sleeve": limb(_SLEEVE, sides=12)}


def add_open_hand(spec: mujoco.MjSpec, palm_m: tuple[float, float, float]) -> None:
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
