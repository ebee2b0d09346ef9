"""The local pool: processes of this machine, none of which outlives this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from imagine_bench.protocols.runs import Failure, Job, OnProgress, Progress
from imagine_bench.registry.machine import usable_cores
from imagine_bench.running.launchers.jobs import ONE_THREAD, carry_out, require_workers

_POLL_S = 0.5
_PATIENCE_S = 5.0


class LocalPool:
    """``workers`` processes of this machine at a time, at least 1, sharing its cores; none outlives this process."""

    def __init__(self, workers: int) -> None:
        require_workers(workers)
        self._workers = workers

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, ``workers`` at a time, in order; see :class:`Launcher`."""
        cores = max(usable_cores() // max(min(self._workers, len(jobs)), 1), 1)
        waiting = list(jobs)[::-1]
        running: list[_Child] = []
        failures: list[Failure] = []
        try:
            while waiting or running:
                while waiting and len(running) < self._workers:
                    running.append(_Child(waiting.pop(), cores))
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

    def __init__(self, job: Job, cores: int) -> None:
        self._job = job
        given = replace(job, spec=replace(job.spec, cores=cores))
        self._reason: str | None = None
        context = multiprocessing.get_context("spawn")  # a fork would inherit GL contexts and threads
        self._receiver, sender = context.Pipe(duplex=False)
        name = f"{job.spec.agent}/{job.folder.name}"
        self.process: BaseProcess = context.Process(target=_work, args=(given, sender), name=name, daemon=True)
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
    def failure(self) -> Failure | None:
        """Why the job of this ended process failed, if it did; one that said nothing died with the process."""
        reason = self._death if self._reason is None else self._reason
        return Failure(job=self._job, reason=reason) if reason else None

    @property
    def _death(self) -> str:
        code = self.process.exitcode or 0
        if code < 0:
            name = signal.Signals(-code).name
            return f"its process was killed by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")
        return f"its process ended early with exit code {code}"

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
    threading.Thread(target=_die_with_parent, daemon=True).start()
    sender.send(carry_out(job, sender.send))


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
