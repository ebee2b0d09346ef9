"""imagine_bench's continuous control: ``python ours.py MODE IMAGES NUMBER [ID]``, with one mode more.

``own IMAGES S``: CPU seconds of a step, and beside it those of MuJoCo alone: ``mj_step`` for as many physics steps from
the same states with the same commands, and drawing the same images.
"""

from __future__ import annotations

import json
import sys
import time

import gymnasium
import mujoco
import numpy as np
from imagine_bench.tasks.rendering.cameras import control_view
from loop import IMAGE_PX, RATE_HZ, Images, Lane, actions_of, run

import imagine_bench  # noqa: F401  it registers its environments

ID = sys.argv[4] if len(sys.argv) > 4 else "imagine_bench/ArrowPuzzleMotion-v0"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value
CAMERAS = {"wrist": "hand", "front": "front"}


def cameras_of(images: Images) -> list[str]:
    """Names of the cameras that are drawn."""
    return [camera for kind, camera in CAMERAS.items() if getattr(images, kind)]


def options_of(images: Images) -> dict[str, str | int | float]:
    """Keyword arguments of the environment: the arm's and the objects' numbers, and the images."""
    parts = ["proprio", "objects", *cameras_of(images)]
    return {"observation": ",".join(parts), "size": IMAGE_PX, "rate_hz": RATE_HZ}


def environment(images: Images) -> gymnasium.Env:
    """One environment; its images have no shadows, mirrors or antialiasing anyway."""
    return gymnasium.make(ID, disable_env_checker=True, **options_of(images))


def make(images: Images) -> Lane:
    """One environment in its loop."""
    return lane_of(environment(images), images)


def lane_of(env: gymnasium.Env, images: Images) -> Lane:
    """An environment in its loop."""
    cameras = cameras_of(images)

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        seen, _, terminated, truncated, _ = env.step(action)
        return terminated or truncated, [seen[name] for name in cameras]

    def reset() -> None:
        env.reset()

    space = env.action_space
    model = env.unwrapped.model
    n_steps = round(env.unwrapped.period_s / model.opt.timestep)
    return Lane(reset, step, space.low, space.high, model, n_steps, RATE_HZ)


class MujocoAlone:
    """MuJoCo's own functions on the scene of an environment, with nothing of this suite around them."""

    def __init__(self, env: gymnasium.Env, n_steps: int) -> None:
        self._scene = env.unwrapped
        self._model = self._scene.model
        self._data = mujoco.MjData(self._model)
        self._n_steps = n_steps
        self._before = np.empty(mujoco.mj_stateSize(self._model, STATE))
        self._pixels = np.empty((IMAGE_PX, IMAGE_PX, 3), dtype=np.uint8)
        self._rect = mujoco.MjrRect(0, 0, IMAGE_PX, IMAGE_PX)

    def remember(self) -> None:
        """Keep the state that a step begins with."""
        mujoco.mj_getState(self._model, self._scene.data, self._before, STATE)

    def simulate(self) -> float:
        """CPU seconds of ``mj_step`` from the state kept, with the commands that the step ended with."""
        mujoco.mj_setState(self._model, self._data, self._before, STATE)
        self._data.ctrl[:] = self._scene.data.ctrl
        start = time.process_time()
        mujoco.mj_step(self._model, self._data, self._n_steps)
        return time.process_time() - start

    def draw(self, name: str) -> float:
        """CPU seconds of ``mjv_updateScene``, ``mjr_render`` and ``mjr_readPixels`` for a camera."""
        camera = self._scene.camera(control_view(name, IMAGE_PX))
        context = camera._canvas.mjr
        camera._canvas.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        start = time.process_time()
        mujoco.mjv_updateScene(
            self._model, self._scene.data, camera._option, None, camera._camera, every, camera._scene
        )
        mujoco.mjr_render(self._rect, camera._scene, context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, context)
        return time.process_time() - start


def own(images: Images, seconds: float) -> dict[str, float]:
    """CPU seconds of a step, and of MuJoCo alone for the same physics steps and images, in turn."""
    env = environment(images)
    lane = lane_of(env, images)
    alone = MujocoAlone(env, lane.physics_steps)
    lane.reset()
    actions = actions_of(lane)
    times = []
    while np.sum(times) < seconds:
        alone.remember()
        start = time.process_time()
        over, _ = lane.step(actions[len(times) % len(actions)])
        step_s = time.process_time() - start
        drawn_s = sum(alone.draw(name) for name in cameras_of(images))
        times.append((step_s, alone.simulate(), drawn_s))
        if over:
            lane.reset()
    step_s, simulated_s, drawn_s = np.mean(times[20:], axis=0).tolist()
    return {"step_s": step_s, "mj_step_s": simulated_s, "mjr_s": drawn_s}


if __name__ == "__main__":
    if sys.argv[1] == "own":
        print(json.dumps(own(Images.of(sys.argv[2]), float(sys.argv[3]))))
    else:
        run(make)
