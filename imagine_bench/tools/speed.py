"""``make speed``: every speed and fidelity figure that has a target, measured now, beside the target.

CPU time is quoted wherever wall time would measure the neighbours on a shared machine.
"""

from __future__ import annotations

import json
import operator
import subprocess
import sys
import time
import timeit
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path

import gymnasium
import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.errors import InvalidValueError, SetupError
from imagine_bench.interfaces import APPEARANCES, PerformanceTargets, SceneReader, TaskSpec
from imagine_bench.registry.machine import describe_environment, gl_renderer
from imagine_bench.running.evaluation import EpisodeRecord
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import require_writable, write_json
from imagine_bench.tools.fidelity import Fidelity, measure_fidelity

TURNS = 2_000
"""Macro-actions of each task's fidelity measurement."""
_BATCHES = (1, 4, 16, 64, 256, 1024, 4096)
_BLOCK = 50
"""Macro-actions of one speed reading: noise on a shared machine only ever adds, so the best block is quoted."""
_LANES = (1, 4, 16, 64)
"""Of the vector environment; the third is quoted first."""
_SLIPPED_MM = 5
"""What slips is only squared in the fingers, and less than what counts as pushed."""
_SIGNS = {"<": operator.lt, "<=": operator.le, ">=": operator.ge}
_START_UP = """
import json, sys, time
start = time.perf_counter()
import imagine_bench, gymnasium
imported = time.perf_counter() - start
env = gymnasium.make(sys.argv[1])
env.reset(seed=0)
print(json.dumps({"import": imported, "reset": time.perf_counter() - start}))
"""
_MEMORY = """
import json, sys, gymnasium, imagine_bench
def rss_mb():
    fields = dict(line.split(":", 1) for line in open("/proc/self/status"))
    return int(fields["VmRSS"].split()[0]) / 1024
env = gymnasium.make(sys.argv[1])
env.reset(seed=0); env.step(0)
for i in range(1000): env.reset(seed=i)  # allocators settle
before = rss_mb()
for i in range(2000): env.reset(seed=i)
print(json.dumps({"rss": rss_mb(), "growth": rss_mb() - before}))
"""


