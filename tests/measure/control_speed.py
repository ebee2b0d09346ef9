"""Continuous control beside other suites: CPU seconds of a step, in one run, as ratios.

    python tests/measure/control_speed.py PEERS [--rounds 5] [--seconds 2] [--core 1] [--only fetch ours ...]

``PEERS`` is a folder of virtual environments, one a suite, made as ``tests/measure/peers/README.md`` says. Each
measurement is a process of its own, bound to one core; in every round each suite is measured once, in turn. A ratio is
taken within a round, and the median over rounds is kept, so a busy machine slows both sides of it. Every round goes to
``runs/control_speed.json``, from which ``speed_cells.py`` makes the tables of absolute figures.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from imagine_bench.errors import SetupError
from imagine_bench.registry.machine import describe_environment
from imagine_bench.store.files import require_writable, write_json
from imagine_bench.testing.physics import HEAD, Figure, figure_of

OUT = Path("runs/control_speed.json")
WORKERS = Path(__file__).parent / "peers"
IMAGES = ("none", "wrist-plain", "front-plain", "both-plain", "wrist", "front")
"""Images of a step: ``plain`` ones without shadows, mirrors and antialiasing, the others as a suite makes them."""
LANES = 8
BEST_PEER = 5.0
"""With one image a step is to be so many times as fast as the best peer's."""
MUJOCO_ALONE = 2.0
"""A step with images is to take at most so many times as long as MuJoCo's own functions alone."""
TIMEOUT_S = 600
Rows = Mapping[str, Mapping[str, float | str]]
"""Figures of each suite."""
_CPU_OF_IMPORT = "import time; start = time.process_time(); {imports}; print(time.process_time() - start)"


@dataclass(frozen=True, kw_only=True)
class Suite:
    """One suite: how its worker is called."""

    name: str  #: as the table says it
    venv: str = ""  #: its folder in PEERS; empty: this Python
    worker: str
    imports: str  #: the statement whose time is that of its import
    arguments: tuple[str, ...] = ()
    has_wrist: bool = True  #: whether a camera moves with the hand
    has_effects: bool = True  #: whether its images have shadows, mirrors or antialiasing

    def images(self) -> list[str]:
        """The images that it can draw. Those of a suite without effects count as plain."""
        kinds = [each for each in IMAGES if self.has_wrist or not each.startswith("wrist")]
        return [each for each in kinds if self.has_effects or each == "none" or each.endswith("-plain")]

    @property
    def one_image(self) -> str:
        """The kind of one image that is judged: the hand's, where a camera is on the hand, else the front one."""
        return "wrist-plain" if self.has_wrist else "front-plain"


def _ours(task: str, more: str = "", words: str = "") -> Suite:
    return Suite(
        name=f"imagine_bench {task}{words}",
        worker="ours.py",
        imports="import gymnasium, imagine_bench",
        arguments=(f"imagine_bench/{task}{more}-v0",),
        has_effects=False,
    )


SUITES = {
    "ours": _ours("ArrowPuzzleMotion"),
    "ours_pick_place": _ours("PickPlaceMotion"),
    "vector": _ours("ArrowPuzzleMotion", "-vector", ", 8 lanes of its vector environment"),
    "fetch": Suite(
        name="Gymnasium-Robotics FetchPickAndPlace-v4",
        venv="gymnasium_robotics",
        worker="fetch.py",
        imports="import gymnasium, gymnasium_robotics",
    ),
    "dm_control": Suite(
        name="dm_control lift_brick",
        venv="dm_control",
        worker="dm_control_lift.py",
        imports="from dm_control import manipulation",
        has_wrist=False,
    ),
    "ogbench": Suite(
        name="OGBench cube-single",
        venv="ogbench",
        worker="ogbench_cube.py",
        imports="import gymnasium, ogbench",
        has_wrist=False,
    ),
    "metaworld": Suite(
        name="Meta-World pick-place-v3",
        venv="metaworld",
        worker="metaworld_pick_place.py",
        imports="import gymnasium, metaworld",
    ),
    "robosuite": Suite(
        name="robosuite Lift",
        venv="robosuite",
        worker="robosuite_lift.py",
        imports="import robosuite",
    ),
}
OURS = ["ours", "ours_pick_place"]
PEERS = [key for key, suite in SUITES.items() if suite.venv]


