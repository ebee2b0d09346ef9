"""robosuite's Lift with a Panda: offscreen renderer only, soft resets, no depth, lite physics; OSC_POSE by default."""

from __future__ import annotations

import numpy as np
import robosuite
from loop import IMAGE_PX, RATE_HZ, Images, Lane, run, without_effects

CAMERAS = {"wrist": "robot0_eye_in_hand", "front": "agentview"}


def make(images: Images) -> Lane:
    """One environment at 25 Hz; its own rate is 20."""
    cameras = [name for kind, name in CAMERAS.items() if getattr(images, kind)]
    env = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=bool(cameras),
        use_camera_obs=bool(cameras),
        camera_names=cameras or ["agentview"],
        camera_heights=IMAGE_PX,
        camera_widths=IMAGE_PX,
        camera_depths=False,
        control_freq=RATE_HZ,
        hard_reset=False,
        render_collision_mesh=True,
        render_visual_mesh=False,
        horizon=500,
        seed=0,
    )
    if images.plain:
        without_effects(env.sim.model._model)
        env.sim._render_context_offscreen._set_mujoco_context_and_buffers()

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        seen, _, done, _ = env.step(action)
        return done, [seen[f"{name}_image"] for name in cameras]

    low, high = env.action_spec
    return Lane(
        env.reset,
        step,
        low,
        high,
        env.sim.model._model,
        round(env.control_timestep / env.model_timestep),
        20.0,
    )


if __name__ == "__main__":
    run(make)
