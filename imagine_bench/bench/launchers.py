"""Where runs are carried out. A launcher is given jobs and says how they went; they know nothing of one another."""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol

from imagine_bench import registry
from imagine_bench.bench.cohort import side_by_side
from imagine_bench.bench.runs import Observer, Progress, RunSpec
from imagine_bench.errors import ImagineBenchError, InvalidValueError, SetupError, require_known
from imagine_bench.machine import usable_cores
from imagine_bench.store.files import make_folder, writing
from imagine_bench.task_types import task_type

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
}
"""Small networks are slower on two threads than on one, and bits repeat only at a fixed count."""
_LOG = "log.txt"
_POLL_S = 0.5
_PATIENCE_S = 5.0


@dataclass(frozen=True, kw_only=True)
class Job:
    """A run and where its files go."""

    spec: RunSpec
    folder: Path

    @property
    def log(self) -> Path:
        """Everything the run printed."""
        return self.folder / _LOG


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that did not finish, and why in one sentence."""

    job: Job
    reason: str

    @property
    def progress(self) -> Progress:
        """What an observer is told of it."""
        spec = self.job.spec
        return Progress(agent=spec.agent, seed=spec.seed, phase="failed", done=0, work=spec.work, detail=self.reason)


def cohorts(jobs: Sequence[Job], workers: int, abreast: int | None = None) -> list[tuple[Job, ...]]:
    """Jobs in groups of one agent that go on side by side in one process, in the order of their first jobs.

    Args:
        jobs: In the order in which they are wanted.
        workers: Processes at a time.
        abreast: Most jobs of a group; None shares out each agent's jobs among all workers, whatever agents cost.
    """
    found: list[tuple[Job, ...]] = []
    for agent in dict.fromkeys(job.spec.agent for job in jobs):
        same = tuple(job for job in jobs if job.spec.agent == agent)
        size = abreast or -(-len(same) // workers)
        found += [same[start : start + size] for start in range(0, len(same), size)]
    return sorted(found, key=lambda group: jobs.index(group[0]))


def require_runnable(workers: int, abreast: int | None) -> None:
    """Check how many jobs may go on at a time.

    Raises:
        InvalidValueError: Fewer than one worker, or fewer than one run abreast.
    """
    if workers < 1:
        raise InvalidValueError(f"{workers} workers cannot run anything; give at least 1.")
    if abreast is not None and abreast < 1:
        raise InvalidValueError(f"{abreast} runs abreast are none; give at least 1.")


LAUNCHERS = {"local": "imagine_bench.bench.launchers:LocalPool", "ray": "imagine_bench.bench.ray:RayCluster"}
"""Where runs can be carried out, by name."""


def launcher(name: str, workers: int | None = None, abreast: int | None = None) -> Launcher:
    """The launcher of that name.

    Args:
        name: One of :data:`LAUNCHERS`.
        workers: Processes at a time on this machine; None for one a core.
        abreast: Most runs of one agent side by side in a process; None for what the launcher thinks best.

    Raises:
        UnknownNameError: No such launcher.
        InvalidValueError: Fewer than one worker, or fewer than one run abreast.
        SetupError: It needs something that is not installed.
    """
    make = registry.load(LAUNCHERS[require_known("launcher", name, LAUNCHERS)])
    made: Launcher = make(usable_cores() if workers is None else workers, abreast)
    return made


class Launcher(Protocol):
    """Carries out jobs, somewhere."""

    def launch(self, jobs: Sequence[Job], on_progress: Observer) -> tuple[Failure, ...]:
        """Carry out every job, whatever becomes of the others.

        Args:
            jobs: Independent of one another; each resumes by itself.
            on_progress: Told now and then, from this process, how far each is, and at once of one that failed.

        Returns:
            The jobs that failed.
        """


class LocalPool:
    """Processes of this machine, each with one thread; none outlives this process, however it ends.

    Args:
        workers: Processes at a time.
        abreast: Most runs of one agent side by side in a process; None for the workers' equal shares.

    Raises:
        InvalidValueError: Fewer than one worker, or fewer than one run abreast.
    """

    def __init__(self, workers: int, abreast: int | None = None) -> None:
        require_runnable(workers, abreast)
        self._workers, self._abreast = workers, abreast

    def launch(self, jobs: Sequence[Job], on_progress: Observer) -> tuple[Failure, ...]:
        """Carry out every job, ``workers`` cohorts at a time, in order; see :class:`Launcher`."""
        waiting = cohorts(jobs, self._workers, self._abreast)[::-1]
        running: list[_Child] = []
        failures: list[Failure] = []
        try:
            while waiting or running:
                while waiting and len(running) < self._workers:
                    running.append(_Child(waiting.pop()))
                wait([source for child in running for source in child.sources], timeout=_POLL_S)
                for child in running:
                    child.forward(on_progress)
                ended = [child for child in running if child.ended]
                failures += [failure for child in ended for failure in child.failures(on_progress)]
                running = [child for child in running if child not in ended]
        finally:
            for child in running:  # all at once, so that a second interrupt meanwhile finds none at work
                child.process.terminate()
            for child in running:
                child.stop()
        return tuple(failures)


class _Child:
    """Jobs side by side in a process of their own."""

    def __init__(self, jobs: tuple[Job, ...]) -> None:
        self._jobs, self._failures = dict(enumerate(jobs)), list[Failure]()
        context = multiprocessing.get_context("spawn")  # a fork would inherit GL contexts and threads
        self._receiver, sender = context.Pipe(duplex=False)
        name = f"{jobs[0].spec.agent}/{jobs[0].folder.name}"
        self.process: BaseProcess = context.Process(target=_work, args=(jobs, sender), name=name, daemon=True)
        with _environment(ONE_THREAD), _interrupts_ignored():
            self.process.start()
        sender.close()

    @property
    def sources(self) -> list[Connection | int]:
        """What to wait for."""
        return [self.process.sentinel] if self._receiver.closed else [self._receiver, self.process.sentinel]

    @property
    def ended(self) -> bool:
        """Whether the process is gone and everything it sent was read."""
        return self._receiver.closed and not self.process.is_alive()

    def failures(self, on_progress: Observer) -> list[Failure]:
        """The jobs of this ended process that failed; one that said nothing died with the process."""
        for index in list(self._jobs):
            self._end(index, self._death, on_progress)
        return self._failures

    def _end(self, index: int, reason: str, on_progress: Observer) -> None:
        """Note that a job is over, and tell why if it failed."""
        job = self._jobs.pop(index)
        if reason:
            self._failures.append(Failure(job=job, reason=reason))
            on_progress(self._failures[-1].progress)

    @property
    def _death(self) -> str:
        code = self.process.exitcode or 0
        if code < 0:
            name = signal.Signals(-code).name
            return f"its process was killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
        return f"its process ended early with exit code {code}"

    def forward(self, on_progress: Observer) -> None:
        """Read what the process has sent so far."""
        while (message := self._next()) is not None:
            if isinstance(message, Progress):
                on_progress(message)
            else:
                self._end(*message, on_progress)

    def _next(self) -> Progress | tuple[int, str] | None:
        """What it sent next, or None for now; after the last message the process is gone."""
        try:
            return self._receiver.recv() if not self._receiver.closed and self._receiver.poll() else None
        except (EOFError, OSError):
            self._receiver.close()
            self.process.join(_PATIENCE_S)
            return None

    def stop(self) -> None:
        """End the process: its newest checkpoint is whole at any moment."""
        self.process.terminate()
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self._receiver.close()


def _work(jobs: tuple[Job, ...], sender: Connection) -> None:
    """The life of a worker process: its runs, and how each one ended, told to the parent."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    carry_out(jobs, sender.send, lambda index, reason: sender.send((index, reason)))


