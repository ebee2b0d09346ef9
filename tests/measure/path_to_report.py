"""Counts the files that a reader meets on the way from a command line to its report.

``python tests/measure/path_to_report.py [OPTIONS of imagine-bench bench]`` runs a smoke bench in this one process and
prints every file of ``imagine_bench`` of which a function was executed, with those functions. Functions that run only
while a module is imported do not count: they are declarations. Files of tasks and agents are printed apart.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).parents[2]
ROOMS = ("imagine_bench", "tasks", "agents")
PLACES = tuple(f"{ROOT / room}/" for room in ROOMS)
SMOKE = (
    *("--task", "arrow_puzzle", "--preset", "smoke", "--execution", "kinematic", "--workers", "1"),
    *("--agents", "random", "dqn", "--seeds", "0", "--budgets", "3", "--evaluation-episodes", "2"),
)
Executed = dict[str, set[str]]
"""Functions by file, a path below the repository."""


@contextlib.contextmanager
def watched() -> Iterator[Executed]:
    """The project's functions that are called within, by any thread, outside of imports."""
    executed: Executed = {}
    imports = 0

    def watch(frame: FrameType, event: str, _: object) -> None:
        nonlocal imports
        code = frame.f_code
        if code.co_name == "<module>":
            imports += {"call": 1, "return": -1}.get(event, 0)
        elif event == "call" and not imports and code.co_filename.startswith(PLACES):
            executed.setdefault(Path(code.co_filename).relative_to(ROOT).as_posix(), set()).add(code.co_name)

    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        yield executed
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]


def measure(options: Sequence[str]) -> Executed:
    """Run a bench in this process, its jobs one after the other, and report it."""
    from imagine_bench import cli
    from imagine_bench.running.launchers import jobs

    def launch(_: object, todo: Sequence[jobs.Job], on_progress: object) -> tuple[jobs.Failure, ...]:
        screen = os.dup(1)  # a worker's output goes to its log
        try:
            found = [(job, jobs.carry_out(job, on_progress)) for job in todo]
        finally:
            os.dup2(screen, 1)
            os.dup2(screen, 2)
        return tuple(jobs.Failure(job=job, reason=reason) for job, reason in found if reason)

    jobs.LocalPool.launch = launch
    with tempfile.TemporaryDirectory() as folder, watched() as executed:
        sys.argv = ["imagine-bench", "bench", *(options or SMOKE), "--out", folder]
        cli.main()
    return executed


def main() -> None:
    """Measure and print."""
    executed = measure(sys.argv[1:])
    print()
    for room in ROOMS:
        files = sorted(name for name in executed if name.startswith(f"{room}/"))
        folders = {name.rpartition("/")[0] for name in files}
        print(f"{room}: {len(files)} files in {len(folders)} folders")
        for name in files:
            print(f"  {name}: {len(executed[name])} functions, such as {sorted(executed[name])[0]}")


if __name__ == "__main__":
    main()
