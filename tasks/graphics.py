"""Which OpenGL platform to draw with, chosen before MuJoCo is first imported. Imports nothing heavy."""

from __future__ import annotations

import ctypes.util
import os
import sys

from imagine_bench.errors import SetupError

PLATFORMS = ("egl", "glfw", "osmesa")
_ALSO = {"", "glx", *("disable", "disabled", "off", "false", "0"), *("enable", "enabled", "on", "true", "1")}
"""What MuJoCo takes too: drawing switched off, which the first image then says, or left to it."""


def choose_platform() -> None:
    """Choose headless EGL on Linux, unless the user chose already.

    With a display too: a window system's connection survives neither a fork nor a second thread. Software GL draws on
    the calling thread: 64x64 pixels gain nothing from more, and threads do not survive a fork.

    Raises:
        SetupError: ``MUJOCO_GL`` names no platform, or one whose library is missing.
    """
    if sys.platform != "linux":
        return
    chosen = os.environ.get("MUJOCO_GL", "").strip()
    if chosen.lower() not in {*PLATFORMS, *_ALSO}:
        raise SetupError(f"MUJOCO_GL is {chosen!r}; unset it, or give one of {', '.join(PLATFORMS)}.")
    if chosen.lower() == "osmesa" and ctypes.util.find_library("OSMesa") is None:
        raise SetupError("MUJOCO_GL is 'osmesa', but libOSMesa is not installed; install it or unset MUJOCO_GL.")
    os.environ["MUJOCO_GL"] = chosen or "egl"
    os.environ.setdefault("LP_NUM_THREADS", "0")