class Processes:
    """Calls workers, each in the Python of its suite.

    Args:
        folder: The folder of virtual environments.
        core: The core that measurements of one process are bound to.
    """

    def __init__(self, folder: Path, core: int) -> None:
        self.folder = folder.resolve()
        self.core = core
        self._variables = {**os.environ, "MUJOCO_GL": "egl", "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}

    def python(self, suite: Suite) -> str:
        """The interpreter of a suite.

        Raises:
            SetupError: Its virtual environment is missing.
        """
        if not suite.venv:
            return sys.executable
        path = self.folder / suite.venv / "bin" / "python"
        if not path.exists():
            raise SetupError(f"There is no {path}; make it as tests/measure/peers/README.md says.")
        return str(path)

    def start(self, suite: Suite, core: int, *arguments: str) -> subprocess.Popen[str]:
        """Start a Python of a suite on a core."""
        command = ["taskset", "-c", str(core), self.python(suite), *arguments]
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, text=True, env=self._variables, **streams)

    def worker(self, suite: Suite, core: int, mode: str, images: str, number: float) -> subprocess.Popen[str]:
        """Start a suite's worker."""
        return self.start(suite, core, str(WORKERS / suite.worker), mode, images, f"{number:g}", *suite.arguments)

    def measured(self, suite: Suite, mode: str, images: str, number: float) -> dict[str, float | str]:
        """The output of a worker."""
        found: dict[str, float | str] = json.loads(
            _last_line(suite, self.worker(suite, self.core, mode, images, number))
        )
        return found

    def beside_mujoco(self, suite: Suite, images: str, seconds: float) -> dict[str, float | str]:
        """Our step and MuJoCo alone; keys such as ``"own step_s none"``."""
        found = self.measured(suite, "own", images, seconds)
        return {f"own {what} {images}": value for what, value in found.items()}

    def import_s(self, suite: Suite) -> float:
        """CPU seconds of a suite's import in a fresh interpreter."""
        code = _CPU_OF_IMPORT.format(imports=suite.imports)
        return float(_last_line(suite, self.start(suite, self.core, "-c", code)))

    def two_at_once(self, suite: Suite, images: str, seconds: float) -> dict[str, float]:
        """Steps a second of wall time, and a CPU second, of two processes, one a core, that begin at once."""
        both = [self.worker(suite, core, "wall", images, seconds) for core in (0, 1)]
        for each in both:
            _read_until_ready(suite, each)
        for each in both:
            _write_line(each)
        found = [json.loads(_last_line(suite, each)) for each in both]
        steps = sum(each["steps"] for each in found)
        wall_s = max(each["wall_s"] for each in found)
        return {"per_wall_s": steps / wall_s, "per_cpu_s": steps / sum(each["cpu_s"] for each in found)}


