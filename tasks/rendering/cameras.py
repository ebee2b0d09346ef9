"""The views of every scene: those of agents, and those of people."""

from __future__ import annotations

import numpy as np

from imagine_bench.errors import InvalidValueError, brief

from ..scenes.constants import (
    AGENT_CAMERA,
    AGENT_GROUP,
    ARM_GROUP,
    CONTROL_GROUP,
    FRAME_PX,
    SCENE_GROUP,
    SETTING_GROUP,
)
from .renderer import View

MAX_IMAGE_PX = 4096
_SMALL_PX = 256
DRAWN_GROUPS = (SCENE_GROUP, ARM_GROUP, SETTING_GROUP)


def agent_camera_view(size_px: int = FRAME_PX) -> View:
    """The view of agents: no arm, hard edges, no shadows."""
    return View(camera=AGENT_CAMERA, width=size_px, height=size_px, groups=(SCENE_GROUP, AGENT_GROUP))


def control_view(camera: str, size_px: int = FRAME_PX) -> View:
    """The view of agents in continuous control: objects, table, hands and a coarse arm; hard edges, no shadows.

    Args:
        camera: One of :data:`.constants.CONTROL_CAMERAS`, in a scene with :func:`.control_views.add_control_views`.
        size_px: Edge of the square image; from 64 pixels on, arrows can be read.
    """
    groups = (SCENE_GROUP, AGENT_GROUP, CONTROL_GROUP)
    return View(camera=camera, width=size_px, height=size_px, groups=groups)


def human_camera_view(camera: str, width: int, height: int, *, quick: bool = False) -> View:
    """A view for people: everything in it, soft edges, shadows and sky.

    ``quick`` draws coarser shadows and edges, which costs a fifth on a processor; small images are always drawn so.

    Raises:
        InvalidValueError: A width or height out of range.
    """
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or not 1 <= value <= MAX_IMAGE_PX:
            raise InvalidValueError(f"Image {name} {brief(value)} must be an integer from 1 to {MAX_IMAGE_PX} pixels.")
    coarse = quick or max(width, height) <= _SMALL_PX
    return View(
        camera=camera,
        width=int(width),
        height=int(height),
        groups=DRAWN_GROUPS,
        shadow_px=2048 if coarse else 8192,
        samples=4 if coarse else 16,
        slices=28 if coarse else 64,
        for_people=True,
    )
