"""The same runs on a Ray cluster: a task a cohort, in a fresh process with one thread, resumed wherever it was lost.

The folder of the bench must be on a file system that all nodes share. A worker or a whole node that dies costs what a
``kill -9`` costs locally, the time since the run's last checkpoint: Ray starts its task again elsewhere, which finds
that checkpoint.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from imagine_bench.bench.launchers import ONE_THREAD, Failure, Job, carry_out, cohorts, require_runnable, run_job
from imagine_bench.bench.runs import Observer, Progress
from imagine_bench.errors import BusyError, SetupError

_LOST = 20
"""Times that a task may lose its worker or its node before its runs count as failed."""
_POLL_S = 0.5
_ANSWERS_WITHIN_S = 10.0
_FREED_WITHIN_S = 60.0
"""How long the process of a dead node may hold on to its run's folder."""


class RayCluster:
    """Tasks of the Ray cluster at ``RAY_ADDRESS``, or of one started here for the purpose.

    Args:
        workers: Tasks at a time on a cluster started here; an existing one runs as many as it has CPUs.
        abreast: Most runs of one agent side by side in a task; None for one.

    Raises:
        InvalidValueError: Fewer than one worker, or fewer than one run abreast.
        SetupError: Ray is not installed.
    """

    def __init__(self, workers: int, abreast: int | None = None) -> None:
        require_runnable(workers, abreast)
        try:
            import ray  # noqa: F401, PLC0415 - an optional dependency
        except ImportError as error:
            raise SetupError("The launcher 'ray' needs Ray: pip install 'imagine-bench[ray]'.") from error
        self._workers, self._abreast = workers, abreast or 1

    def launch(self, jobs: Sequence[Job], on_progress: Observer) -> tuple[Failure, ...]:
        """Carry out every job; see :class:`imagine_bench.bench.launchers.Launcher`.

        Raises:
            SetupError: There is no cluster at ``RAY_ADDRESS``, or none with the GPU that the runs ask for.
        """
        import ray  # noqa: PLC0415 - as above

        self._connect(ray)
        try:
            return _launch(ray, cohorts(jobs, self._workers, self._abreast), on_progress)
        finally:
            ray.shutdown()

    def _connect(self, ray: Any) -> None:
        address = os.environ.get("RAY_ADDRESS")
        local = {} if address else {"num_cpus": self._workers, "include_dashboard": False}
        try:
            _require_listening(address)
            ray.init(address=address or "local", log_to_driver=False, logging_level="ERROR", **local)
        except (OSError, ValueError) as error:
            reason = str(error).splitlines()[0].rstrip(".")
            raise SetupError(
                f"No Ray cluster answers at RAY_ADDRESS={address} ({reason}); start one, or unset it."
            ) from error


def _require_listening(address: str | None) -> None:
    """Raise OSError where nothing listens at ``host:port``: Ray itself would try for minutes, or end the process."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_ANSWERS_WITHIN_S).close()


def _launch(ray: Any, groups: Sequence[tuple[Job, ...]], on_progress: Observer) -> tuple[Failure, ...]:
    gpus = int(any(job.spec.protocol.device == "cuda" for group in groups for job in group))
    if ray.cluster_resources().get("GPU", 0) < gpus:
        raise SetupError("No node of the Ray cluster has a GPU for device 'cuda'; add one, or use device 'cpu'.")
    here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
        ray.get_runtime_context().get_node_id(), soft=False
    )
    board = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
    work = ray.remote(
        num_cpus=1,
        num_gpus=gpus,
        max_calls=1,  # a fresh process for each cohort: no threads, GL contexts or open logs of another
        max_retries=_LOST,
        runtime_env={"env_vars": ONE_THREAD},
    )(_work)
    running = {work.remote([_absolute(job) for job in group], board): group for group in groups}
    failures = []
    while running:
        ended, _ = ray.wait(list(running), timeout=_POLL_S)
        for progress in ray.get(board.take.remote()):
            on_progress(progress)
        for task in ended:
            group = running.pop(task)
            reasons = _reasons(ray, task, len(group))
            failed = [Failure(job=job, reason=reason) for job, reason in zip(group, reasons, strict=True) if reason]
            for failure in failed:
                on_progress(failure.progress)
            failures += failed
    for progress in ray.get(board.take.remote()):
        on_progress(progress)
    return tuple(failures)


def _absolute(job: Job) -> Job:
    """The job with paths that mean the same in every process."""
    encoder = job.spec.encoder
    spec = replace(job.spec, encoder=None if encoder is None else encoder.resolve())
    return replace(job, spec=spec, folder=job.folder.resolve())


def _reasons(ray: Any, task: Any, count: int) -> list[str]:
    """Why each of an ended task's runs failed, or empty strings."""
    try:
        reasons: list[str] = ray.get(task)
    except ray.exceptions.RayTaskError as error:  # raised before the runs could speak for themselves
        return [f"it could not begin ({error.cause!r})"] * count
    except ray.exceptions.RayError as error:
        return [f"it lost its worker or node {_LOST + 1} times ({str(error).splitlines()[0]})"] * count
    return reasons


class _Board:
    """Where tasks on any node leave how far they are, for the process that shows it."""

    def __init__(self) -> None:
        self._news: dict[tuple[str, int], Progress] = {}

    def put(self, progress: Progress) -> None:
        self._news[progress.agent, progress.seed] = progress

    def take(self) -> list[Progress]:
        news, self._news = list(self._news.values()), {}
        return news


def _work(jobs: Sequence[Job], board: Any) -> list[str]:
    """Runs side by side. Returns why each failed, or empty strings."""
    reasons = [""] * len(jobs)
    carry_out(jobs, board.put.remote, reasons.__setitem__, _run_when_free)
    return reasons


def _run_when_free(job: Job, on_progress: Observer) -> None:
    """Run; wait a while for the folder, which the worker of a node that just died may not have let go of yet."""
    deadline_s = time.monotonic() + _FREED_WITHIN_S
    while True:
        try:
            return run_job(job, on_progress)
        except BusyError:
            if time.monotonic() > deadline_s:
                raise
