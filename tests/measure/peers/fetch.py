"""Gymnasium-Robotics' FetchPickAndPlace, as its pages make it; images by ``render``, 64×64."""

from __future__ import annotations

import gymnasium
import gymnasium_robotics
import numpy as np
from loop import IMAGE_PX, Images, Lane, run, without_effects

gymnasium.register_envs(gymnasium_robotics)
CAMERAS = {"wrist": "gripper_camera_rgb", "front": "external_camera_0"}


def make(images: Images) -> Lane:
    """One environment. It has 25 Hz, so nothing is changed."""
    drawn = {"render_mode": "rgb_array", "width": IMAGE_PX, "height": IMAGE_PX} if images.count else {}
    env = gymnasium.make("FetchPickAndPlace-v4", disable_env_checker=True, **drawn)
    inner = env.unwrapped
    if images.plain:
        without_effects(inner.model)
    names = [name for kind, name in CAMERAS.items() if getattr(images, kind)]
    cameras = [inner.model.camera(name).id for name in names]

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        _, _, terminated, truncated, _ = env.step(action)
        frames = []
        for camera in cameras:
            inner.mujoco_renderer.camera_id = camera
            frames.append(env.render())
        return terminated or truncated, frames

    space = env.action_space
    return Lane(env.reset, step, space.low, space.high, inner.model, inner.n_substeps)


if __name__ == "__main__":
    run(make)