_LANES_MEMORY = """
import json, gymnasium, imagine_bench, numpy, sys
from imagine_bench.registry import vector_id
env = gymnasium.make_vec(vector_id(sys.argv[1]), num_envs=64)
env.reset(seed=0)
for action in range(3): env.step(numpy.full(64, action))
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(json.dumps({"rss": int(status["VmRSS"].split()[0]) / 1024}))
"""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured figure: what it is, with its unit; target and figure as text; and whether the target is met."""

    what: str
    required: str
    measured: str
    met: bool


def figure_of(what: str, value: float, sign: str, target: float, form: str, more: str = "") -> Figure:
    """A figure; ``sign`` (``"<"``, ``"<="`` or ``">="``) says how it must stand to its target, ``more`` follows it."""
    required = f"{target:.1%}" if form.endswith("%") else f"{target:,g}"
    met = _SIGNS[sign](value, target)
    return Figure(what=what, required=f"{sign} {required}", measured=f"{value:{form}}{more}", met=met)


def measure(turns: int = TURNS) -> Iterator[Figure]:
    """Measure everything, cheapest first, fidelity with ``turns`` macro-actions a task."""
    yield from _fresh_interpreters()
    yield from _weight_samples()
    yield from _model_updates()
    specs = [registry.task(name) for name in registry.TASKS]
    measured = [(spec, spec.targets) for spec in specs if spec.targets is not None]
    for part in (_kinematic, _encoders, _vector):
        for spec, targets in measured:
            yield from part(spec, targets)
    for spec, targets in measured:
        yield from _physics(spec, targets, turns)


def measure_worlds(worlds: Sequence[str], appearances: Sequence[str], turns: int = TURNS) -> Iterator[Figure]:
    """Fidelity alone, of any worlds whose targets are known, at each appearance.

    Raises:
        InvalidValueError: A world without targets.
        UnknownNameError: An unknown world or appearance.
    """
    specs = [registry.task(world) for world in worlds]
    for spec in specs:
        if spec.targets is None:
            raise InvalidValueError(f"{spec.id} has no targets, for another task measures its scene; leave it out.")
    for appearance in map(appearance_name, appearances):
        for spec in specs:
            assert spec.targets is not None
            yield from _fidelity(spec, spec.targets, turns, appearance)[1]


def speed_report(
    out: Path,
    turns: int = TURNS,
    show: Callable[[str], None] = print,
    worlds: Sequence[str] = (),
    appearances: Sequence[str] = APPEARANCES[:1],
) -> bool:
    """Measure, show a Markdown table line by line, and keep the figures with the machine's description.

    Args:
        out: The JSON file to write.
        turns: Macro-actions of each task's fidelity measurement.
        show: Takes one line of text.
        worlds: Worlds whose fidelity alone is measured; none for all figures.
        appearances: Those at which it is.

    Returns:
        Whether every target was met.

    Raises:
        InvalidValueError: Too few macro-actions to time, a folder to write to, or a world without targets.
        UnknownNameError: An unknown world or appearance.
        SetupError: The file cannot be written, or there is no GL.
    """
    if turns < 2 * _BLOCK:
        raise InvalidValueError(f"turns is {turns}; give at least {2 * _BLOCK} macro-actions: two blocks are timed.")
    if out.is_dir():
        raise InvalidValueError(f"{out} is a folder; give the JSON file to write.")
    require_writable(out.parent)
    gl_renderer()  # fails here, in one sentence, rather than in a child
    show("| what | required | measured | |\n|---|---|---|---|")
    figures = []
    for figure in measure_worlds(worlds, appearances, turns) if worlds else measure(turns):
        figures.append(figure)
        show(f"| {figure.what} | {figure.required} | {figure.measured} | {'met' if figure.met else 'NOT MET'} |")
    write_json(out, {"environment": describe_environment(), "figures": [asdict(figure) for figure in figures]})
    return all(figure.met for figure in figures)


def _best_cpu_s(repeat: Callable[[], object], blocks: int) -> float:
    """Least CPU seconds of one block: noise on a shared machine only ever adds."""
    times = []
    for _ in range(blocks):
        start = time.process_time()
        repeat()
        times.append(time.process_time() - start)
    return min(times)


def _child(code: str) -> dict[str, float]:
    """Run ``code`` on the first task's id in a fresh interpreter; it prints one JSON object."""
    command = [sys.executable, "-c", code, registry.TASKS["arrow_puzzle"].env_id]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SetupError(f"A fresh interpreter could not be measured: {done.stderr.strip().splitlines()[-1]}")
    answer: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return answer


def _fresh_interpreters() -> Iterator[Figure]:
    runs = [_child(_START_UP) for _ in range(5)]
    imported, first_reset = (min(run[key] for run in runs) for key in ("import", "reset"))
    yield figure_of("import imagine_bench, s", imported, "<=", 0.5, ".2f")
    yield figure_of("import + make + first reset, s", first_reset, "<=", 2, ".2f")
    if Path("/proc/self/status").exists():
        memory = _child(_MEMORY)
        yield figure_of("memory of one env, MB", memory["rss"], "<=", 300, ".0f")
        yield figure_of("its growth over 2,000 resets, MB", memory["growth"], "<=", 2, ".1f")
        yield figure_of("memory of 64 lanes of a vector env, MB", _child(_LANES_MEMORY)["rss"], "<=", 1300, ".0f")


def _weight_samples() -> Iterator[Figure]:
    """What chapter 4 computes as one batch, against the same one after another."""
    measure_pass = registry.load("imagine_bench.agents.speed:weight_samples")
    times = {rows: measure_pass(rows, 50, 5) for rows in _BATCHES}
    ratios = {rows: one_pass_s / loop_s for rows, (one_pass_s, loop_s) in times.items()}
    worst = max(ratios, key=lambda rows: ratios[rows])
    what = f"50 weight samples in one pass, share of a loop's CPU time, worst of batches of 1 to {_BATCHES[-1]:,}"
    note = f" at {worst:,}, {ratios[1]:.2f} at 1, {ratios[64]:.2f} at 64"
    yield figure_of(what, ratios[worst], "<=", 1, ".2f", note)
    together_s, alone_s = registry.load("imagine_bench.agents.speed:training")(10, 250, 3, 4)
    what = "training 10 networks of chapter 4 as one batch, times faster than one after another"
    yield figure_of(what, alone_s / together_s, ">=", 1.5, ".2f")


