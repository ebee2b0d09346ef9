"""Where runs are carried out. A launcher is given jobs and says how they went; they know nothing of one another."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError, require_known
from imagine_bench.files import make_folder, writing
from imagine_bench.kinds import kind_of
from imagine_bench.runs import Observer, Progress, RunSpec

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


LAUNCHERS = {"local": "imagine_bench.launchers:LocalPool", "ray": "imagine_bench.launcher_ray:RayCluster"}
"""Where runs can be carried out, by name."""


def launcher(name: str, workers: int) -> Launcher:
    """The launcher of that name.

    Args:
        name: One of :data:`LAUNCHERS`.
        workers: Runs at a time on this machine.

    Raises:
        UnknownNameError: No such launcher.
        InvalidValueError: Fewer than one worker.
        SetupError: It needs something that is not installed.
    """
    make = registry.load(LAUNCHERS[require_known("launcher", name, LAUNCHERS)])
    made: Launcher = make(workers)
    return made


class Launcher(Protocol):
    """Carries out jobs, somewhere."""

    def launch(self, jobs: Sequence[Job], on_progress: Observer) -> tuple[Failure, ...]:
        """Carry out every job, whatever becomes of the others.

        Args:
            jobs: Independent of one another; each resumes by itself.
            on_progress: Told now and then, from this process, how far each is.

        Returns:
            The jobs that failed.
        """


class LocalPool:
    """Processes of this machine, each with one thread and one run; none outlives this process, however it ends.

    Args:
        workers: Runs at a time.

    Raises:
        InvalidValueError: Fewer than one worker.
    """

    def __init__(self, workers: int) -> None:
        if workers < 1:
            raise InvalidValueError(f"{workers} workers cannot run anything; give at least 1.")
        self._workers = workers

    def launch(self, jobs: Sequence[Job], on_progress: Observer) -> tuple[Failure, ...]:
        """Carry out every job, ``workers`` at a time, in order; see :class:`Launcher`."""
        waiting = list(reversed(jobs))
        running: list[_Child] = []
        failures: list[Failure] = []
        try:
            while waiting or running:
                while waiting and len(running) < self._workers:
                    running.append(_Child(waiting.pop()))
                wait([source for child in running for source in child.sources], timeout=_POLL_S)
                for child in running:
                    child.forward(on_progress)
                failures += [child.failure() for child in running if child.ended and child.reason]
                running = [child for child in running if not child.ended]
        finally:
            for child in running:
                child.stop()
        return tuple(failures)


class _Child:
    """One job in a process of its own."""

    def __init__(self, job: Job) -> None:
        self.job, self._reason, self._finished = job, "", False
        context = multiprocessing.get_context("spawn")  # a fork would inherit GL contexts and threads
        self._receiver, sender = context.Pipe(duplex=False)
        self.process: BaseProcess = context.Process(target=_work, args=(job, sender), name=job.log.parent.name)
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

    @property
    def reason(self) -> str:
        """Why the ended job failed; empty if it did not."""
        if self._finished or self._reason:
            return self._reason
        code = self.process.exitcode or 0
        if code < 0:
            name = signal.Signals(-code).name
            return f"its process was killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
        return f"its process ended early with exit code {code}"

    def failure(self) -> Failure:
        """The failure of this ended job."""
        return Failure(job=self.job, reason=self.reason)

    def forward(self, on_progress: Observer) -> None:
        """Read what the process has sent so far."""
        try:
            while not self._receiver.closed and self._receiver.poll():
                message = self._receiver.recv()
                if isinstance(message, Progress):
                    on_progress(message)
                elif isinstance(message, str):
                    self._reason = message
                else:
                    self._finished = True
        except (EOFError, OSError):
            self._receiver.close()
            self.process.join(_PATIENCE_S)

    def stop(self) -> None:
        """End the process: its newest checkpoint is whole at any moment."""
        self.process.terminate()
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self._receiver.close()


def _work(job: Job, sender: Connection) -> None:
    """The life of a worker process: one run, its output to the log, its end told to the parent."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    try:
        redirect_output(job)
        log_line(f"{job.spec.agent} seed {job.spec.seed} begins or goes on")
        registry.load(kind_of(job.spec.protocol.task).run)(job.spec, job.folder, sender.send)
        sender.send(None)
    except Exception as error:
        traceback.print_exc()
        sender.send(str(error) if isinstance(error, ImagineBenchError) else f"{type(error).__name__}: {error}")
        sys.exit(1)
    log_line("done")


def redirect_output(job: Job) -> None:
    """Let everything this process prints, native libraries included, end in the run's log."""
    make_folder(job.folder)
    with writing(job.log):
        log = os.open(job.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)


def log_line(line: str) -> None:
    """Print a line with the time."""
    print(time.strftime("%Y-%m-%d %H:%M:%S"), line, flush=True)


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
