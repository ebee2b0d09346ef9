"""The same runs on a Ray cluster: a task a run, in a fresh process with one thread, resumed wherever it was lost.

The folder of the bench must be on a file system that all nodes share. A worker or a whole node that dies costs as much
as a
``kill -9`` costs locally, the time since the run's last checkpoint: Ray starts its task again elsewhere, which finds
that checkpoint.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence

import ray
from ray import ObjectRef
from ray.actor import ActorHandle

from imagine_bench.cores import ONE_THREAD
from imagine_bench.errors import BusyError, SetupError
from imagine_bench.protocols.data import Failure, Job, OnProgress, Progress
from imagine_bench.registry.loading import Registered, register, registered
from imagine_bench.running.launchers.jobs import absolute, carry_out, run_job

_LOST = 20
"""Times that a task may lose its worker or its node before its run counts as failed."""
_POLL_S = 0.5
_ANSWERS_WITHIN_S = 10.0
_FREED_WITHIN_S = 60.0
"""How long the process of a dead node may hold on to its run's folder."""


class RayCluster:
    """Tasks of the Ray cluster at ``RAY_ADDRESS``, or ``workers`` at a time of one started here for the purpose."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job. Raises SetupError: no cluster at ``RAY_ADDRESS``, or none with the GPU wanted."""
        self._connect()
        try:
            return _launch(jobs, on_progress)
        finally:
            ray.shutdown()

    def _connect(self) -> None:
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


def _launch(jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
    gpus = int(any(job.spec.protocol.device == "cuda" for job in jobs))
    if ray.cluster_resources().get("GPU", 0) < gpus:
        raise SetupError("No node of the Ray cluster has a GPU for device 'cuda'; add one, or use device 'cpu'.")
    here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
        ray.get_runtime_context().get_node_id(), soft=False
    )
    board = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
    work = ray.remote(
        num_cpus=1,
        num_gpus=gpus,
        max_calls=1,  # a fresh process for each run: no threads, GL contexts or open logs of another
        max_retries=_LOST,
        runtime_env={"env_vars": ONE_THREAD},
    )(_work)
    there = registered()
    running = {work.remote(absolute(job), board, there): job for job in jobs}
    failures = []
    while running:
        ended, _ = ray.wait(list(running), timeout=_POLL_S)
        for progress in ray.get(board.take.remote()):
            on_progress(progress)
        for task in ended:
            failure = Failure(job=running.pop(task), reason=_reason(task))
            if failure.reason:
                failures.append(failure)
                on_progress(failure.progress)
    for progress in ray.get(board.take.remote()):
        on_progress(progress)
    return tuple(failures)


def _reason(task: ObjectRef) -> str:
    """Why an ended task's run failed, or an empty string."""
    try:
        reason: str = ray.get(task)
    except ray.exceptions.RayTaskError as error:  # raised before the run could speak for itself
        return f"it could not begin ({error.cause!r})"
    except ray.exceptions.RayError as error:
        return f"it lost its worker or node {_LOST + 1} times ({str(error).splitlines()[0]})"
    return reason


class _Board:
    """Where tasks on any node leave how far they are, for the process that shows it."""

    def __init__(self) -> None:
        self._news: dict[tuple[str, str, int], Progress] = {}

    def put(self, progress: Progress) -> None:
        self._news[progress.bench, progress.agent, progress.seed] = progress

    def take(self) -> list[Progress]:
        news = list(self._news.values())
        self._news = {}
        return news


def _work(job: Job, board: ActorHandle, there: Registered) -> str:
    """A run. Returns why it failed, or an empty string."""
    register(there)
    return carry_out(job, board.put.remote, _run_when_free)


def _run_when_free(job: Job, on_progress: OnProgress) -> None:
    """Run; wait a while for the folder, which the worker of a node that just died may not have let go of yet."""
    deadline_s = time.monotonic() + _FREED_WITHIN_S
    while True:
        try:
            return run_job(job, on_progress)
        except BusyError:
            if time.monotonic() > deadline_s:
                raise
