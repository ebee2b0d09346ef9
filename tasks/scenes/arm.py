"""The Sawyer arm and its gripper, to be composed or compiled alone, and the facts about it that MJCF cannot hold."""

from __future__ import annotations

from importlib import resources

import mujoco

ARM_JOINTS = tuple(f"right_j{index}" for index in range(7))
"""From the base to the wrist."""

FINGER_JOINTS = ("finger_left_slide", "finger_right_slide")
"""Slides in metres: each pad's distance from the grip's middle, 0 (closed) to 0.045."""

TCP_SITE = "tcp"
"""Between the pads: +z along the tool, the fingers open along y."""

JOINT_SPEED_LIMITS_RAD_S = (1.74, 1.328, 1.957, 1.957, 3.485, 3.485, 4.545)
"""Per arm joint, from the same URDF as ``assets/sawyer.xml``."""


def arm_spec() -> mujoco.MjSpec:
    """A new specification of the arm, its base at the origin; add a scene to it or compile it alone."""
    return mujoco.MjSpec.from_string(resources.files("imagine_bench.assets").joinpath("sawyer.xml").read_text())
