"""``make speed``: how fast this suite is, as ratios to plain code that is timed in the same run.

Ratios are judged, for they hold on slow and on fast machines; absolute figures are printed beside the machine's name.
CPU time is quoted wherever wall time would measure the neighbours on a shared machine. Fidelity to the rules is
measured by ``imagine-bench check TASK --physics``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import timeit
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

import control_speed
import gymnasium
import mujoco
import numpy as np
import plain_torch
from imagine_bench.tasks.rendering.cameras import agent_camera_view
from plain_torch import least_cpu_s

from imagine_bench import registry
from imagine_bench.errors import SetupError
from imagine_bench.interfaces import TaskSpec
from imagine_bench.registry.machine import describe_environment, gl_renderer
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import require_writable, write_json
from imagine_bench.testing.physics import HEAD, Figure, figure_of

OUT = Path("runs/speed.json")
TASKS = ("arrow_puzzle", "pick_place")
"""One task of each scene."""
LANES = (1, 4, 16, 64)
_OURS = """
import json, resource, sys, time
start = time.process_time()
import gymnasium, imagine_bench
imported_s = time.process_time() - start
env = gymnasium.make(sys.argv[1])
env.reset(seed=0)
reset_s = time.process_time() - start
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for seed in range(int(sys.argv[3])): env.reset(seed=seed)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps([imported_s, reset_s, before, after]))
"""
_PLAIN = """
import json, resource, sys, time
start = time.process_time()
import gymnasium
imported_s = time.process_time() - start
import mujoco
model = mujoco.MjModel.from_binary_path(sys.argv[2])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 64, 64)
renderer.update_scene(data)
renderer.render()
reset_s = time.process_time() - start
print(json.dumps([imported_s, reset_s, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0]))
"""
"""An expert's script: the compiled scene, and one frame of it."""


def measure() -> Iterator[Figure]:
    """Measure everything, cheapest first."""
    yield from fresh_interpreters(TASKS[0])
    yield from torch_ratios()
    for task in TASKS:
        yield from drawing(registry.task(task))
        yield from physics(registry.task(task))
        yield from vector(registry.task(task))
    yield from control_steps(3)


def fresh_interpreters(task: str) -> Iterator[Figure]:
    """Import, first reset and memory in a fresh process, beside an expert's script that draws the same scene."""
    env_id = registry.task_entry(task).env_id
    env = gymnasium.make(env_id)
    with tempfile.TemporaryDirectory() as folder:
        scene = str(Path(folder) / "scene.mjb")
        mujoco.mj_saveModel(env.unwrapped.model, scene)
        ours = [_child(_OURS, env_id, scene, "0") for _ in range(3)]
        plain = [_child(_PLAIN, env_id, scene) for _ in range(3)]
    grown = _child(_OURS, env_id, "", "2000")
    env.close()
    imported_s, reset_s, rss, _ = np.min(ours, axis=0)
    plain_imported_s, plain_reset_s, plain_rss, _ = np.min(plain, axis=0)
    yield _ratio("import imagine_bench, times import gymnasium", imported_s, plain_imported_s, "<=", 2.5, "s")
    yield _ratio("import, make, first reset, times an expert's script", reset_s, plain_reset_s, "<=", 2.5, "s")
    unit = 1.0 if sys.platform == "darwin" else 1024.0  # getrusage counts bytes on macOS, KiB on Linux
    mib = unit / 2**20
    yield _ratio("memory of one environment, times that of the script", mib * rss, mib * plain_rss, "<=", 1.5, "MiB")
    growth = grown[3] / grown[2] - 1.0
    yield figure_of("growth of its memory over 2,000 resets", growth, ".1%", "<=", 0.02)


def _child(code: str, *arguments: str) -> list[float]:
    """The numbers that ``code`` prints in a fresh interpreter."""
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SetupError(f"A fresh interpreter could not be measured: {done.stderr.strip().splitlines()[-1]}")
    numbers: list[float] = json.loads(done.stdout.splitlines()[-1])
    return numbers


