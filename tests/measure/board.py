"""The cost of checking rows of continuous control, as a ratio to their own calls of ``mj_step``, in one run.

    python tests/measure/board.py docs/board

CPU time inside ``mj_step`` is taken at each call. All else that a check does counts beside it: files, the making of the
environment, servo commands, the macrostate, rewards. (Rows of macro-actions: ``make speed`` has the ratio of one.)
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco
from imagine_bench_board.check import Checked, check, row_folders
from imagine_bench_board.motions import FORMAT
from imagine_bench_board.rows import CARD, ROWS

from imagine_bench.store.files import read_json

MOST = 1.3
"""The largest ratio that is asked."""


class StepTime:
    """CPU seconds of this thread in ``mj_step``, and the number of calls."""

    def __init__(self) -> None:
        self.cpu_s = 0.0
        self.calls = 0
        self._step = mujoco.mj_step

    def __call__(self, *given: Any, **more: Any) -> None:
        begun = time.thread_time()
        self._step(*given, **more)
        self.cpu_s += time.thread_time() - begun
        self.calls += 1


def is_of_motions(folder: Path) -> bool:
    """Whether a row is of continuous control."""
    return bool(read_json(folder / CARD, "the card of a row")["format"] == FORMAT)


def measure(board: Path) -> tuple[list[Checked], float, StepTime]:
    """The check of a board, its CPU seconds, and those of its steps."""
    steps = StepTime()
    with mock.patch.object(mujoco, "mj_step", steps):
        begun = time.thread_time()
        found = check(board)
        return found, time.thread_time() - begun, steps


def main() -> int:
    """Print the ratio for all rows of motions together; 1 if it is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("board", type=Path, nargs="?", default=Path("docs/board"))
    rows = [row for row in row_folders(parser.parse_args().board) if is_of_motions(row)]
    check(rows[0])  # modules and libraries load
    with tempfile.TemporaryDirectory() as folder:
        for row in rows:
            shutil.copytree(row, Path(folder) / ROWS / row.name)
        found, cpu_s, steps = measure(Path(folder))
    episodes = sum(each.verdict.episodes for each in found)
    ratio = cpu_s / steps.cpu_s
    print(
        f"{len(found)} rows, {episodes:,} episodes, {cpu_s:.1f} CPU s, {ratio:.2f} times mj_step alone; {MOST:g} asked"
    )
    return int(ratio > MOST)


if __name__ == "__main__":
    raise SystemExit(main())
