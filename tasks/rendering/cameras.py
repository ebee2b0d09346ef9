"""The views of every scene: what agents see, and what people do."""

from __future__ import annotations

import mujoco

from ..scenes.constants import AGENT_CAMERA, ARM_GROUP, SCENE_GROUP, SETTING_GROUP
from .renderer import Renderer, View

FRAME_PX = 64
DRAWN_GROUPS = (SCENE_GROUP, ARM_GROUP, SETTING_GROUP)


def agent_camera(model: mujoco.MjModel, size_px: int = FRAME_PX) -> Renderer:
    """The agent's view of a model: no arm, hard edges, no shadows."""
    return Renderer(model, View(camera=AGENT_CAMERA, width=size_px, height=size_px, groups=(SCENE_GROUP,)))


def human_camera_view(camera: str, width: int, height: int) -> View:
    """A view for people: everything in it, soft edges, shadows and sky."""
    quality = {"shadow_px": 2048, "samples": 4, "slices": 28}
    return View(camera=camera, width=width, height=height, groups=DRAWN_GROUPS, sky=True, **quality)
