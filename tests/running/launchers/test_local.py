"""The local pool: every job is carried out or accounted for, and nothing outlives the parent."""

from __future__ import annotations

import functools
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from bench_fakes import FakeRunSpec
from small_runs import small

from imagine_bench.cores import usable_cores, usable_memory
from imagine_bench.protocols.data import Job, Progress
from imagine_bench.running.isolation import Limits
from imagine_bench.running.launchers.jobs import LocalPool, at_a_time, launcher, work_through
from imagine_bench.store import run_folder

_HERE = Path(__file__).parents[2] / "fakes"


def job(root: Path, agent: str, seed: int, **changes: object) -> Job:
    spec = FakeRunSpec(protocol=small(agents=(agent,), seeds=(0, 1), **changes), agent=agent, seed=seed)
    return Job(spec=spec, folder=root / agent / f"seed_{seed}")


@pytest.mark.parametrize("name", ["local", "this_process"])
def test_a_failed_run_is_named_and_stops_no_other(name: str, tmp_path: Path) -> None:
    """Runs of other packages have a process each."""
    jobs = [job(tmp_path, "failing", 1), job(tmp_path, "failing", 0)]
    told: list[Progress] = []
    (failure,) = launcher(name, 1).launch(jobs, told.append)
    processes = {(each.folder / ".lock.holder").read_text() for each in jobs}
    assert len(processes) == (2 if name == "local" else 1)
    assert failure.job is jobs[0]
    assert failure.reason == "RuntimeError: this agent breaks on purpose"
    log = failure.job.log.read_text()
    assert "failing seed 1 begins or goes on" in log and "Traceback" in log and "breaks on purpose" in log
    assert (r"\x1b[31mred" in log) == (name == "local") and "\x1b" not in log
    assert not run_folder.is_done(jobs[0].folder) and run_folder.is_done(jobs[1].folder)
    assert [progress.seed for progress in told if progress.phase == "done"] == [0]
    assert [(progress.seed, progress.detail) for progress in told if progress.phase == "failed"] == [
        (1, failure.reason)
    ]


_PRINTS = """
import pickle, sys
from imagine_bench.running.launchers.jobs import carry_out
for job in pickle.load(sys.stdin.buffer):
    carry_out(job, print, lambda job, tell: print("said by", job.spec.seed))
"""


def test_what_a_run_prints_is_in_its_own_log(tmp_path: Path) -> None:
    """Also where a process carries out several, and keeps lines back."""
    jobs = [job(tmp_path, "random", seed) for seed in (0, 1)]
    jobs[0].log.parent.mkdir(parents=True)
    jobs[0].log.write_text("said by an earlier try\n")
    environment = {**os.environ, "PYTHONPATH": str(_HERE), "PYTHONUNBUFFERED": ""}
    subprocess.run([sys.executable, "-c", _PRINTS], input=pickle.dumps(jobs), env=environment, check=True)
    said = [[line for line in each.log.read_text().splitlines() if line.startswith("said")] for each in jobs]
    assert said == [["said by an earlier try", "said by 0"], ["said by 1"]]


def test_an_observer_that_fails_is_not_taken_for_a_run_that_did(tmp_path: Path) -> None:
    def closed_screen(progress: Progress) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        LocalPool(1).launch([job(tmp_path, "failing", 0)], closed_screen)


@pytest.fixture
def busy_bench(tmp_path: Path) -> subprocess.Popen[str]:
    """The command line with a run that would take minutes, once its worker has begun to train."""
    words = "bench --task arrow_puzzle --preset smoke --agents table --budgets 100000 --execution kinematic --workers 1"
    command = [sys.executable, str(_HERE / "bench_fakes.py"), *words.split(), "--out", str(tmp_path)]
    heed = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background may ignore Ctrl-C
    bench = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    signal.signal(signal.SIGINT, heed)
    deadline_s = time.monotonic() + 60
    while not list(tmp_path.glob("*/*/table/seed_0/config.json")):
        assert time.monotonic() < deadline_s and bench.poll() is None
        time.sleep(0.05)
    return bench


def family(bench: subprocess.Popen[str]) -> list[psutil.Process]:
    found = psutil.Process(bench.pid).children(recursive=True)
    assert any("spawn_main" in " ".join(child.cmdline()) for child in found)
    return found


@pytest.mark.parametrize("to_all", [True, False])
def test_ctrl_c_ends_everything_and_says_how_to_go_on(busy_bench: subprocess.Popen[str], to_all: bool) -> None:
    """A terminal sends Ctrl-C to the whole process group; ``kill -INT`` to the parent alone."""
    children = family(busy_bench)
    if to_all:
        os.killpg(busy_bench.pid, signal.SIGINT)
    else:
        busy_bench.send_signal(signal.SIGINT)
    _, errors = busy_bench.communicate(timeout=60)
    assert busy_bench.returncode == 130
    assert "Traceback" not in errors
    assert errors.splitlines()[-1] == (
        "imagine-bench: interrupted; the same command goes on from the last checkpoints."
    )
    assert psutil.wait_procs(children, timeout=30)[1] == []


