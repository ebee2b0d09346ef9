"""Three objects to pick: a blue ball, a red car, a green cup. Each is gripped from above across its y axis.

Every body's origin is the middle of its grip. The drawn shape is one mesh a color; the shape that touches is a few
primitives, and feet or wheels are spheres, which stand quietly on a table and in a palm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco

from . import constants as c
from .hand import add_drawn_mesh
from .meshes import Mesh, arch, box, limb, merge, turned_profile

SPACING_M = 0.10
SLOTS_XY_M = ((c.ROW_X_M, SPACING_M), (c.ROW_X_M, 0.0), (c.ROW_X_M, -SPACING_M))
"""Nominal places, left to right in the agent's frame."""

TIP_RADIUS_M = 0.004
TIP_OFFSET_M = 0.010
"""Of the gripper's rubber tips, two a pad: their radius, and their distance from the pad's middle along the pad."""

_BALL_RADIUS_M = 0.028
_CAR_HALF_M = (0.034, 0.022, 0.012)
_CAR_CLEARANCE_M = 0.008
_WHEEL_M = 0.010
_CAR_GRIP_Z_M = 0.024
_CUP_RADIUS_M = 0.026
_CUP_HEIGHT_M = 0.062
_CUP_FOOT_M = 0.004
_CUP_GRIP_Z_M = 0.038
_MASS_KG = 0.10
_SQUEEZE_M = 0.004


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """One object as planning and reading see it."""

    name: str  #: of its body; ``<name>_joint`` is its free joint
    grip_height_m: float  #: the body's origin above the surface that it stands on
    grip_opening_m: float  #: each finger's distance from the grip's middle when its tips touch the object
    upright: bool = True  #: whether it has a right way up and a heading; a ball has neither

    @property
    def squeeze_m(self) -> float:
        """The command to each finger that holds the object: a little inside it, about 12 N."""
        return self.grip_opening_m - _SQUEEZE_M


def _round_opening_m(radius_m: float) -> float:
    """Where a finger's two tips touch something round, in the finger's own coordinate."""
    return math.sqrt((radius_m + TIP_RADIUS_M) ** 2 - TIP_OFFSET_M**2) - TIP_RADIUS_M


OBJECTS = (
    ObjectSpec(
        name="ball", grip_height_m=_BALL_RADIUS_M, grip_opening_m=_round_opening_m(_BALL_RADIUS_M), upright=False
    ),
    ObjectSpec(name="car", grip_height_m=_CAR_GRIP_Z_M, grip_opening_m=_CAR_HALF_M[1]),
    ObjectSpec(name="cup", grip_height_m=_CUP_GRIP_Z_M, grip_opening_m=_round_opening_m(_CUP_RADIUS_M)),
)
"""Left to right in the agent's frame."""

_RGBA = {
    "ball": (0.10, 0.28, 0.95, 1.0),
    "car": (0.93, 0.10, 0.09, 1.0),
    "car_dark": (0.10, 0.10, 0.13, 1.0),
    "cup": (0.10, 0.72, 0.22, 1.0),
    "cup_inside": (0.02, 0.14, 0.06, 1.0),
}
MATERIALS = tuple(_RGBA)
_TOUCH = {"group": c.COLLISION_GROUP, "friction": (0.8, 0.005, 0.0001), "condim": 3}
"""Of geoms that are felt and not drawn."""


def standing_m(index: int) -> c.Point:
    """Nominal position of object ``index`` on the table."""
    return (*SLOTS_XY_M[index], c.TABLE_HEIGHT_M + OBJECTS[index].grip_height_m)


def car_body() -> Mesh:
    """Chassis and bonnet, its nose toward the human (+x)."""
    x, y, z = _CAR_HALF_M
    return merge(
        [
            box((-x, -y, _CAR_CLEARANCE_M - _CAR_GRIP_Z_M), (x, y, _CAR_CLEARANCE_M + 2 * z - _CAR_GRIP_Z_M)),
            box((-0.024, -0.019, 0.006), (0.012, 0.019, 0.021), taper=0.82),
        ]
    )