def _read_until_ready(suite: Suite, process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "ready":
            return
    _last_line(suite, process)


def _write_line(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def _last_line(suite: Suite, process: subprocess.Popen[str]) -> str:
    """The last line that a process prints. Raises SetupError: it prints none, or fails."""
    out, errors = process.communicate(timeout=TIMEOUT_S)
    lines = out.strip().splitlines()
    if process.returncode != 0 or not lines:
        reason = [line for line in errors.strip().splitlines() if line.strip()][-1:] or ["nothing was printed"]
        raise SetupError(f"{suite.name} could not be measured: {reason[0]}")
    return lines[-1]


def one_round(processes: Processes, suites: Sequence[str], seconds: float) -> dict[str, dict[str, float | str]]:
    """Everything once, suites in turn within each kind of images; keys such as ``"step_s none"``."""
    found: dict[str, dict[str, float | str]] = {key: {} for key in suites}
    for images in IMAGES:
        for key in [each for each in suites if images in SUITES[each].images()]:
            for what, value in processes.measured(SUITES[key], "steps", images, seconds).items():
                found[key][f"{what} {images}" if what.endswith("_s") else what] = value
            if key in OURS:
                found[key] |= processes.beside_mujoco(SUITES[key], images, seconds)
    for key in suites:
        found[key]["import_s"] = processes.import_s(SUITES[key])
        for what, value in processes.two_at_once(SUITES[key], SUITES[key].one_image, seconds).items():
            found[key][f"two {what}"] = value
    return found


def memory(processes: Processes, suites: Sequence[str]) -> dict[str, dict[str, float | str]]:
    """Memory of one lane with one image, and of each of eight more."""
    return {key: processes.measured(SUITES[key], "memory", SUITES[key].one_image, LANES) for key in suites}


def ratio(rounds: Sequence[Rows], key: str, peer: str, images: str) -> float:
    """How many times as long a step of a peer takes as ours: the median over rounds of the ratio within each."""
    ours = images if images == "none" or images.endswith("-plain") else f"{images}-plain"
    each = [float(row[peer][f"step_s {images}"]) / float(row[key][f"step_s {ours}"]) for row in rounds]
    return float(np.median(each))


def figures(rounds: Sequence[Rows]) -> Iterator[Figure]:
    """The judged ratios of each of our tasks: beside the best peer, and beside MuJoCo alone."""
    for key in [each for each in OURS if each in rounds[0]]:
        yield from beside_peers(rounds, key)
        for images in SUITES[key].images():
            yield beside_mujoco(rounds, key, images)


def task_of(key: str) -> str:
    """The task of one of our rows."""
    return SUITES[key].name.removeprefix("imagine_bench ")


def beside_peers(rounds: Sequence[Rows], key: str) -> Iterator[Figure]:
    """How many times as fast ours is as the fastest peer, at each number of images."""
    least = {"one image": BEST_PEER}
    for words in ("no image", "one image", "two images"):
        ratios = slowdowns(rounds, key, words)
        if ratios:
            peer = min(ratios, key=lambda each: ratios[each])
            what = f"{task_of(key)}: a step with {words}, times as fast as the best peer"
            sign = ">=" if words in least else ""
            yield figure_of(what, ratios[peer], ".1f", sign, least.get(words), f" ({SUITES[peer].name})")


def slowdowns(rounds: Sequence[Rows], key: str, words: str) -> dict[str, float]:
    """How many times as long a step of each peer takes as ours, at its fastest kind of so many images."""
    found = {}
    for peer in [each for each in PEERS if each in rounds[0]]:
        one = SUITES[peer].one_image
        kinds = {"no image": ["none"], "one image": [one, one.removesuffix("-plain")], "two images": ["both-plain"]}
        found[peer] = min(ratio(rounds, key, peer, images) for images in kinds[words])
    return found


def beside_mujoco(rounds: Sequence[Rows], key: str, images: str) -> Figure:
    """How many times as long our step takes as MuJoCo alone for the same physics steps and images."""
    parts = ("step_s", "mj_step_s", "mjr_s")
    own = np.array([[float(row[key][f"own {part} {images}"]) for part in parts] for row in rounds])
    step_us, simulated_us, drawn_us = 1e6 * np.median(own, axis=0)
    value = float(np.median(own[:, 0] / own[:, 1:].sum(axis=1)))
    alone = "mj_step alone" if images == "none" else f"mj_step and mjr_render alone, {images.removesuffix('-plain')}"
    more = f" ({step_us:.0f} against {simulated_us:.0f} + {drawn_us:.0f} CPU us)"
    sign, most = ("", None) if images == "none" else ("<=", MUJOCO_ALONE)
    return figure_of(f"{task_of(key)}: a step, times {alone}", value, ".2f", sign, most, more)


def versions(processes: Processes, suites: Sequence[str]) -> dict[str, list[str]]:
    """The packages of each suite's virtual environment."""
    code = "from importlib.metadata import distributions as d; print(*sorted(f'{x.name}=={x.version}' for x in d()))"
    peers = [SUITES[key] for key in suites if key in PEERS]
    return {suite.venv: _last_line(suite, processes.start(suite, 0, "-c", code)).split() for suite in peers}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the judged ratios, keep every round; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("peers", type=Path, help="folder of the suites' virtual environments")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="CPU seconds of steps in each measurement")
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--only", nargs="+", choices=list(SUITES), default=list(SUITES))
    chosen = parser.parse_args(arguments)
    require_writable(chosen.out.parent)
    processes = Processes(chosen.peers, chosen.core)
    facts = describe_environment()
    kept = {
        "environment": facts,
        "rounds": [],
        "packages": versions(processes, chosen.only),
        "memory": memory(processes, chosen.only),
    }
    print(f"{facts['machine']['cpu']}, {facts['machine']['cores']} cores, {facts['gl_renderer']}\n", flush=True)
    rounds = kept["rounds"]
    for index in range(chosen.rounds):
        rounds.append(one_round(processes, chosen.only, chosen.seconds))
        judged = list(figures(rounds))
        kept["figures"] = [asdict(figure) for figure in judged]
        write_json(chosen.out, kept)
        print(f"round {index + 1} of {chosen.rounds}", file=sys.stderr, flush=True)
    print(HEAD, *(figure.row for figure in judged), sep="\n")
    return int(not all(figure.met for figure in judged))


if __name__ == "__main__":
    sys.exit(main())
