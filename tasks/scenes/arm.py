"""The Sawyer arm and its gripper, to be composed or compiled alone, and the facts about it that MJCF cannot hold."""

from __future__ import annotations

from importlib import resources
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Floats

ARM_JOINTS = tuple(f"right_j{index}" for index in range(7))
"""From the base to the wrist."""

FINGER_JOINTS = ("finger_left_slide", "finger_right_slide")
"""Slides in metres: each pad's distance from the grip's middle, 0 (closed) to 0.045."""

TIP_IN_NAME = "_tip_"
"""In the names of the geoms that grip: two rubber tips a finger."""

TCP_SITE = "tcp"
"""Between the pads: +z along the tool, the fingers open along y."""

JOINT_SPEED_LIMITS_RAD_S = (1.74, 1.328, 1.957, 1.957, 3.485, 3.485, 4.545)
"""Per arm joint, from the same URDF as ``assets/sawyer.xml``."""


_TOUCHING = ("l4_", "l5_", "l6_", "hand_mount", "hand_rail", "finger_left_back", "finger_right_back")
_GRIPS = 1
_ARM = 2
"""Bits of collision: of fingertips and all that they touch, and of the rest of the arm."""


def let_arm_touch(spec: mujoco.MjSpec) -> None:
    """Let forearm, wrist, hand and the fingers' backs run into whatever the fingertips may touch, at the very end.

    The planner keeps them clear of it, so nothing changes while it does. They do not collide with each other; links
    before the forearm stay over 100 mm above the table, and the pointing hand gives way to everything.
    """
    for geom in spec.geoms:
        if geom.name.startswith(_TOUCHING):
            geom.contype = _ARM
            geom.conaffinity = 0
        elif geom.contype == _GRIPS and TIP_IN_NAME not in geom.name:
            geom.conaffinity = _GRIPS | _ARM


def arm_spec() -> mujoco.MjSpec:
    """A new specification of the arm, its base at the origin; add a scene to it or compile it alone."""
    return mujoco.MjSpec.from_string(resources.files("imagine_bench.assets").joinpath("sawyer.xml").read_text())


class ArmColumns(NamedTuple):
    """Where the seven joints, then the two fingers, are in the arrays of a scene. Shapes (9,)."""

    qpos: NDArray[np.int64]
    qvel: NDArray[np.int64]
    ctrl: NDArray[np.int64]


def arm_columns(model: mujoco.MjModel) -> ArmColumns:
    """The columns of the arm in positions, velocities and controls."""
    joints = [model.joint(name) for name in (*ARM_JOINTS, *FINGER_JOINTS)]
    servos = [model.actuator(f"{joint.name.replace('_slide', '')}_servo") for joint in joints]
    return ArmColumns(
        qpos=np.array([joint.qposadr[0] for joint in joints]),
        qvel=np.array([joint.dofadr[0] for joint in joints]),
        ctrl=np.array([servo.id for servo in servos]),
    )


def tcp_in_world(data: mujoco.MjData, tcp: int) -> Floats:
    """Position (m) and quaternion (w, x, y, z) of a site, the point between the fingers. Shape (7,).

    Kinematics is up to date.
    """
    pose = np.empty(7)
    pose[:3] = data.site_xpos[tcp]
    mujoco.mju_mat2Quat(pose[3:], data.site_xmat[tcp])
    return pose
