"""imagine_bench's continuous control: ``python ours.py MODE IMAGES NUMBER [ID]``, with one mode more.

``own IMAGES S``: CPU seconds of a step, and beside it those of MuJoCo alone: ``mj_step`` for as many physics steps from
the same states with the same commands, and drawing the same images.
"""

from __future__ import annotations

import itertools
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
TIMES = 3
"""Each step is timed so often."""
LANES = 8
"""Of the vector environment."""
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
    """One environment in its loop, or the vector environment of an id that names one."""
    return vector(images) if "-vector-" in ID else lane_of(environment(images), images)


def vector(images: Images) -> Lane:
    """Eight lanes in their loop, with the same actions in each; it resets those that are over within a step."""
    envs = gymnasium.make_vec(ID, num_envs=LANES, **options_of(images))
    cameras = cameras_of(images)

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        seen, *_ = envs.step(np.tile(action, (LANES, 1)))
        return False, [seen[name][0] for name in cameras]

    space = envs.single_action_space
    model = envs.envs[0].model
    n_steps = round(envs.envs[0].period_s / model.opt.timestep)
    return Lane(envs.reset, step, space.low, space.high, model, n_steps, RATE_HZ, LANES)


def lane_of(env: gymnasium.Env, images: Images) -> Lane:
    """An environment in its loop."""
    cameras = cameras_of(images)

    def step(action: np.ndarray) -> tuple[bool, list[np.ndarray]]:
        seen, _, terminated, truncated, _ = env.step(action)
        return terminated or truncated, [seen[name] for name in cameras]

    space = env.action_space
    model = env.unwrapped.model
    n_steps = round(env.unwrapped.period_s / model.opt.timestep)
    return Lane(env.reset, step, space.low, space.high, model, n_steps, RATE_HZ)


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
        context = camera.canvas.mjr
        camera.canvas.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        start = time.process_time()
        mujoco.mjv_updateScene(self._model, self._data, camera.option, None, camera.camera, every, camera.scene)
        mujoco.mjr_render(self._rect, camera.scene, context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, context)
        return time.process_time() - start


def own(images: Images, seconds: float) -> dict[str, float]:
    """CPU seconds of a step, and of MuJoCo alone; blocks of steps are measured for so many CPU seconds.

    The steps of a block are taken three times from one state, which leads to the same bits; then MuJoCo simulates and
    draws alone from each moment between them, three times. The least of three counts for each step, since noise only
    adds.
    """
    env = environment(images)
    scene = env.unwrapped
    lane = lane_of(env, images)
    lane.reset()
    lane.step(actions_of(lane)[0])
    alone = MujocoAlone(env, lane, images)
    blocks = itertools.cycle(np.split(actions_of(lane), 4))
    begun_s = time.process_time()
    times = []
    while len(times) < 2 or time.process_time() - begun_s < seconds:
        block = next(blocks)
        begun = scene.get_state()
        taken_s = []
        for _ in range(TIMES):
            scene.set_state(begun)
            taken_s.append([timed_step(lane, action) for action in block])
        scene.set_state(begun)
        moments = []
        for action in block:
            before = scene.world.get_state()
            timed_step(lane, action)
            moments.append((before, scene.data.ctrl.copy()))
        again = [[alone.again(*moment) for moment in moments] for _ in range(TIMES)]
        times.append([np.min(taken_s, axis=0).mean(), *np.min(again, axis=0).mean(axis=0)])
    step_s, simulated_s, drawn_s = np.mean(times[1:], axis=0).tolist()
    return {"step_s": step_s, "mj_step_s": simulated_s, "mjr_s": drawn_s}


def timed_step(lane: Lane, action: np.ndarray) -> float:
    """CPU seconds of a step, without the reset where an episode is over."""
    start = time.process_time()
    over, _ = lane.step(action)
    taken_s = time.process_time() - start
    if over:
        lane.reset()
    return taken_s


if __name__ == "__main__":
    if sys.argv[1] == "own":
        print(json.dumps(own(Images.of(sys.argv[2]), float(sys.argv[3]))))
    else:
        run(make)
