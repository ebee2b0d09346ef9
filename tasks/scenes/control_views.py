"""The images of continuous control: a camera on the hand, a camera in front, and a coarse arm for both.

At 25 commands a second, drawing must be cheap. Views for people draw the arm by 60 geoms, which costs more than the
rest of an image. Here seven boxes stand for the parts that the two cameras see: fingers, hand, wrist and forearm. The
boxes touch nothing and weigh nothing, so that motions are equal, to the bit, to those of a scene without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from . import constants as c
from .tabletop import add_room_camera

_HAND_CAMERA_M = (0.065, 0.0, 0.012)
_HAND_PITCH_RAD = math.radians(14.0)
_HAND_FOVY_DEG = 62.0
"""Tilted toward the tool and wide: from the near edge of a cube between the fingers to a palm behind the row."""

_FRONT_CAMERA_M = (1.00, 0.08, 0.64)
_FRONT_TARGET_M = (c.ROW_X_M + 0.01, 0.0, 0.0)
_FRONT_FOVY_DEG = 31.5
"""From above the human: steep, so that neither the human's hand nor the gripper hides the tops of other cubes; from
the side to which the forearm does not lean; as narrow as rows, hands and the fingers at the observation pose allow."""

_RGBA = {
    "control_gripper": (0.72, 0.73, 0.75, 1.0),
    "control_wrist": (0.45, 0.46, 0.48, 1.0),
    "control_arm": (0.30, 0.31, 0.33, 1.0),
}
"""No part looks like an arrow, a cube or an object."""


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A box in the frame of a body, in metres."""

    name: str
    body: str
    middle_m: c.Point
    half_m: c.Point
    material: str


_FINGER_HALF_M = (0.011, 0.0045, 0.0515)
_PARTS = (
    _Part(
        name="finger_left",
        body="finger_left",
        middle_m=(0.0, 0.0065, -0.0355),
        half_m=_FINGER_HALF_M,
        material="control_gripper",
    ),
    _Part(
        name="finger_right",
        body="finger_right",
        middle_m=(0.0, -0.0065, -0.0355),
        half_m=_FINGER_HALF_M,
        material="control_gripper",
    ),
    _Part(
        name="rail",
        body="right_hand",
        middle_m=(0.0, 0.0, 0.045),
        half_m=(0.022, 0.0735, 0.014),
        material="control_gripper",
    ),
    _Part(
        name="mount",
        body="right_hand",
        middle_m=(0.0, 0.0, 0.0),
        half_m=(0.030, 0.030, 0.032),
        material="control_arm",
    ),
    _Part(
        name="wrist",
        body="right_l5",
        middle_m=(0.0, -0.0425, 0.1053),
        half_m=(0.040, 0.0625, 0.040),
        material="control_wrist",
    ),
    _Part(
        name="housing",
        body="right_l5",
        middle_m=(0.0, 0.0, 0.012),
        half_m=(0.040, 0.040, 0.050),
        material="control_arm",
    ),
    _Part(
        name="forearm",
        body="right_l4",
        middle_m=(0.0, 0.0, 0.1375),
        half_m=(0.042, 0.042, 0.1375),
        material="control_arm",
    ),
)
"""Left finger and right finger each reach from the rail to the end of the pad."""


def add_control_views(spec: mujoco.MjSpec) -> None:
    """Add the parts that agents see in continuous control to a scene that holds the arm, a table and objects.

    The cameras are ``hand`` and ``front``; geoms ``control_*`` of :data:`.constants.CONTROL_GROUP` draw the arm.
    """
    hand = spec.body("right_hand")
    up = (math.cos(_HAND_PITCH_RAD), 0.0, math.sin(_HAND_PITCH_RAD))  # as in "wrist": the hand's +x, and right its +y
    hand.add_camera(name=c.HAND_CAMERA, pos=_HAND_CAMERA_M, fovy=_HAND_FOVY_DEG, xyaxes=(0.0, 1.0, 0.0, *up))
    add_room_camera(spec, c.FRONT_CAMERA, _FRONT_CAMERA_M, _FRONT_TARGET_M, _FRONT_FOVY_DEG)
    for name, rgba in _RGBA.items():
        spec.add_material(name=name, rgba=rgba, specular=0.0)
    for part in _PARTS:
        spec.body(part.body).add_geom(
            name=f"control_{part.name}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=part.half_m,
            pos=part.middle_m,
            material=part.material,
            mass=0.0,
            contype=0,
            conaffinity=0,
            group=c.CONTROL_GROUP,
        )


def varied_by_appearance(model: mujoco.MjModel, materials: Sequence[str]) -> tuple[list[str], list[str]]:
    """The cameras of agents in a scene, and its materials whose colors vary: those given and those of a coarse arm."""
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, c.FRONT_CAMERA) < 0:
        return [c.AGENT_CAMERA], [*materials]
    return [c.AGENT_CAMERA, *c.CONTROL_CAMERAS], [*materials, *_RGBA]
