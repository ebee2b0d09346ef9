"""Meta-World's pick-place-v3; images by ``render``, 64×64. Its own rate is 80 Hz; 16 physics steps make it 25."""

from __future__ import annotations

import gymnasium
import metaworld  # noqa: F401  it registers its environments
import numpy as np
from loop import IMAGE_PX, RATE_HZ, Images, Lane, run, without_effects

CAMERAS = {"wrist": "gripperPOV", "front": "corner2"}


def make(images: Images) -> Lane:
    """One environment of one task, as its pages make it."""
    drawn = {"render_mode": "rgb_array", "width": IMAGE_PX, "height": IMAGE_PX} if images.count else {}
    env = gymnasium.make("Meta-World/MT1", env_name="pick-place-v3", seed=0, disable_env_checker=True, **drawn)
    inner = env.unwrapped
    own_hz = 1.0 / inner.dt
    inner.frame_skip = round(1.0 / (RATE_HZ * inner.model.opt.timestep))
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
    return Lane(env.reset, step, space.low, space.high, inner.model, inner.frame_skip, own_hz)


if __name__ == "__main__":
    run(make)
