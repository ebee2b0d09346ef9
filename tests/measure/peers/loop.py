"""The measured loop of every worker: random actions in one environment, and the CPU seconds that they cost.

It runs in the Python of each suite, so it imports the standard library and NumPy alone. A worker is called as
``python WORKER.py MODE IMAGES NUMBER`` and prints one line of JSON:

- ``steps IMAGES S``: CPU seconds of making, of a reset and of a step, over ``S`` CPU seconds of steps.
- ``memory IMAGES N``: memory of one lane, and how much each of ``N`` more adds.
- ``wall IMAGES S``: waits for a line on its standard input, then counts steps for ``S`` seconds of wall time, with the
  resets between them.

IMAGES is ``none``, ``wrist``, ``front``, ``both``, or one of them and ``-plain``: drawn without shadows, mirrors and
antialiasing.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

IMAGE_PX = 64
RATE_HZ = 25.0
RESETS = 10
"""At least so many are timed, without images."""


@dataclass
class Images:
    """Which images a step draws."""

    wrist: bool = False
    front: bool = False
    plain: bool = False

    @classmethod
    def of(cls, name: str) -> Images:
        """The images that an argument names."""
        which, _, plain = name.partition("-")
        return cls(which in {"wrist", "both"}, which in {"front", "both"}, plain == "plain")

    @property
    def count(self) -> int:
        """How many."""
        return self.wrist + self.front


@dataclass
class Lane:
    """One environment, or several at once, in the manner of its own suite."""

    reset: Callable[[], object]
    step: Callable[[np.ndarray], tuple[bool, list[np.ndarray]]]  #: whether the episode is over, and the images
    low: np.ndarray
    high: np.ndarray
    model: mujoco.MjModel
    physics_steps: int  #: in a step of control
    own_rate_hz: float = RATE_HZ  #: the rate of commands that the suite has by itself
    lanes: int = 1  #: environments that a step moves, each of which counts


Make = Callable[[Images], Lane]


def without_effects(model: mujoco.MjModel) -> None:
    """Switch shadows, mirrors and antialiasing off; to be called before a renderer is made for this model."""
    model.light_castshadow[:] = 0
    model.mat_reflectance[:] = 0
    model.vis.quality.shadowsize = 0
    model.vis.quality.offsamples = 0


def warm(lane: Lane) -> np.ndarray:
    """Reset a lane and step it a few times; returns the actions."""
    lane.reset()
    actions = actions_of(lane)
    for action in actions[:5]:
        lane.step(action)
    return actions


def actions_of(lane: Lane) -> np.ndarray:
    """Random actions, drawn before anything is timed. Shape (256, A)."""
    rng = np.random.default_rng(0)
    return rng.uniform(lane.low, lane.high, size=(256, len(lane.low)))


def check(lane: Lane, images: Images) -> None:
    """One step; fails if an image has another size or shows nothing."""
    _, drawn = lane.step(actions_of(lane)[0])
    if len(drawn) != images.count:
        raise ValueError(f"{images.count} images were asked for, and {len(drawn)} drawn")
    for image in drawn:
        if image.shape != (IMAGE_PX, IMAGE_PX, 3) or image.dtype != np.uint8 or image.std() < 1.0:
            raise ValueError(f"an image of shape {image.shape}, {image.dtype}, deviation {image.std():.1f}")


def steps(make: Make, images: Images, seconds: float) -> dict[str, str | float]:
    """CPU seconds of making with the first reset, of a step and of a reset; resets are not part of steps."""
    start = time.process_time()
    lane = make(images)
    lane.reset()
    made_s = time.process_time() - start
    check(lane, images)
    actions = warm(lane)
    step_s = reset_s = 0.0
    n_steps = n_resets = 0
    while step_s < seconds:
        before = time.process_time()
        over, _ = lane.step(actions[n_steps % len(actions)])
        step_s += time.process_time() - before
        n_steps += 1
        if over:
            reset_s += timed_reset(lane)
            n_resets += 1
    while not images.count and n_resets < RESETS:
        reset_s += timed_reset(lane)
        n_resets += 1
    period_s = lane.physics_steps * lane.model.opt.timestep
    return {
        "made_s": made_s,
        "step_s": step_s / n_steps / lane.lanes,
        "reset_s": reset_s / max(n_resets, 1) / lane.lanes,
        "mujoco": mujoco.__version__,
        "control_hz": 1.0 / period_s,
        "physics_steps": lane.physics_steps,
        "physics_step_ms": 1e3 * lane.model.opt.timestep,
        "own_rate_hz": lane.own_rate_hz,
    }


def timed_reset(lane: Lane) -> float:
    """CPU seconds of a reset."""
    before = time.process_time()
    lane.reset()
    return time.process_time() - before


def resident_mib() -> float:
    """Memory of this process, shared libraries included."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def memory(make: Make, images: Images, lanes: int) -> dict[str, float]:
    """Memory of a process with one lane, and the growth by each of so many more, all used."""
    kept = []
    for count in range(lanes + 1):
        lane = make(images)
        warm(lane)
        kept.append(lane)
        if count == 0:
            first_mib = resident_mib()
    return {"one_mib": first_mib, "more_mib": (resident_mib() - first_mib) / lanes / lane.lanes}


def wall(make: Make, images: Images, seconds: float) -> dict[str, float]:
    """Steps, with the resets between them, from a signal on standard input on; so two processes start at once."""
    lane = make(images)
    actions = warm(lane)
    print("ready", flush=True)
    sys.stdin.readline()
    n_steps = 0
    start = time.perf_counter()
    cpu_before = time.process_time()
    while time.perf_counter() - start < seconds:
        over, _ = lane.step(actions[n_steps % len(actions)])
        n_steps += 1
        if over:
            lane.reset()
    return {
        "steps": n_steps * lane.lanes,
        "wall_s": time.perf_counter() - start,
        "cpu_s": time.process_time() - cpu_before,
    }


def run(make: Make) -> None:
    """Measure as the arguments say, and print it."""
    mode, images, number = sys.argv[1:4]
    modes = {
        "steps": lambda: steps(make, Images.of(images), float(number)),
        "memory": lambda: memory(make, Images.of(images), int(number)),
        "wall": lambda: wall(make, Images.of(images), float(number)),
    }
    print(json.dumps(modes[mode]()))