def _model_updates() -> Iterator[Figure]:
    """The world model's update, N_E of which are nearly all that a real step costs, beside an expert's plain torch."""
    for hyperparameters, required in (("published", 1.2), ("fast", 0.9)):
        speed = registry.load("imagine_bench.agents.speed:model_update")(hyperparameters)
        what = f"a model update ({hyperparameters} settings), times faster than plain torch"
        note = f": {speed.own_ms:.1f} CPU ms in {speed.precision} against {speed.plain_ms:.1f}"
        yield figure_of(what, speed.plain_ms / speed.own_ms, ">=", required, ".2f", note)


def _kinematic(spec: TaskSpec, targets: PerformanceTargets) -> Iterator[Figure]:
    env = gymnasium.make(spec.env_id, execution="kinematic")
    env.reset(seed=0)
    rng = SeedTree(0).child("speed", "kinematic").generator()
    actions = rng.integers(spec.n_actions, size=1_000).tolist()
    scene = env.unwrapped
    assert isinstance(scene, SceneReader)

    def thousand_steps() -> None:
        for action in actions:  # ends by rule are ignored, only the time limit resets
            *_, truncated, _ = env.step(action)
            if truncated:
                env.reset()

    def kept() -> None:
        played = EpisodeRecord.begun(env, env.reset(seed=0)[1])
        info = env.step(0)[-1]
        for action in actions:
            played.add(action, 0.0, info)

    thousand_steps()
    rate = 1_000 / _best_cpu_s(thousand_steps, 9)
    what = f"{spec.id}: kinematic macro-actions with frame, through gym.make, per CPU s"
    yield figure_of(what, rate, ">=", targets.kinematic_per_cpu_s, ",.0f")
    share, what = _best_cpu_s(kept, 9) * rate / 1_000, f"{spec.id}: keeping test episodes, share of these CPU s"
    yield figure_of(what, share, "<=", 0.05, ".1%")
    frame_ms = _best_cpu_s(lambda: [scene.agent_view() for _ in range(1_000)], 9)
    env.close()
    yield figure_of(f"{spec.id}: 64x64 frame, hot, CPU ms", frame_ms, "<=", 0.15, ".3f")


def _vector(spec: TaskSpec, targets: PerformanceTargets) -> Iterator[Figure]:
    """Lanes beside one environment, by wall time, which needs quiet cores: block by block in turn, median of ratios."""
    del targets
    for execution, required, turns in (("physics", 1.4, 64), ("kinematic", 0.9, 4096)):
        ratios = {lanes: lanes_ratio(spec, execution, lanes, turns, blocks=3) for lanes in _LANES}
        curve = ", ".join(f"{ratio:.2f} at {lanes}" for lanes, ratio in ratios.items())
        what = f"{spec.id}: {_LANES[2]} lanes, {execution}, times as fast as one environment"
        yield figure_of(what, ratios[_LANES[2]], ">=", required, ".2f", f" ({curve})")