def torch_ratios() -> Iterator[Figure]:
    """Batched code of the agents against a loop, and the world model's update against plain torch."""
    found = plain_torch.training(10, 250, 3, 4)
    what = "training 10 networks of chapter 4 as one batch, times as fast as in turn"
    yield figure_of(what, found["plain"] / found["ours"], ".2f", ">=", 1.2)
    for hyperparameters, least in (("published", 1.2), ("fast", 0.9)):
        found = plain_torch.model_update(hyperparameters)
        what = f"a model update ({hyperparameters} settings), times as fast as plain torch"
        more = f" ({1e3 * found['ours']:.1f} against {1e3 * found['plain']:.1f} CPU ms)"
        yield figure_of(what, found["plain"] / found["ours"], ".2f", ">=", least, more)


def drawing(spec: TaskSpec) -> Iterator[Figure]:
    """A frame, and a kinematic macro-action with its frame, beside MuJoCo's drawing of the same scene alone."""
    env = gymnasium.make(spec.env_id, execution="kinematic")
    env.reset(seed=0)
    scene = env.unwrapped
    scene.agent_view()
    actions = SeedTree(0).child("speed", "kinematic").generator().integers(spec.n_actions, size=300).tolist()

    draw = _mjr_alone(scene)
    timed = {
        "alone": lambda: [draw() for _ in actions],
        "a frame": lambda: [scene.agent_view() for _ in actions],
        "a kinematic macro-action with frame": lambda: walked(env, actions, to_the_limit=True),
    }
    least = least_cpu_s(timed, 9)
    env.close()
    alone_ms, *ours_ms = (1e3 * seconds / len(actions) for seconds in least.values())
    for what, each_ms, target in zip(list(timed)[1:], ours_ms, (1.8, 4.0), strict=True):
        yield _ratio(f"{spec.id}: {what}, times MuJoCo's drawing alone", each_ms, alone_ms, "<=", target, "CPU ms")


def walked(env: gymnasium.Env, actions: Sequence[int], *, to_the_limit: bool = False) -> float:
    """Act, with a reset at each end, or at time limits alone; the mean simulated seconds of a macro-action."""
    simulated_s = []
    for action in actions:
        *_, terminated, truncated, info = env.step(action)
        simulated_s.append(float(info["sim_time_s"]))
        if truncated or (terminated and not to_the_limit):
            env.reset()
    return float(np.mean(simulated_s))


def _mjr_alone(scene: gymnasium.Env) -> Callable[[], object]:
    """MuJoCo's drawing and reading of the pixels of the latest frame, with nothing of this suite around it."""
    camera = scene.camera(agent_camera_view())
    pixels = np.empty((camera.view.height, camera.view.width, 3), dtype=np.uint8)
    rect = mujoco.MjrRect(0, 0, camera.view.width, camera.view.height)

    def draw() -> None:
        mujoco.mjr_render(rect, camera.scene, camera.canvas.mjr)
        mujoco.mjr_readPixels(pixels, None, rect, camera.canvas.mjr)

    return draw


def physics(spec: TaskSpec) -> Iterator[Figure]:
    """A macro-action with planning, contact physics and frame, beside ``mj_step`` alone for as much simulated time."""
    env = gymnasium.make(spec.env_id)
    env.reset(seed=0)
    model = env.unwrapped.model
    data = mujoco.MjData(model)
    rng = SeedTree(0).child("speed", "physics").generator()
    simulated_s = []

    def steps() -> None:
        simulated_s.append(walked(env, rng.integers(spec.n_actions, size=25).tolist()))

    steps()  # warms up
    least = least_cpu_s({"steps": steps, "mj_step": lambda: [mujoco.mj_step(model, data) for _ in range(2_000)]}, 5)
    env.close()
    alone_s = least["mj_step"] / 2_000 * float(np.mean(simulated_s[1:])) / model.opt.timestep
    what = f"{spec.id}: a macro-action in physics, times mj_step alone for as long"
    yield _ratio(what, 1e3 * least["steps"] / 25, 1e3 * alone_s, "<=", 3.0, "CPU ms")


