"""Which OpenGL platform to draw with, chosen before MuJoCo is first imported. Imports nothing heavy."""

from __future__ import annotations

import os
import sys


def choose_platform() -> None:
    """Choose headless EGL where Linux has no display, unless the user chose already.

    Software GL draws on the calling thread: 64x64 pixels gain nothing from more, and threads do not survive a fork.
    """
    if sys.platform != "linux":
        return
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not display and not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = "egl"
    os.environ.setdefault("LP_NUM_THREADS", "0")