def car_trim() -> Mesh:
    """Windows and wheels."""
    wheel_z = _WHEEL_M - _CAR_GRIP_Z_M
    wheels = [
        limb([(sx * 0.021, sy * 0.017, wheel_z, _WHEEL_M), (sx * 0.021, sy * 0.024, wheel_z, _WHEEL_M)], sides=8)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    windows = [
        box((0.004, -0.016, 0.010), (0.0145, 0.016, 0.0195)),
        box((-0.026, -0.016, 0.010), (-0.018, 0.016, 0.0195)),
    ]
    return merge([*wheels, *windows])


def cup_body() -> Mesh:
    """A mug, its handle toward the robot."""
    low = _CUP_FOOT_M - _CUP_GRIP_Z_M
    high = _CUP_HEIGHT_M - _CUP_GRIP_Z_M
    wall = turned_profile([(0.85 * _CUP_RADIUS_M, low), (_CUP_RADIUS_M, low + 0.01), (_CUP_RADIUS_M, high)], sides=14)
    handle = arch((-_CUP_RADIUS_M + 0.002, 0.0, -0.004), radius=0.018, thickness=0.0045)
    return merge([wall, handle])


def cup_inside() -> Mesh:
    """The dark hole, a disc just above the rim's height."""
    high = _CUP_HEIGHT_M - _CUP_GRIP_Z_M
    return turned_profile([(0.74 * _CUP_RADIUS_M, high), (0.74 * _CUP_RADIUS_M, high + 0.0006)], sides=12)


def add_objects(spec: mujoco.MjSpec) -> None:
    """Add bodies ``ball``, ``car`` and ``cup`` on their places, with free joints ``<name>_joint``."""
    for name, rgba in _RGBA.items():
        spec.add_material(name=name, rgba=rgba, specular=0.2, shininess=0.3)
    ball, car, cup = (_body(spec, index) for index in range(len(OBJECTS)))
    kind = mujoco.mjtGeom
    ball.add_geom(
        name="ball_skin",
        type=kind.mjGEOM_SPHERE,
        size=(_BALL_RADIUS_M, 0, 0),
        mass=_MASS_KG,
        material="ball",
        group=c.SCENE_GROUP,
        condim=6,
        friction=(0.8, 0.005, 0.002),
    )

    body_z = _CAR_CLEARANCE_M + _CAR_HALF_M[2] - _CAR_GRIP_Z_M
    car.add_geom(
        name="car_box", type=kind.mjGEOM_BOX, size=_CAR_HALF_M, pos=(0, 0, body_z), mass=0.8 * _MASS_KG, **_TOUCH
    )
    _add_supports(car, "car_wheel", _WHEEL_M, (0.021, 0.014, _WHEEL_M - _CAR_GRIP_Z_M))
    add_drawn_mesh(spec, car, "car_skin", car_body(), material="car")
    add_drawn_mesh(spec, car, "car_trim", car_trim(), material="car_dark")

    half_m = (_CUP_HEIGHT_M - _CUP_FOOT_M) / 2
    middle_z = _CUP_FOOT_M + half_m - _CUP_GRIP_Z_M
    cup.add_geom(
        name="cup_wall",
        type=kind.mjGEOM_CYLINDER,
        size=(_CUP_RADIUS_M, half_m, 0),
        pos=(0, 0, middle_z),
        mass=0.8 * _MASS_KG,
        **_TOUCH,
    )
    _add_supports(cup, "cup_foot", _CUP_FOOT_M, (0.014, 0.014, _CUP_FOOT_M - _CUP_GRIP_Z_M))
    add_drawn_mesh(spec, cup, "cup_skin", cup_body(), material="cup")
    add_drawn_mesh(spec, cup, "cup_hole", cup_inside(), material="cup_inside")


def _body(spec: mujoco.MjSpec, index: int) -> mujoco.MjsBody:
    body = spec.worldbody.add_body(name=OBJECTS[index].name, pos=standing_m(index))
    body.add_freejoint(name=f"{OBJECTS[index].name}_joint")
    return body


def _add_supports(body: mujoco.MjsBody, name: str, radius_m: float, corner_m: c.Point) -> None:
    """Four spheres to stand on, at the corners of a rectangle about the body's z axis."""
    x_m, y_m, z_m = corner_m
    for number, (x_sign, y_sign) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
        body.add_geom(
            name=f"{name}_{number}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(radius_m, 0, 0),
            pos=(x_sign * x_m, y_sign * y_m, z_m),
            mass=0.05 * _MASS_KG,
            **_TOUCH,
        )