def vector(spec: TaskSpec) -> Iterator[Figure]:
    """Lanes beside one environment, by wall time; in physics the gain is judged beside that of plain threads."""
    for execution, turns in (("physics", 64), ("kinematic", 1024)):
        gains = {lanes: lanes_gain(spec, execution, lanes, turns, blocks=3) for lanes in LANES}
        curve = ", ".join(f"{gain:.2f} at {lanes}" for lanes, (gain, _) in gains.items())
        gain, threads_gain = gains[LANES[2]]
        what = f"{spec.id}: gain of {LANES[2]} lanes over one environment, {execution}"
        if execution == "kinematic":  # all lanes are drawn by one context
            yield figure_of(what, gain, ".2f", ">=", 0.9, f" ({curve})")
        else:
            more = f" ({curve}; threads {threads_gain:.2f})"
            yield figure_of(f"{what}, share of two threads' gain", gain / threads_gain, ".2f", ">=", 0.6, more)


def control_steps(rounds: int) -> Iterator[Figure]:
    """A step of continuous control beside MuJoCo alone for the same physics steps and images."""
    processes = control_speed.Processes(Path.cwd(), core=0)
    for key in control_speed.OURS:
        suite = control_speed.SUITES[key]
        for images in suite.images():
            measured = [{key: processes.beside_mujoco(suite, images, 0.5)} for _ in range(rounds)]
            yield control_speed.beside_mujoco(measured, key, images)


def lanes_gain(spec: TaskSpec, execution: str, lanes: int, turns: int, *, blocks: int) -> tuple[float, float]:
    """How many times as fast as one environment so many lanes are, at random actions, and two threads as one.

    Args:
        spec: The task.
        execution: ``"physics"`` or ``"kinematic"``.
        lanes: Of the vector environment.
        turns: Macro-actions of a block, at least.
        blocks: Rounds of all four blocks in turn; the medians of their ratios are returned.
    """
    one = gymnasium.make(spec.env_id, execution=execution)
    many = gymnasium.make_vec(registry.vector_id(spec.env_id), num_envs=lanes, execution=execution)
    rng = SeedTree(0).child("speed", "lanes").generator()
    rounds = -(-turns // lanes)
    data = bytes(50_000_000)
    one.reset(seed=0)
    many.reset(seed=0)

    def alone() -> None:
        walked(one, rng.integers(spec.n_actions, size=rounds * lanes).tolist())

    def together() -> None:
        for _ in range(rounds):
            many.step(rng.integers(spec.n_actions, size=lanes))

    together()  # warms up
    gains = []
    with ThreadPoolExecutor(2) as pool:
        for _ in range(blocks):
            gain = timeit.timeit(alone, number=1) / timeit.timeit(together, number=1)
            in_turn_s = timeit.timeit(lambda: [sha256(data) for _ in range(4)], number=1)
            at_once_s = timeit.timeit(lambda: list(pool.map(sha256, [data] * 4)), number=1)
            gains.append((gain, in_turn_s / at_once_s))
    one.close()
    many.close()
    gain, threads_gain = np.median(gains, axis=0)
    return float(gain), float(threads_gain)


def _ratio(what: str, ours: float, plain: float, sign: str, target: float, unit: str) -> Figure:
    """A ratio that is judged, with both absolute values behind it."""
    return figure_of(what, ours / plain, ".2f", sign, target, f" ({ours:.3g} against {plain:.3g} {unit})")


def main(out: Path = OUT) -> int:
    """Measure, print a Markdown table line by line, keep the figures in ``out``; 1 if a target is missed."""
    require_writable(out.parent)
    gl_renderer()  # fails here, in one sentence, rather than in a child
    facts = describe_environment()
    print(f"{facts['machine']['cpu']}, {facts['machine']['cores']} cores, {facts['gl_renderer']}\n\n{HEAD}")
    figures = []
    for figure in measure():
        figures.append(figure)
        print(figure.row, flush=True)
    write_json(out, {"environment": facts, "figures": [asdict(figure) for figure in figures]})
    return int(not all(figure.met for figure in figures))


if __name__ == "__main__":
    sys.exit(main())
