"""OGBench's cube-single, from state and from pixels, at 25 Hz; its own rate is 20. No camera at the wrist."""

from __future__ import annotations

import gymnasium
import numpy as np
import ogbench  # noqa: F401  it registers its environments
from loop import RATE_HZ, Images, Lane, run, without_effects


def make(images: Images) -> Lane:
    """One environment, as its pages make it: ``cube-single-v0``, or ``visual-cube-single-v0`` with one image."""
    name = "visual-cube-single-v0" if images.count else "cube-single-v0"
    env = gymnasium.make(name, control_timestep=1.0 / RATE_HZ, disable_env_checker=True)
    env.reset(seed=0)
    inner = env.unwrapped
    if images.plain:
        without_effects(inner.model)
        inner._renderer.close()
        inner._renderer = None  # it is made anew at the next image

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        seen, _, terminated, truncated, _ = env.step(action)
        frames = [seen] if images.count else []
        if images.count == 2:
            frames.append(inner.render(camera="front"))
        return terminated or truncated, frames

    space = env.action_space
    n_steps = round(inner.control_timestep() / inner.physics_timestep())
    return Lane(env.reset, step, space.low, space.high, inner.model, n_steps, 20.0)


if __name__ == "__main__":
    run(make)
