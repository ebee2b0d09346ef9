"""The same runs as jobs of a Slurm cluster, by submitit; where there is no Slurm, as plain processes of this machine.

The folder of the bench must be on a file system that all nodes share. Jobs ask for one core each; account, partition
and time limit come from sbatch's own variables, such as ``SBATCH_PARTITION``. A job that is preempted or reaches its
limit is queued again and goes on from its run's last checkpoint.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import submitit

from imagine_bench.cores import ONE_THREAD
from imagine_bench.protocols.data import Failure, Job, OnProgress, Progress
from imagine_bench.registry.loading import Registered, register, registered
from imagine_bench.running.launchers.jobs import absolute, carry_out
from imagine_bench.store.files import make_folder, write_bytes

_POLL_S = 1.0
_LIMIT_MIN = 24 * 60
"""Where ``SBATCH_TIMELIMIT`` says nothing."""
_QUEUED_AGAIN = 144
"""Exit code by which submitit's executor for one machine knows a job that is queued again; Slurm needs none."""
_LOST = 1000
"""Times that a job may reach its limit before its run counts as failed."""


class SlurmCluster:
    """``workers`` jobs in Slurm's queue at a time, at least 1."""

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job, in order; those in the queue are cancelled when this is interrupted."""
        waiting = [absolute(job) for job in jobs][::-1]
        failures = []
        queued: dict[submitit.Job[str], Job] = {}
        try:
            while waiting or queued:
                while waiting and len(queued) < self._workers:
                    job = waiting.pop()
                    queued[self._submit(job)] = job
                time.sleep(_POLL_S)
                for ticket, job in list(queued.items()):
                    news = _latest(job)
                    if news is not None:
                        on_progress(news)
                    if ticket.done():
                        del queued[ticket]
                        failure = Failure(job=job, reason=_reason(ticket))
                        if failure.reason:
                            failures.append(failure)
                            on_progress(failure.progress)
        finally:
            for ticket in queued:
                ticket.cancel()
        return tuple(failures)

    def _submit(self, job: Job) -> submitit.Job[str]:
        news = _news(job)
        news.unlink(missing_ok=True)
        executor = submitit.AutoExecutor(folder=make_folder(news.parent), slurm_max_num_timeout=_LOST)
        executor.update_parameters(
            name=f"{job.spec.agent}-{job.spec.seed}", cpus_per_task=1, timeout_min=_LIMIT_MIN,
            gpus_per_node=int(job.spec.protocol.device == "cuda"),
            slurm_setup=[f"export {name}={value}" for name, value in ONE_THREAD.items()],
        )  # fmt: skip
        return executor.submit(_Work(registered()), job)


class _Work:
    """The work of a node for a job; submitit asks it for the job to queue when this one must stop."""

    def __init__(self, there: Registered) -> None:
        self._there = there
        self._queued_again = False

    def __call__(self, job: Job) -> str:
        self._queued_again = False
        os.environ.update(ONE_THREAD)
        register(self._there)
        news = _news(job)
        reason = carry_out(job, lambda progress: write_bytes(news, json.dumps(dataclasses.asdict(progress)).encode()))
        if self._queued_again:  # submitit ends this process, which no run may
            sys.exit(_QUEUED_AGAIN)
        return reason

    def checkpoint(self, job: Job) -> submitit.helpers.DelayedSubmission:
        self._queued_again = True
        return submitit.helpers.DelayedSubmission(self, job)


def _news(job: Job) -> Path:
    """Where a node leaves how far it is."""
    return job.folder.parent / "slurm" / f"{job.folder.name}.json"


def _latest(job: Job) -> Progress | None:
    with suppress(OSError, ValueError, TypeError):  # not begun, or no file of ours
        return Progress(**json.loads(_news(job).read_bytes()))
    return None


def _reason(ticket: submitit.Job[str]) -> str:
    """Why an ended job's run failed, or an empty string."""
    try:
        reason: str = ticket.result()
    except Exception as error:  # whatever submitit raises for a job that was killed or could not begin
        return (
            f"Slurm job {ticket.job_id} ended early ({str(error).strip().splitlines()[-1]}); see {ticket.paths.stderr}"
        )
    return reason
