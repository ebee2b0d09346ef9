"""Which OpenGL platform to draw with, chosen before MuJoCo is first imported. Imports nothing heavy."""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import functools
import importlib.util
import os
import sys
from pathlib import Path

from imagine_bench.errors import SetupError

PLATFORMS = ("egl", "glfw", "osmesa")
_ALSO = {"", "glx", "disable", "disabled", "off", "false", "0", "enable", "enabled", "on", "true", "1"}
"""Values that MuJoCo takes too: drawing switched off, which the first image then says, or left to it."""


def choose_platform() -> None:
    """Choose headless EGL on Linux, unless the user chose already.

    With a display too: a window system's connection survives neither a fork nor a second thread. Software GL draws on
    the calling thread: 64x64 pixels gain nothing from more, and threads do not survive a fork. SDL, which opens
    windows, shall not draw by OpenGL: no thread may draw by EGL and by GLX, and X11 would end the process.

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
    os.environ.setdefault("SDL_FRAMEBUFFER_ACCELERATION", "0")
    _load_triton()


@functools.cache
def _load_triton() -> None:
    """Load the LLVM of triton, which CUDA builds of torch bring, before the one that Mesa draws with.

    Mesa shares its symbols with whatever is loaded later: an optimiser of torch, which imports triton, would end the
    process. Loading takes 0.03 s; it is too late where somebody has drawn before.
    """
    found = importlib.util.find_spec("triton")
    if found is not None and found.origin and "LLVM" not in Path("/proc/self/maps").read_text():
        for library in Path(found.origin).parent.glob("_C/libtriton*.so"):
            with contextlib.suppress(OSError):  # of another platform, or damaged: torch says so where it needs it
                ctypes.CDLL(str(library))
