"""Where runs are carried out. A launcher is given jobs and says how they went; they know nothing of one another.

The local pool is here: processes of this machine, none of which outlives this one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, TypeVar
from unittest import mock

from imagine_bench import registry
from imagine_bench.cores import ONE_THREAD, usable_cores
from imagine_bench.errors import ImagineBenchError, InvalidValueError, SetupError, require_known, writing
from imagine_bench.protocols.data import Failure, Job, Launcher, OnProgress
from imagine_bench.registry.loading import Registered, register, registered, script_left_out
from imagine_bench.running.bench import task_type
from imagine_bench.store.files import make_folder, make_plain

_POLL_S = 0.5
_PATIENCE_S = 5.0
_KILLED = "-9: it was killed, such as for lack of memory"
_SAFE = {**ONE_THREAD, "PYTHONSAFEPATH": "1"}
"""No module of the current folder stands for one of Python's own while a process starts."""
Item = TypeVar("Item")
News = TypeVar("News")


LAUNCHERS = {
    "local": f"{__name__}:LocalPool",
    "ray": "imagine_bench.running.launchers.ray:RayCluster",
    "slurm": "imagine_bench.running.launchers.slurm:SlurmCluster",
    "this_process": f"{__name__}:ThisProcess",
}
"""Where runs can be carried out, by name."""


def launcher(name: str, workers: int | None = None) -> Launcher:
    """The launcher of that name, with ``workers`` processes at a time on this machine; None for one a core.

    Raises:
        UnknownNameError: No such launcher.
        InvalidValueError: Fewer than one worker.
        SetupError: It needs something that is not installed.
    """
    where = LAUNCHERS[require_known("launcher", name, LAUNCHERS)]
    processes = at_a_time(workers)
    return registry.load(where)(processes)


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
    return _attempt(job, on_progress, run)


def _attempt(job: Job, on_progress: OnProgress, run: Callable[[Job, OnProgress], None]) -> str:
    """Carry out a job; returns why it failed, or an empty string."""
    try:
        _log(job, f"{job.spec.agent} seed {job.spec.seed} begins or goes on")
        run(job, on_progress)
        _log(job, "done")
    except (Exception, SystemExit) as error:
        with suppress(SetupError):
            _log(job, traceback.format_exc())
        make_plain(job.log)
        return str(error) if isinstance(error, ImagineBenchError) else f"{type(error).__name__}: {error}"
    return ""


def _redirect_output(job: Job) -> None:
    """Let everything this process prints, native libraries included, end in the job's log."""
    make_folder(job.folder)
    sys.stdout.flush()  # lines that an earlier job of this process left
    sys.stderr.flush()
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


class ThisProcess:
    """One run after another in this process, for a debugger: breakpoints stop, and the output of agents is seen."""

    def __init__(self, workers: int) -> None:
        del workers

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, in order; see :class:`Launcher`."""
        failures = []
        for job in jobs:
            reason = _attempt(job, on_progress, run_job)
            if reason:
                failures.append(Failure(job=job, reason=reason))
                on_progress(failures[-1].progress)
        return tuple(failures)


class LocalPool:
    """``workers`` processes of this machine at a time, at least 1; none outlives this process."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, ``workers`` at a time, in order; see :class:`Launcher`."""
        failures: list[Failure] = []

        def ended(job: Job, reason: str) -> None:
            if reason:
                failures.append(Failure(job=job, reason=reason))
                on_progress(failures[-1].progress)

        work_through(carry_out, jobs, workers=self._workers, on_news=on_progress, on_end=ended, fresh=_foreign)
        return tuple(failures)


def _foreign(job: Job) -> bool:
    """Whether a run is of other packages, whose code may change its whole process; ours may share one.

    So torch, MuJoCo and the like are loaded once a worker instead of once a run.
    """
    task = job.spec.protocol.task
    return not registry.is_own(task) or not registry.is_ours(registry.agent_entry(job.spec.agent).make)


