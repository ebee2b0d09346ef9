"""How far two versions of MuJoCo part in the tests of rows of continuous control.

    pip install --no-deps --target build/other_mujoco mujoco==4.0.0 mujoco-core==4.0.0
    python tests/measure/other_mujoco.py docs/board/rows build/other_mujoco

Each test of each row below a folder is played with the installed MuJoCo and with another one, in a process each. The
script prints the differences of positions in the first control period in which they are more than rounding, and the
tests that end in another way.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench_board import motions
from imagine_bench_board.motion_rows import FORMAT, MotionProtocol, MotionRow, PlayedMotion, read_motions
from imagine_bench_board.rows import read_card
from numpy.typing import NDArray

ROUNDING = 1e-11
"""Positions that differ by more, in rad or m, have parted."""
MORE_PERIODS = 200
"""Control periods for which the last command is held where a test does not end with it."""
ENDS = "ends"


def rows_of(folder: Path) -> list[MotionRow]:
    """The rows of continuous control below a folder."""
    return [read_motions(row) for row in sorted(folder.iterdir()) if read_card(row).get("format") == FORMAT]


def path_of(env: MotionEnv, protocol: MotionProtocol, test: int, motion: PlayedMotion) -> NDArray[np.float64]:
    """All positions (K, nq) at the start and after each command of a test, until its episode is over."""
    env.restart(seed=protocol.start(test))
    path = [env.data.qpos.copy()]
    for command in np.concatenate([motion.commands, np.repeat(motion.commands[-1:], MORE_PERIODS, axis=0)]):
        (period,) = env.carry_out(command[np.newaxis])
        path.append(env.data.qpos.copy())
        if period.terminated or period.truncated:
            break
    return np.array(path)


def write_paths(folder: Path, out: Path) -> None:
    """Play all tests with the MuJoCo of this process, and keep their paths and whether each ends as its file says."""
    found = {}
    for row in rows_of(folder):
        with closing(row.protocol.make(observation="state")) as env:
            unwrapped = env.unwrapped
            assert isinstance(unwrapped, MotionEnv)
            for test, motion in enumerate(row.motions):
                name = f"{row.name} {test}"
                found[name] = path_of(unwrapped, row.protocol, test, motion)
                played = motions.replayed(unwrapped, row.protocol.start(test), motion.commands)
                found[f"{ENDS} {name}"] = np.array(not motions.difference(motion, played))
    np.savez(out, **found)


def parted_by(here: NDArray[np.float64], there: NDArray[np.float64]) -> float | None:
    """The largest difference of two paths in the first period in which they have parted; None if they never do."""
    periods = min(len(here), len(there))
    apart = np.abs(here[:periods] - there[:periods]).max(axis=1)
    parted = apart > ROUNDING
    return float(apart[parted.argmax()]) if parted.any() else None


def main() -> None:
    """Print how far the versions part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=Path, help="folder of rows")
    parser.add_argument("other", type=Path, help="folder with the other MuJoCo, or where --write puts paths")
    parser.add_argument("--write", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.write:
        write_paths(given.rows, given.other)
        return
    with tempfile.TemporaryDirectory() as scratch:
        paths = []
        for name, more in (("here", {}), ("there", {"PYTHONPATH": str(given.other.absolute())})):
            out = Path(scratch) / f"{name}.npz"
            command = [sys.executable, __file__, str(given.rows), str(out), "--write"]
            subprocess.run(command, env={**os.environ, **more}, check=True)
            paths.append(dict(np.load(out)))
    here, there = paths
    for row in rows_of(given.rows):
        names = [f"{row.name} {test}" for test in range(len(row.motions))]
        apart = [each for each in (parted_by(here[name], there[name]) for name in names) if each is not None]
        spread = f", by {min(apart):.0e} to {max(apart):.0e}, in the median {np.median(apart):.0e}" if apart else ""
        print(f"{row.name}: {len(apart)} of {len(names)} tests part{spread}")
        for test, (name, motion) in enumerate(zip(names, row.motions, strict=True)):
            assert here[f"{ENDS} {name}"], f"{name} does not play again here"
            if not there[f"{ENDS} {name}"]:
                marked = "not marked" if motion.reproducible else "marked"
                print(f"  test {test} ends in another way; it is {marked} as not reproducible")


if __name__ == "__main__":
    main()
