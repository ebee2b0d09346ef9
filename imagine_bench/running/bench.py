"""From a task to its results: plan a protocol, run what is still missing, and read everything back from the files."""

from __future__ import annotations

import functools
import time
from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.errors import RunFailedError, SetupError, plain, require_modules
from imagine_bench.exact.certificate import Certificate, certificate
from imagine_bench.protocols.control import spec_of
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import Encoders, Failure, Job, Launcher, OnProgress, Progress, Result, RunSpec
from imagine_bench.registry.machine import describe_environment, gl_renderer
from imagine_bench.running.progress import ProgressBar
from imagine_bench.running.task_types import load_bench, require_options, task_type
from imagine_bench.store.bench_folder import BenchStore, bench_folder

_SAVE_EVERY_S = 10.0
_CHECK_DEVICE = "imagine_bench.agents.encoders.perception:prepare_torch"


def plan(task: str, preset: str, **options: Any) -> tuple[ProtocolData, Encoders]:
    """The protocol of a bench and the encoders it uses, with everything checked that can be before anything is run.

    ``options`` are fields of the protocol that differ from the preset's; for control tasks also ``encoder``, a bundled
    name or a path, and ``dataset``, a folder.

    Raises:
        UnknownNameError: Any name that does not exist.
        InvalidValueError: A value out of its range, or an option that tasks of this type do not take.
        ArtefactError: The task has no bundled encoder at this appearance level.
        SetupError: The device does not exist here.
    """
    require_options(task, options)
    wanted, paths = task_type(task).plan(task, preset, **options)
    if wanted.device != "cpu":
        registry.load(_CHECK_DEVICE)(wanted.device)  # loads torch, which the common case need not wait for
    return wanted, paths


def bench(wanted: ProtocolData, paths: Encoders, *, root: Path, launcher: Launcher) -> Result:
    """Run what is missing of a protocol, with the encoders that its agents need by kind, and read all of it.

    Raises:
        RunFailedError: Some runs failed; the others are done, and the message names the logs.
        BusyError: Another bench works in the same folder.
        SetupError: The folder cannot be written, there is no GL, or an extra of this package is not installed.
        ArtefactError: A file is damaged or foreign; it is left untouched.
    """
    folder = bench_folder(root, wanted)
    failures, missing = carry_out([(wanted, paths)], root=root, launcher=launcher)
    if failures:
        _raise(failures, missing)
    if not missing:
        print(f"All runs lie in {folder} already; nothing was run.")
        _warn(BenchStore(folder, wanted).changed(describe_environment()), folder)
    return load_bench(folder)


def carry_out(
    planned: Sequence[tuple[ProtocolData, Encoders]], *, root: Path, launcher: Launcher
) -> tuple[list[Failure], int]:
    """Run what is missing of several protocols as one piece of work, shown as one.

    Returns:
        The runs that failed, and how many were missing before. Raises as :func:`bench`, but for runs that fail.
    """
    require_modules("matplotlib", "PIL", "rerun")  # torch only where an agent is made of it
    with ExitStack() as held:
        work = list[_Bench]()
        missing = 0
        for wanted, paths in planned:
            store = BenchStore(bench_folder(root, wanted), wanted)
            held.enter_context(store.held())
            if store.missing():
                missing += len(store.missing())
                work.append((store, paths))
        if any(task_type(store.protocol.task).draws for store, _ in work):
            gl_renderer()  # fails here, in one sentence, rather than in every run
        environment = describe_environment() if work else {}
        for store, _ in work:
            _warn(store.begin_session(environment, certificate_of), store.folder)
        return _in_stages(work, launcher), missing


@functools.cache
def certificate_of(task: str, split: str | None) -> Certificate | None:
    """Return the exact facts of a task from the starts that tests have; None for a package's whose rules fail."""
    try:
        return certificate(spec_of(task, split, testing=True))
    except Exception as error:
        if registry.is_own(task):
            raise
        print(f"Note: {task} has no certificate ({type(error).__name__}: {plain(error)}).")
        return None


_Bench = tuple[BenchStore, Encoders]


def _in_stages(work: Sequence[_Bench], launcher: Launcher) -> list[Failure]:
    """Take all runs as far as their protocol's next stage, again and again; one that failed goes no further."""
    failures: list[Failure] = []
    specs = [_job(store, paths, *pair, None).spec for store, paths in work for pair in store.missing()]
    with ProgressBar(specs) as show:
        for index in range(max((len(store.protocol.stages) for store, _ in work), default=0)):
            jobs: list[Job] = []
            for store, paths in work:
                jobs += _next_jobs(store, paths, index, {failure.job.folder for failure in failures})
            if jobs:
                failures += launcher.launch(jobs, _saving_time([store for store, _ in work], show))
    for store, _ in work:
        store.save_time()
    return failures


def _next_jobs(store: BenchStore, paths: Encoders, index: int, failed: Collection[Path]) -> list[Job]:
    order = store.protocol.agents  # those listed last cost most and come first of each seed, so no worker idles
    if index >= len(store.protocol.stages):
        return []
    until = store.protocol.stages[index]
    pairs = sorted(store.missing(until), key=lambda pair: (pair[1], -order.index(pair[0])))
    jobs = [_job(store, paths, *pair, until) for pair in pairs]
    return [job for job in jobs if job.folder not in failed]


def _job(store: BenchStore, paths: Encoders, agent: str, seed: int, until: int | None) -> Job:
    acts = registry.has_task(store.protocol.task)
    entry = registry.agent_entry(agent) if acts else None  # regressors have no encoder and pause nowhere
    needed = paths[entry.encoder_kind] if entry is not None and entry.needs_encoder else None
    pauses = until if entry is not None and not entry.external_training_loop else None
    spec = RunSpec(
        protocol=store.protocol, agent=agent, seed=seed, encoder=needed, dataset=paths.get("dataset"), until=pauses
    )
    return Job(spec=spec, folder=store.run_folder(agent, seed))


def _saving_time(stores: Sequence[BenchStore], show: OnProgress) -> OnProgress:
    saved_s = time.monotonic()

    def observe(progress: Progress) -> None:
        nonlocal saved_s
        with suppress(OSError):  # nobody reads the screen any more; the runs go on
            show(progress)
        if time.monotonic() - saved_s > _SAVE_EVERY_S:
            with suppress(SetupError):  # a count of seconds stops no run; what they cannot write they say themselves
                for store in stores:
                    store.save_time()
            saved_s = time.monotonic()

    return observe


def _warn(changed: Sequence[str], folder: Path) -> None:
    if changed:
        print(
            f"Note: {folder} was begun with another {', '.join(changed)}. Runs it finished are kept as they are, "
            "others go on from their checkpoints with what is here now; give another folder with --out to run all of "
            "them anew."
        )


def _raise(failures: Sequence[Failure], jobs: int) -> None:
    lines = [f"{len(failures)} of {jobs} runs failed; the same command tries them again and keeps the others."]
    for failure in failures:
        spec = failure.job.spec
        lines.append(f"  {spec.agent} seed {spec.seed}: {failure.reason} Log: {failure.job.log}")
    raise RunFailedError("\n".join(lines))
