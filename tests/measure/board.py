"""The cost of checking rows of continuous control, as a ratio to their own calls of ``mj_step``, in one run.

    python tests/measure/board.py docs/board

All that a check does counts: files, the making of the environment, servo commands, the macrostate, rewards. The check
runs as it is, and again with the CPU time inside ``mj_step`` taken at each call. Reading the clock takes about 1 us, a
tenth of a step, so the first run has no clock, and the clock's own time is taken off the second's. Both run several
times by turns, and the least of each counts. (Rows of macro-actions: ``make speed`` has the ratio of one.)
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco
from imagine_bench_board.check import Checked, check, row_folders
from imagine_bench_board.motion_rows import FORMAT
from imagine_bench_board.rows import CARD, ROWS

from imagine_bench.store.files import read_json

MOST = 1.3
"""The largest ratio that is asked."""
TIMES = 3
CLOCK_CALLS = 100_000


class StepTime:
    """CPU seconds of this thread in ``mj_step``, and the number of calls."""

    def __init__(self, step: Callable[..., None] = mujoco.mj_step) -> None:
        self.cpu_s = 0.0
        self.calls = 0
        self._step = step

    def __call__(self, *given: Any, **more: Any) -> None:
        begun = time.thread_time()
        self._step(*given, **more)
        self.cpu_s += time.thread_time() - begun
        self.calls += 1


def is_of_motions(folder: Path) -> bool:
    """Whether a row is of continuous control."""
    return bool(read_json(folder / CARD, "the card of a row")["format"] == FORMAT)


def clock_s() -> float:
    """CPU seconds that :class:`StepTime` counts for a step that does nothing."""
    nothing = StepTime(lambda *_: None)
    for _ in range(CLOCK_CALLS):
        nothing(None, None)
    return nothing.cpu_s / nothing.calls


def check_s(board: Path) -> tuple[list[Checked], float]:
    """The check of a board, and its CPU seconds."""
    begun = time.thread_time()
    found = check(board)
    return found, time.thread_time() - begun


def steps_s(board: Path) -> float:
    """CPU seconds of ``mj_step`` in the check of a board, without the clock's."""
    steps = StepTime()
    with mock.patch.object(mujoco, "mj_step", steps):
        check(board)
    return steps.cpu_s - steps.calls * clock_s()


def main() -> int:
    """Print the ratio for all rows of motions together; 1 if it is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("board", type=Path, nargs="?", default=Path("docs/board"))
    rows = [row for row in row_folders(parser.parse_args().board) if is_of_motions(row)]
    check(rows[0])  # modules and libraries load
    with tempfile.TemporaryDirectory() as folder:
        for row in rows:
            shutil.copytree(row, Path(folder) / ROWS / row.name)
        whole_s = []
        stepping_s = []
        for _ in range(TIMES):
            found, cpu_s = check_s(Path(folder))
            whole_s.append(cpu_s)
            stepping_s.append(steps_s(Path(folder)))
    episodes = sum(each.verdict.episodes for each in found)
    ratio = min(whole_s) / min(stepping_s)
    cost = f"{min(whole_s):.1f} CPU s, {ratio:.2f} times mj_step alone; {MOST:g} asked"
    print(f"{len(found)} rows, {episodes:,} episodes, {cost}")
    return int(ratio > MOST)


if __name__ == "__main__":
    raise SystemExit(main())
