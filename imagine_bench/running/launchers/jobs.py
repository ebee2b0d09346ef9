"""Where runs are carried out. A launcher is given jobs and says how they went; they know nothing of one another."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError, SetupError, require_known
from imagine_bench.protocols.runs import Job, Launcher, OnProgress
from imagine_bench.registry.machine import usable_cores
from imagine_bench.running.task_types import task_type
from imagine_bench.store.files import make_folder, writing

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Small networks are slower on two threads than on one, and bits repeat only at a fixed count."""


def require_workers(workers: int) -> None:
    """Raise InvalidValueError unless there is at least one worker."""
    if workers < 1:
        raise InvalidValueError(f"{workers} workers cannot run anything; give at least 1.")


LAUNCHERS = {
    "local": "imagine_bench.running.launchers.local:LocalPool",
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
    return make(processes(workers))


def processes(workers: int | None) -> int:
    """How many processes work at a time: so many, or, of None, one a core."""
    return usable_cores() if workers is None else workers


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
