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
from imagine_bench.tasks.rendering import Renderer
from imagine_bench.tasks.rendering.cameras import control_view
from imagine_bench.tasks.world import WorldState
from loop import IMAGE_PX, RATE_HZ, Images, Lane, actions_of, run

import imagine_bench  # noqa: F401  it registers its environments

ID = sys.argv[4] if len(sys.argv) > 4 else "imagine_bench/ArrowPuzzleMotion-v0"
BLOCK = 64
"""Steps that are timed together."""
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
    """MuJoCo's own functions on a scene like that of an environment, with nothing of this suite around them."""

    def __init__(self, env: gymnasium.Env, lane: Lane, images: Images) -> None:
        self._world = env.unwrapped.another_world()
        self._model = self._world.model
        self._data = self._world.data
        self._n_steps = lane.physics_steps
        self._cameras = [env.unwrapped.camera(control_view(name, IMAGE_PX)) for name in cameras_of(images)]
        self._pixels = np.empty((IMAGE_PX, IMAGE_PX, 3), dtype=np.uint8)
        self._rect = mujoco.MjrRect(0, 0, IMAGE_PX, IMAGE_PX)

    def again(self, before: WorldState, commands: np.ndarray) -> tuple[float, float]:
        """CPU seconds of ``mj_step`` from a moment on with the commands of the next, and of drawing the images.

        Bodies that slept then sleep: they cost nothing.
        """
        self._world.set_state(before)
        self._data.ctrl[:] = commands
        start = time.process_time()
        mujoco.mj_step(self._model, self._data, self._n_steps)
        simulated_s = time.process_time() - start
        return simulated_s, sum(self._draw(camera) for camera in self._cameras)

    def _draw(self, camera: Renderer) -> float:
        """CPU seconds of ``mjv_updateScene``, ``mjr_render`` and ``mjr_readPixels``."""
        context = camera._canvas.mjr
        camera._canvas.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        start = time.process_time()
        mujoco.mjv_updateScene(self._model, self._data, camera._option, None, camera._camera, every, camera._scene)
        mujoco.mjr_render(self._rect, camera._scene, context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, context)
        return time.process_time() - start


def own(images: Images, seconds: float) -> dict[str, float]:
    """CPU seconds of a step, and of MuJoCo alone.

    A block of steps is timed, then taken again from the same state, which leads to the same bits, to keep the moments
    between them; from these MuJoCo simulates and draws alone.
    """
    env = environment(images)
    scene = env.unwrapped
    lane = lane_of(env, images)
    lane.reset()
    lane.step(actions_of(lane)[0])
    alone = MujocoAlone(env, lane, images)
    times = []
    while len(times) < 2 or sum(each[0] for each in times[1:]) * BLOCK < seconds:
        block = actions_of(lane)[len(times) * BLOCK % 256 :][:BLOCK]
        begun = scene.get_state()
        taken_s = 0.0
        for action in block:
            start = time.process_time()
            over, _ = lane.step(action)
            taken_s += time.process_time() - start
            if over:
                lane.reset()
        scene.set_state(begun)
        moments = []
        for action in block:
            before = scene.world.get_state()
            over, _ = lane.step(action)
            moments.append((before, scene.data.ctrl.copy()))
            if over:
                lane.reset()
        found = np.mean([alone.again(*moment) for moment in moments], axis=0)
        times.append([taken_s / BLOCK, *found])
    step_s, simulated_s, drawn_s = np.mean(times[1:], axis=0).tolist()
    return {"step_s": step_s, "mj_step_s": simulated_s, "mjr_s": drawn_s}


if __name__ == "__main__":
    if sys.argv[1] == "own":
        print(json.dumps(own(Images.of(sys.argv[2]), float(sys.argv[3]))))
    else:
        run(make)
