"""Where runs are carried out. A launcher is given jobs and says how they went; they know nothing of one another.

The local pool is here: processes of this machine, none of which outlives this one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from unittest import mock

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError, SetupError, require_known
from imagine_bench.protocols.data import Failure, Job, Launcher, OnProgress, Progress
from imagine_bench.registry.machine import usable_cores
from imagine_bench.running.bench import task_type
from imagine_bench.store.files import make_folder, writing

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Small networks are slower on two threads than on one, and bits repeat only at a fixed count."""

_POLL_S = 0.5
_PATIENCE_S = 5.0


LAUNCHERS = {
    "local": f"{__name__}:LocalPool",
    "ray": "imagine_bench.running.launchers.ray:RayCluster",
    "slurm": "imagine_bench.running.launchers.slurm:SlurmCluster",
}
"""Where runs can be carried out, by name."""


def launcher(name: str, workers: int | None = None) -> Launcher:
    """The launcher of that name, with ``workers`` processes at a time on this machine; None for one a core.

    Raises:
        UnknownNameError: No such launcher.
        InvalidValueError: Fewer than one worker.
        SetupError: It needs something that is not installed.
    """
    make = registry.load(LAUNCHERS[require_known("launcher", name, LAUNCHERS)])
    return make(at_a_time(workers))


def at_a_time(workers: int | None) -> int:
    """So many processes, one a usable core for None. Raises InvalidValueError: fewer than one worker."""
    processes = usable_cores() if workers is None else workers
    if processes < 1:
        raise InvalidValueError(f"{workers} workers cannot run anything; give at least 1.")
    return processes


def absolute(job: Job) -> Job:
    """The job with paths that mean the same in every process."""
    paths = {name: getattr(job.spec, name) for name in ("encoder", "dataset")}
    spec = replace(job.spec, **{name: path.resolve() for name, path in paths.items() if path is not None})
    return replace(job, spec=spec, folder=job.folder.resolve())


def run_job(job: Job, on_progress: OnProgress) -> None:
    """Carry out one job in this process."""
    task_type(job.spec.protocol.task).run(job.spec, job.folder, on_progress)


def carry_out(job: Job, on_progress: OnProgress, run: Callable[[Job, OnProgress], None] = run_job) -> str:
    """Carry out a job in this process by ``run``; returns why it failed, or an empty string.

    Beginning and end are in its log, where all that libraries print goes too.
    """
    with suppress(SetupError):  # where the log cannot be written, the run will say so
        _redirect_output(job)
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


class LocalPool:
    """``workers`` processes of this machine at a time, at least 1; none outlives this process."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, ``workers`` at a time, in order; see :class:`Launcher`."""
        waiting = list(jobs)[::-1]
        running: list[_Child] = []
        failures: list[Failure] = []
        try:
            while waiting or running:
                while waiting and len(running) < self._workers:
                    running.append(_Child(waiting.pop()))
                wait([source for child in running for source in child.sources], timeout=_POLL_S)
                for child in running:
                    child.forward(on_progress)
                for child in [child for child in running if child.ended]:
                    running.remove(child)
                    if child.failure is not None:
                        failures.append(child.failure)
                        on_progress(child.failure.progress)
        finally:
            for child in running:  # all at once, so that a second interrupt meanwhile finds none at work
                child.process.terminate()
            for child in running:
                child.stop()
        return tuple(failures)


class _Child:
    """A job in a process of its own."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._reason: str | None = None
        context = multiprocessing.get_context("spawn")  # a fork would inherit GL contexts and threads
        self._receiver, sender = context.Pipe(duplex=False)
        name = f"{job.spec.agent}/{job.folder.name}"
        self.process: BaseProcess = context.Process(target=_work, args=(job, sender), name=name, daemon=True)
        with mock.patch.dict(os.environ, ONE_THREAD):
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
    def failure(self) -> Failure | None:
        """Why the job of this ended process failed, if it did; one that said nothing died with the process."""
        code = self.process.exitcode
        death = f"its process ended early with exit code {code} (-9: it was killed, such as for lack of memory)"
        reason = death if self._reason is None else self._reason
        return Failure(job=self._job, reason=reason) if reason else None

    def forward(self, on_progress: OnProgress) -> None:
        """Read what the process has sent so far."""
        while (message := self._next()) is not None:
            if isinstance(message, Progress):
                on_progress(message)
            else:
                self._reason = message

    def _next(self) -> Progress | str | None:
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


def _work(job: Job, sender: Connection) -> None:
    """The life of a worker process: its run, and why it failed or an empty string, told to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all: the parent ends its workers in order
    threading.Thread(target=_die_with_parent, daemon=True).start()
    sender.send(carry_out(job, sender.send))


def _die_with_parent() -> None:
    """End this process when its parent has ended, by whatever death."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