def _never(item: object) -> bool:
    del item
    return False


def work_through(
    function: Callable[[Item, Callable[[News], None]], str],
    items: Sequence[Item],
    *,
    workers: int,
    on_news: Callable[[News], None],
    on_end: Callable[[Item, str], None],
    fresh: Callable[[Item], bool] = _never,
) -> None:
    """Carry out every item in one of so many processes of this machine, in order; none outlives this process.

    Args:
        function: Carries out an item and returns why that failed, or an empty text. Its second argument is a callback
            for news, such as progress.
        items: The items to carry out.
        workers: Processes at a time, at least 1.
        on_news: Called in this process with each piece of news of an item.
        on_end: Told of each item why it failed, or an empty text; a process that dies costs its item alone.
        fresh: Whether an item has a process of its own; else a process carries out one after another.
    """
    waiting = list(items)[::-1]
    idle: list[_Worker[Item, News]] = []
    busy: list[_Worker[Item, News]] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                item = waiting.pop()
                worker = idle.pop() if idle and not fresh(item) else _Worker(function)
                busy.append(worker)
                worker.begin(item)
            wait([source for worker in busy for source in worker.sources], timeout=_POLL_S)
            for worker in busy:
                worker.forward(on_news)
            for worker in [worker for worker in busy if worker.ended is not None]:
                busy.remove(worker)
                item, why = worker.take()
                if fresh(item) or not worker.process.is_alive():
                    worker.stop()
                else:
                    idle.append(worker)
                on_end(item, why)
    finally:
        for worker in [*busy, *idle]:  # all at once, so that a second interrupt meanwhile finds none at work
            worker.process.terminate()
        for worker in [*busy, *idle]:
            worker.stop()


class _Worker(Generic[Item, News]):
    """A process that carries out items, one at a time."""

    def __init__(self, function: Callable[[Item, Callable[[News], None]], str]) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would inherit GL contexts and threads
        self._pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(function, theirs, registered()), daemon=True)
        with mock.patch.dict(os.environ, _SAFE), script_left_out():
            self.process.start()
        theirs.close()
        self._item: Item
        self.ended: str | None = None
        """Why the item failed or an empty text, once that is known."""

    @property
    def sources(self) -> list[Connection | int]:
        """The pipe and the end of the process, to wait for."""
        return [self._pipe, self.process.sentinel]

    def begin(self, item: Item) -> None:
        """Hand over an item."""
        self._item = item
        with suppress(OSError):  # it is dead, which is seen below
            self._pipe.send(item)

    def forward(self, on_news: Callable[[News], None]) -> None:
        """Read the messages of the process so far."""
        while self.ended is None and self._pipe.poll():
            try:
                ends, message = self._pipe.recv()
            except (EOFError, ConnectionError):
                self.process.join(_PATIENCE_S)
                self.ended = f"its process ended early with exit code {self.process.exitcode} ({_KILLED})"
                return
            if ends:
                self.ended = message
            else:
                on_news(message)

    def take(self) -> tuple[Item, str]:
        """The item that has ended, and why it failed or an empty text."""
        ended = self.ended or ""
        self.ended = None
        return self._item, ended

    def stop(self) -> None:
        """End the process: its newest checkpoint is whole at any moment."""
        self._pipe.close()  # one that has ended its items ends by itself then
        self.process.join(_PATIENCE_S)
        self.process.terminate()
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _work(function: Callable[[Item, Callable[[News], None]], str], pipe: Connection, there: Registered) -> None:
    """The life of a worker process: it receives items, and sends the news of each and why it failed, if it did."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all: the parent ends its workers in order
    threading.Thread(target=_die_with_parent, daemon=True).start()
    register(there)
    with suppress(EOFError):  # the parent has nothing more
        while True:
            item = pipe.recv()
            pipe.send((True, function(item, lambda news: pipe.send((False, news)))))


def _die_with_parent() -> None:
    """End this process when its parent has ended, by whatever death."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
