"""From a protocol to a report: what is still missing is run, and everything is read back from the files."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.bench.launchers import Failure, Job, Launcher
from imagine_bench.bench.progress import ProgressBars
from imagine_bench.bench.protocol import Protocol, digest, protocol
from imagine_bench.bench.queries import require_able
from imagine_bench.bench.runs import Observer, Progress, RunSpec
from imagine_bench.errors import InvalidValueError, RunFailedError, SetupError, UnknownNameError
from imagine_bench.machine import describe_environment, gl_renderer
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_folder, load_bench
from imagine_bench.task_types import require_options, task_type

_CHECK_DEVICE = "imagine_bench.agents.encoders.perception:prepare_torch"
_NOTE_EVERY_S = 10.0


Encoders = Mapping[str, Path]
"""The encoder artefacts of a bench, by kind; none where nothing needs one."""


def plan(task: str, preset: str, **options: Any) -> tuple[Any, Encoders]:
    """The protocol of a bench and the encoders it uses, with everything checked that can be before anything is run.

    Args:
        task: Registered task of any kind.
        preset: Name of a protocol preset.
        options: Fields of the kind's protocol that differ from the preset's; for control tasks, ``encoder`` may be a
            bundled name or a path.

    Raises:
        UnknownNameError: Any name that does not exist; the message lists those that do.
        InvalidValueError: A value out of its range, or an option that tasks of this kind do not take.
        ArtefactError: The task has no bundled encoder at this appearance level.
        SetupError: The device does not exist here.
    """
    require_options(task, {name: value for name, value in options.items() if name != "encoder"})
    planned: tuple[Any, Encoders] = registry.load(task_type(task).plan)(task, preset, **options)
    return planned


def plan_control(task: str, preset: str, *, encoder: str | None = None, **changes: object) -> tuple[Protocol, Encoders]:
    """The protocol of a control bench and the encoders it uses.

    Args:
        task: Registered task.
        preset: Name of a protocol preset.
        encoder: Bundled name or path, instead of the task's own. One that gives codes is for every agent, one that
            gives latents for those that read latents.
        changes: Fields of the protocol that differ from the preset's.

    Raises:
        UnknownNameError: Any name that does not exist; the message lists those that do.
        InvalidValueError: A value out of its range, or something that an agent cannot do.
        ArtefactError: The task has no bundled encoder at this appearance level.
        SetupError: The device does not exist here.
    """
    wanted = protocol(task, preset, **changes)
    filled = {"settings_digest": digest(resolved_settings(wanted))}
    if wanted.device != "cpu":
        registry.load(_CHECK_DEVICE)(wanted.device)  # loads torch, which the common case need not wait for
    paths = _encoders(wanted, encoder)
    names = {"encoder": "latents", "codes": "codes"}
    filled |= {field: encoders.identity(paths[kind]) for field, kind in names.items() if kind in paths}
    whole = protocol(task, preset, **{**changes, **filled})
    rests_on_others = any(map(_rests_on_others, whole.agents))
    if encoder or whole.after or whole.demonstrations or whole.questions or rests_on_others:
        _check_abilities(whole, paths)
    return whole, paths


def _rests_on_others(agent: str) -> bool:
    """Whether code decides that may not be there: a library that is an extra, or a package that offers the agent."""
    return registry.agent_entry(agent).external_training_loop or agent not in registry.AGENTS


def _check_abilities(wanted: Protocol, paths: Encoders) -> None:
    """Build every learner once, to see whether it can use its encoder and do what only some can."""
    for agent in wanted.agents:
        entry = registry.agent_entry(agent)
        if entry.learns:
            encoder = paths[entry.encoder_kind] if entry.needs_encoder else None
            spec = RunSpec(protocol=wanted, agent=agent, seed=wanted.seeds[0], encoder=encoder)
            require_able(registry.make_agent(agent, spec.context()), agent, wanted)


def resolved_settings(wanted: Protocol) -> dict[str, Any]:
    """All settings of every learner by its name, each override checked by the agents that have such a setting.

    Raises:
        UnknownNameError: No agent of the protocol has it; the message lists what there is.
        InvalidValueError: A value of the wrong type or out of its range.
    """
    overrides = dict(wanted.overrides)
    known = {name for agent in wanted.agents for name in registry.setting_names(agent)} if overrides else set()
    for name in overrides:
        if name not in known:
            raise UnknownNameError("setting", name, sorted(known))
    found = {agent: registry.settings(agent, wanted.preset, overrides, wanted.settings) for agent in wanted.agents}
    return {agent: dataclasses.asdict(found[agent]) for agent in wanted.agents if registry.agent_entry(agent).learns}


def _encoders(wanted: Protocol, given: str | None) -> Encoders:
    """The artefact of each kind that an agent needs; a given one is there whether or not any does."""
    entries = [registry.agent_entry(agent) for agent in wanted.agents]
    needed = {entry.encoder_kind for entry in entries if entry.needs_encoder}
    spec = registry.task(wanted.task)
    if given is None:
        return {kind: encoders.resolve(spec, wanted.appearance, kind=kind) for kind in sorted(needed)}
    path = encoders.resolve(spec, wanted.appearance, given)
    kind = encoders.kind(path)
    if needed and kind == "latents" and kind not in needed:
        raise InvalidValueError(
            f"No agent of this bench reads the latents that encoder {path.stem!r} gives; give one made with "
            "'imagine-bench encoder --recipe codes', or leave --encoder out."
        )
    replaced = needed | {kind} if kind == "codes" else {kind}
    own = {other: encoders.resolve(spec, wanted.appearance, kind=other) for other in sorted(needed - replaced)}
    return {**own, **dict.fromkeys(sorted(replaced), path)}


def bench(wanted: Any, paths: Encoders, *, root: Path, launcher: Launcher) -> Any:
    """Run what is missing of a protocol, and read all of it.

    Args:
        wanted: What is compared: a protocol of any kind.
        paths: The encoder artefacts that its agents need, by kind.
        root: Folder of all benches.
        launcher: Carries out the runs.

    Returns:
        The result class of the task's kind.

    Raises:
        RunFailedError: Some runs failed; the others are done, and the message names the logs.
        BusyError: Another bench works in the same folder.
        SetupError: The folder cannot be written, or there is no GL.
        ArtefactError: A file is damaged or foreign; it is left untouched.
    """
    store = BenchStore(bench_folder(root, wanted), wanted)
    store.open()
    with store.lock():
        missing = len(store.missing())
        if missing:
            if task_type(store.protocol.task).draws:
                gl_renderer()  # fails here, in one sentence, rather than in every run
            _warn(store.begin_session(describe_environment()), store.folder)
            failures = _in_stages(store, paths, launcher)
            store.note_time()
            _raise_if_any(failures, missing)
        else:
            print(f"All runs lie in {store.folder} already; nothing was run.")
            _warn(store.changed(describe_environment()), store.folder)
    return load_bench(store.folder)


def _in_stages(store: BenchStore, paths: Encoders, launcher: Launcher) -> list[Failure]:
    """Take all runs as far as the protocol's next stage, again and again; one that failed goes no further."""
    failures: list[Failure] = []
    specs = [_job(store, paths, *pair, None).spec for pair in store.missing()]
    with ProgressBars(specs, _done_before(store)) as show:
        for until in store.protocol.stages:
            failed = {(failure.job.spec.agent, failure.job.spec.seed) for failure in failures}
            pairs = [pair for pair in store.missing(until) if pair not in failed]
            jobs = [_job(store, paths, *pair, until) for pair in pairs]
            if jobs:
                failures += launcher.launch(jobs, _noting_time(store, show))
    return failures


