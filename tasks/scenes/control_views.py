"""What the cameras of continuous control see: the hand's own camera, a front camera, and a coarse arm."""

from __future__ import annotations

import mujoco


def add_control_views(spec: mujoco.MjSpec) -> None:
    """Add the cameras of continuous control to a scene that holds the arm."""
    del spec