def lanes_ratio(spec: TaskSpec, execution: str, lanes: int, turns: int, *, blocks: int) -> float:
    """How many times as fast as one environment so many lanes are, at random actions; ends reset at once.

    Args:
        spec: The task.
        execution: ``"physics"`` or ``"kinematic"``.
        lanes: Of the vector environment.
        turns: Macro-actions of a block, at least.
        blocks: Pairs of blocks; the median of their ratios is returned.
    """
    one = gymnasium.make(spec.env_id, execution=execution)
    many = gymnasium.make_vec(registry.vector_id(spec.env_id), num_envs=lanes, execution=execution)
    rng, rounds = SeedTree(0).child("speed", "lanes").generator(), -(-turns // lanes)
    one.reset(seed=0)
    many.reset(seed=0)

    def alone() -> None:
        for action in rng.integers(spec.n_actions, size=rounds * lanes).tolist():
            *_, terminated, truncated, _ = one.step(action)
            if terminated or truncated:
                one.reset()

    def together() -> None:
        for _ in range(rounds):
            many.step(rng.integers(spec.n_actions, size=lanes))

    together()
    together()  # by now the process that draws beside this one has begun
    times = [[timeit.timeit(each, number=1) for each in (alone, together)] for _ in range(blocks)]
    one.close()
    many.close()
    return float(np.median([alone_s / together_s for alone_s, together_s in times]))


def _encoders(spec: TaskSpec, targets: PerformanceTargets) -> Iterator[Figure]:
    """What the bundled encoders' cards say."""
    folder = resources.files("imagine_bench.assets") / "encoders"
    for appearance, required in targets.encoders.items():
        card = json.loads((folder / f"{spec.encoder}-{appearance}.json").read_text())
        what = f"probe on {card['recipe']['held_out_frames']:,} held-out frames (from its card)"
        yield figure_of(f"{spec.id}: bundled encoder {appearance}: {what}", card["probe"]["mlp"], ">=", required, ".2%")
        what = f"{spec.id}: bundled encoder {appearance}: training, CPU s (from its card)"
        yield figure_of(what, card["cpu_s"]["total"], "<=", 120, ".0f")


def _fidelity(
    spec: TaskSpec, targets: PerformanceTargets, turns: int, appearance: str = APPEARANCES[0]
) -> tuple[Fidelity, list[Figure]]:
    found = measure_fidelity(spec, targets, turns, appearance)
    clean = appearance == APPEARANCES[0]
    world, least = (spec.id, targets.as_ruled) if clean else (f"{spec.id} at {appearance}", targets.as_ruled_varied)
    what = f"{world}: macro-actions exactly as the rules say, of {turns:,}"
    figures = [figure_of(what, found.as_ruled / found.actions, ">=", least, ".2%")]
    what = f"{world}: other objects moved, worst, mm"
    figures.append(figure_of(what, found.other_objects_mm, "<", targets.other_objects_mm, ".3f"))
    if targets.error_mm is not None:
        p99_mm = float(np.percentile(found.error_mm, 99))
        figures.append(figure_of(f"{world}: position error, p99, mm", p99_mm, "<", targets.error_mm, ".2f"))
    if targets.error_deg is not None:
        p99_deg = float(np.percentile(found.error_deg, 99))
        figures.append(figure_of(f"{world}: yaw error, p99, degrees", p99_deg, "<", targets.error_deg, ".2f"))
    return found, figures + (_slips(world, found) if found.slips else [])


def _slips(world: str, found: Fidelity) -> list[Figure]:
    """How often what could slip did, within the 99 % interval of the rules' probability, and what moved although."""
    n, rate = len(found.slips), float(np.mean([slipped for slipped, _ in found.slips]))
    low, high = scipy.stats.binom.interval(0.99, n, np.mean([said for _, said in found.slips])) / np.float64(n)
    within = Figure(
        what=f"{world}: macro-actions that slip, of {n:,}",
        required=f"{low:.1%} to {high:.1%}",
        measured=f"{rate:.1%}",
        met=bool(low <= rate <= high),
    )
    return [within, figure_of(f"{world}: objects that slip move, worst, mm", found.slipped_mm, "<", _SLIPPED_MM, ".2f")]


def _physics(spec: TaskSpec, targets: PerformanceTargets, turns: int) -> Iterator[Figure]:
    found, figures = _fidelity(spec, targets, turns)
    yield from figures
    # The first block warms up.
    blocks_s = [sum(found.cpu_s[first : first + _BLOCK]) for first in range(_BLOCK, turns - _BLOCK + 1, _BLOCK)]
    rate, mean_rate = _BLOCK / min(blocks_s), _BLOCK * len(blocks_s) / sum(blocks_s)
    what = f"{spec.id}: mink + physics + frame, macro-actions per CPU s, best {_BLOCK} (mean)"
    yield figure_of(what, rate, ">=", targets.physics_per_cpu_s, ".0f", f" ({mean_rate:.0f})")