def _done_before(store: BenchStore) -> dict[tuple[str, int], int]:
    """How much of each unfinished run lies before its last test; only runs that act are tested on the way."""
    if store.protocol.task not in registry.TASKS:
        return {}
    reached = {pair: run_folder.reached(store.run_folder(*pair)) for pair in store.missing()}
    return {pair: store.protocol.work(pair[0], until) for pair, until in reached.items() if until}


def _job(store: BenchStore, paths: Encoders, agent: str, seed: int, until: int | None) -> Job:
    acts = store.protocol.task in registry.TASKS
    entry = registry.agent_entry(agent) if acts else None  # regressors have no encoder and rest nowhere
    needed = paths[entry.encoder_kind] if entry is not None and entry.needs_encoder else None
    rests = until if entry is not None and not entry.external_training_loop else None
    spec = RunSpec(protocol=store.protocol, agent=agent, seed=seed, encoder=needed, until=rests)
    return Job(spec=spec, folder=store.run_folder(agent, seed))


def _noting_time(store: BenchStore, show: Observer) -> Observer:
    noted_s = time.monotonic()

    def observe(progress: Progress) -> None:
        nonlocal noted_s
        with suppress(OSError):  # nobody reads the screen any more; the runs go on
            show(progress)
        if time.monotonic() - noted_s > _NOTE_EVERY_S:
            with suppress(SetupError):  # a count of seconds stops no run; what they cannot write they say themselves
                store.note_time()
            noted_s = time.monotonic()

    return observe


def _warn(changed: Sequence[str], folder: Path) -> None:
    if changed:
        print(
            f"Note: {folder} was begun with another {', '.join(changed)}. Runs it finished are kept as they are, "
            "others go on from their checkpoints with what is here now; give another folder with --out to run all of "
            "them anew."
        )


def _raise_if_any(failures: Sequence[Failure], jobs: int) -> None:
    if failures:
        lines = [
            f"  {failure.job.spec.agent} seed {failure.job.spec.seed}: {failure.reason} Log: {failure.job.log}"
            for failure in failures
        ]
        raise RunFailedError(
            f"{len(failures)} of {jobs} runs failed; the same command tries them again and keeps the others.\n"
            + "\n".join(lines)
        )