def test_kill_9_of_the_parent_leaves_no_orphan(busy_bench: subprocess.Popen[str]) -> None:
    children = family(busy_bench)
    busy_bench.kill()
    busy_bench.communicate(timeout=60)
    assert psutil.wait_procs(children, timeout=30)[1] == []


def _carried(item: int, tell: Callable[[int], None]) -> str:
    """Tell the process and carry out an item, but for one at which the process dies."""
    tell(os.getpid())
    if item == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return f"{item} fails" if item == 2 else ""


def test_a_worker_that_dies_costs_one_item() -> None:
    workers: list[int] = []
    ends: list[tuple[int, str]] = []
    work_through(
        _carried,
        range(5),
        workers=1,
        on_news=workers.append,
        on_end=lambda *end: ends.append(end),
        fresh=lambda item: item == 3,
    )
    assert [item for item, _ in ends] == [0, 1, 2, 3, 4], "in order, each once"
    assert [bool(why) for _, why in ends] == [False, True, True, False, False]
    assert "exit code -9" in ends[1][1] and ends[2][1] == "2 fails"
    assert workers[0] == workers[1] and workers[2] == workers[4], "one process after another item"
    assert len(set(workers)) == 3, "a death costs a process, and item 3 has its own"
    assert psutil.wait_procs([child for child in psutil.Process().children() if child.pid in workers], 10)[1] == []


def _met(folder: Path, item: int, tell: Callable[[int], None]) -> str:
    """Wait for the process that carries out the other item."""
    (folder / str(item)).touch()
    until_s = time.monotonic() + 30
    while not (folder / str(1 - item)).exists():
        if time.monotonic() > until_s:
            return "it is alone"
        time.sleep(0.02)
    return ""


def test_as_many_items_are_carried_out_at_once_as_there_are_workers(tmp_path: Path) -> None:
    ends: list[str] = []
    carry = functools.partial(_met, tmp_path)
    work_through(carry, range(2), workers=2, on_news=lambda _: None, on_end=lambda _, why: ends.append(why))
    assert ends == ["", ""]


_OLD_CPU = "cpu,cpuacct/x/cpu.cfs"
_OLD_MEMORY = "memory/x/memory.limit_in_bytes"


@pytest.mark.parametrize(
    ("groups", "files", "cores", "memory"),
    [
        ("0::/a/b", {"a/cpu.max": "100000 100000", "a/b/cpu.max": "max 100000"}, 1, None),
        ("0::/", {"cpu.max": "50000 100000", "memory.max": "max"}, 1, None),
        ("0::/gone", {"cpu.max": "150000 100000"}, 2, None),
        ("3:cpu,cpuacct:/x", {f"{_OLD_CPU}_quota_us": "100000", f"{_OLD_CPU}_period_us": "100000"}, 1, None),
        ("3:cpu:/of/the/host", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, None, None),
        ("3:cpuset:/\n\nnonsense", {"cpuset/cpu.max": "1 100000", "cpu.max": "nothing"}, None, None),
        ("0::/", {"cpu.max": "1 0"}, None, None),
        ("0::/a/b", {"a/memory.max": "1048576", "a/b/memory.max": "max"}, None, 1048576),
        ("2:memory:/x", {_OLD_MEMORY: "4096"}, None, 4096),
        ("2:memory:/x", {_OLD_MEMORY: "9223372036854771712"}, None, None),
    ],
)
def test_a_containers_limits_bound_the_cores_and_the_memory_counted(
    tmp_path: Path, groups: str, files: dict[str, str], cores: int | None, memory: int | None
) -> None:
    for name, text in {"proc/self/cgroup": groups, **{f"sys/fs/cgroup/{n}": t for n, t in files.items()}}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"{text}\n")
    unbounded = usable_cores(tmp_path / "none")
    assert usable_cores(tmp_path) == min(unbounded, cores or unbounded)
    assert usable_memory(tmp_path) == (memory or usable_memory(tmp_path / "none"))


def test_a_judged_model_has_three_quarters_of_the_memory() -> None:
    assert Limits().memory == usable_memory() * 3 // 4


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system knows no affinity")
def test_affinity_bounds_the_cores_counted() -> None:
    given = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(given)})
    try:
        assert at_a_time(None) == usable_cores() == 1
    finally:
        os.sched_setaffinity(0, given)