def run_job(job: Job, on_progress: Observer) -> None:
    """Carry out one job in this process."""
    registry.load(task_type(job.spec.protocol.task).run)(job.spec, job.folder, on_progress)


def carry_out(
    jobs: Sequence[Job],
    on_progress: Observer,
    on_end: Callable[[int, str], None],
    run: Callable[[Job, Observer], None] = run_job,
) -> None:
    """Carry out jobs side by side in this process; whatever becomes of one, the others go on.

    Args:
        jobs: What libraries print goes to the log of the first.
        on_progress: Told now and then how far each is.
        on_end: Told the index of each job that ends, and why it failed, or an empty string.
        run: What carries out one of them.
    """
    with suppress(SetupError):  # where that log cannot be written, its own run will say so
        _redirect_output(jobs[0])

    def work(index: int, job: Job) -> None:
        on_end(index, _reason(job, on_progress, run))

    side_by_side([functools.partial(work, index, job) for index, job in enumerate(jobs)])


def _reason(job: Job, on_progress: Observer, run: Callable[[Job, Observer], None]) -> str:
    """Carry out one job, with beginning and end in its log. Returns why it failed, or an empty string."""
    try:
        _log(job, f"{job.spec.agent} seed {job.spec.seed} begins or goes on")
        run(job, on_progress)
        _log(job, "done")
    except Exception as error:
        with suppress(SetupError):
            _log(job, traceback.format_exc())
        return str(error) if isinstance(error, ImagineBenchError) else f"{type(error).__name__}: {error}"
    return ""


def _redirect_output(job: Job) -> None:
    """Let everything this process prints, native libraries included, end in the job's log."""
    make_folder(job.folder)
    with writing(job.log):
        log = os.open(job.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)


def _log(job: Job, text: str) -> None:
    """Add a text with the time to the job's log."""
    make_folder(job.folder)
    with writing(job.log), job.log.open("a") as log:
        print(time.strftime("%Y-%m-%d %H:%M:%S"), text, file=log)


def _die_with_parent() -> None:
    """End this process when its parent has ended, by whatever death."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables for processes started within."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes started within ignore Ctrl-C, which a terminal sends to all: their parent ends them in order."""
    handler = None
    with suppress(ValueError):  # not in the main thread, where no Ctrl-C arrives either
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
