"""From a task to its results: plan a protocol, carry out the missing runs, and read everything back from the files.

A *control* task is acted in, by agents that learn from episodes; a *regression* task is learned from data, by
regressors. Launchers, locks, run folders, progress, store and command line are the same for both types.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from imagine_bench import registry
from imagine_bench.errors import (
    ArtefactError,
    InvalidValueError,
    RunFailedError,
    UnknownNameError,
    plain,
    require_modules,
)
from imagine_bench.exact.certificate import Certificate, certificate
from imagine_bench.protocols.control import Protocol, spec_of
from imagine_bench.protocols.data import (
    RECENT,
    Encoders,
    Failure,
    Job,
    Launcher,
    Progress,
    ProtocolData,
    Result,
    RunSpec,
    TaskType,
)
from imagine_bench.registry.machine import describe_environment, gl_renderer
from imagine_bench.store import encoders, loading
from imagine_bench.store.bench_folder import (
    BenchStore,
    as_begun,
    bench_folder,
    is_archive,
    read_protocol_as,
    read_protocol_values,
    with_other_code,
)

Item = TypeVar("Item")
RunKey = tuple[str, str, int]
"""Hash of its protocol, agent and seed of a run."""

_LINE_EVERY_S = 15.0
"""Between two lines where nobody watches a terminal."""
_CURVES_EVERY_S = 60.0


class ProgressBar(AbstractContextManager["ProgressBar"]):
    """Shows :class:`~imagine_bench.protocols.data.Progress` on a terminal as a bar, elsewhere as a line now and then.

    Every minute, the first one after a minute, the runs at work show their training so far as a curve of characters.
    ``specs`` are the runs to come.
    """

    def __init__(self, specs: Sequence[RunSpec[ProtocolData]]) -> None:
        self._specs = {(spec.protocol.hash, spec.agent, spec.seed): spec for spec in specs}
        self._costs = {run: expected_cost(spec) for run, spec in self._specs.items()}
        self._done = dict.fromkeys(self._costs, 0.0)
        self._before = dict[RunKey, float]()
        self._finished = set[RunKey]()
        self._curves = dict[RunKey, dict[int, float]]()
        self._began_s = self._shown_s = self._drawn_s = time.monotonic()
        form = "{percentage:3.0f} % |{bar:20}| {desc}"
        total = sum(self._costs.values())
        self._bar = tqdm(total=total, bar_format=form, leave=False, disable=not sys.stderr.isatty())

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def __call__(self, progress: Progress) -> None:
        """Show how far a run is."""
        with suppress(OSError):  # nobody reads the screen any more; the runs go on
            self._show(progress)

    def _show(self, progress: Progress) -> None:
        run = (progress.bench, progress.agent, progress.seed)
        if progress.phase == "failed":  # its missing work will not be done
            self._costs[run] = self._done[run]
            tqdm.write(plain(f"{progress.agent} seed {progress.seed} failed: {progress.detail}"), file=sys.stderr)
            return
        spec = self._specs[run]
        done = self._costs[run] * progress.done / spec.work
        self._before.setdefault(run, done)  # work of an earlier session took no time now
        self._done[run] = done
        if progress.phase == "training" and progress.success is not None:
            self._curves.setdefault(run, {})[progress.episode // RECENT] = progress.success
        ended = progress.phase == "done"
        if ended:
            self._finished.add(run)
            self._curves.pop(run, None)
        sentence = plain(
            f"{len(self._finished)}/{len(self._costs)} runs · {self._times()} · {_sentence(progress, spec)}"
        )
        now_s = time.monotonic()
        if not self._bar.disable:
            self._bar.total = sum(self._costs.values())
            self._bar.n = sum(self._done.values())
            self._bar.set_description_str(sentence)
        elif ended or now_s - self._shown_s > _LINE_EVERY_S:
            self._shown_s = now_s
            print(sentence, file=sys.stderr, flush=True)
        if now_s - self._drawn_s > _CURVES_EVERY_S:
            self._drawn_s = now_s
            for (_, agent, seed), curve in self._curves.items():
                tqdm.write(f"  {_curve(curve)} {agent} seed {seed}: training, each {RECENT} episodes", file=sys.stderr)

    def _times(self) -> str:
        """Time gone and, once there is something to judge by, time left."""
        gone_s = time.monotonic() - self._began_s
        done = sum(self._done.values())
        played = done - sum(self._before.values())
        missing = sum(self._costs.values()) - done
        left = f", about {_roughly(gone_s * missing / played)} left" if played > 0.0 else ""
        return f"{tqdm.format_interval(gone_s)} elapsed{left}"


def expected_cost(spec: RunSpec[ProtocolData]) -> float:
    """The whole cost of a run, in units of its work by an agent of cost 1."""
    acts = registry.has_task(spec.protocol.task)
    return spec.work * (registry.agent_entry(spec.agent).relative_cost if acts else 1.0)


def _roughly(seconds: float) -> str:
    """A time to come in whole seconds, minutes or hours."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _curve(shares: Mapping[int, float]) -> str:
    """Shares by place as bars of characters, from none to all; a place that was not heard of is a blank."""
    bars = "▁▂▃▄▅▆▇█"
    heights = {place: min(int(len(bars) * share), len(bars) - 1) for place, share in shares.items()}
    return "".join(bars[heights[place]] if place in heights else " " for place in range(max(shares) + 1))


class Counted(AbstractContextManager["Counted"]):
    """Shows how many of ``total`` are done: on a terminal as a bar, elsewhere as a line now and then."""

    def __init__(self, what: str, *, total: int) -> None:
        self._what = what
        self._total = total
        self._done = 0
        self._began_s = time.monotonic()
        self._shown_s = self._began_s
        self._bar = tqdm(desc=what, total=total, leave=False, disable=not sys.stderr.isatty())

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def step(self) -> None:
        """One more is done."""
        self._bar.update()
        self._done += 1
        now_s = time.monotonic()
        if self._bar.disable and now_s - self._shown_s > _LINE_EVERY_S:
            self._shown_s = now_s
            gone_s = now_s - self._began_s
            left_s = gone_s * (self._total - self._done) / self._done
            times = f"{tqdm.format_interval(gone_s)} gone, {tqdm.format_interval(left_s)} left"
            with suppress(OSError):  # nobody reads the screen any more
                print(f"{self._what}: {self._done} of {self._total}, {times}", file=sys.stderr, flush=True)


def counted(items: Iterable[Item], what: str, *, total: int) -> Iterator[Item]:
    """The items, counted as :class:`Counted` shows it; ``what`` is their name on the screen."""
    with Counted(what, total=total) as counting:
        for item in items:
            yield item
            counting.step()


def _sentence(progress: Progress, spec: RunSpec[ProtocolData]) -> str:
    """The phase of a run, and how far it is."""
    who = f"{progress.agent} seed {progress.seed}"
    if progress.detail is not None or not isinstance(spec.protocol, Protocol):
        return f"{who}: {progress.detail or progress.phase}, {100 * progress.done / spec.work:.0f} % of its work"
    doing = f"episode {progress.episode:,} of {spec.protocol.budgets[-1]:,}"
    solved = "" if progress.success is None else f"{100 * progress.success:.0f} %"
    if progress.phase == "training":
        return f"{who}: {doing}" + (f", last {RECENT} solved {solved}" if solved else "")
    at = f" at {doing}" if progress.episode and progress.phase != "done" else ""
    of_tests = solved and at and progress.phase == "testing"
    return f"{who}: {progress.phase}{at}" + (f", solved {solved}" if of_tests else "")


_CHECK_DEVICE = "imagine_bench.agents.encoders.perception:prepare_torch"


TASK_TYPES = {
    "control": "imagine_bench.running.control:CONTROL",
    "regression": "imagine_bench.regression.runner:REGRESSION",
}
"""The types of task, each the ``"module:attr"`` of a :class:`.TaskType`."""


@functools.cache
def task_types() -> dict[str, TaskType[ProtocolData]]:
    """Return the types by name."""
    return {name: registry.load(target) for name, target in TASK_TYPES.items()}


def task_type(task: str) -> TaskType[ProtocolData]:
    """Return the type of a task, be it with options or without.

    Raises UnknownNameError, or SetupError: as :func:`.registry.task_entry`.
    """
    for kind in task_types().values():
        if task in kind.tasks() or task.partition(":")[0] in kind.tasks():
            return kind
    for group in (registry.TASK_GROUP, registry.REGRESSION_GROUP):
        with suppress(UnknownNameError):
            registry.offered(task, {}, group)
    raise UnknownNameError("task", task, [name for kind in task_types().values() for name in kind.tasks()])


def _fields(kind: TaskType[ProtocolData]) -> set[str]:
    """The names of the values that protocols of a type have."""
    return {field.name for field in dataclasses.fields(kind.protocol)}


def _type_of_bench(folder: Path) -> TaskType[ProtocolData]:
    """The type of a bench folder's task, be the package of its task here or not."""
    values = read_protocol_values(folder)
    for kind in task_types().values():
        if values.keys() <= _fields(kind):
            return kind
    raise ArtefactError(f"{folder} is no bench of this version: no type of task has its values. It was left untouched.")


def read_protocol(folder: Path) -> ProtocolData:
    """Return the protocol of a bench folder. Raises ArtefactError: it is missing or damaged."""
    return read_protocol_as(folder, _type_of_bench(folder).protocol)


def load_so_far(folder: Path) -> Result:
    """Read a bench as far as it can be reported, finished or not, or in the form in which it is kept for good.

    Raises:
        ArtefactError: It is no bench, there is nothing to report yet, a file is damaged, or it is kept for good and of
            a regression task, whose tables are files of their own.
    """
    return loading.load_so_far(folder) if is_archive(folder) else _type_of_bench(folder).load_so_far(folder)


def load_bench(folder: Path) -> Result:
    """Read a finished bench. Raises ArtefactError: it is no bench, runs are missing, or a file is damaged."""
    result = load_so_far(folder)
    if result.missing:
        raise ArtefactError(
            f"{folder} lacks {'; '.join(result.missing)}. Run the same bench command again to complete it."
        )
    return result


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
    kind = task_type(task)
    for name in options:
        if name not in _fields(kind):
            raise InvalidValueError(f"{task} takes no --{name.replace('_', '-')}; leave it out.")
    wanted, paths = kind.plan(task, preset, **options)
    if wanted.device != "cpu":
        registry.load(_CHECK_DEVICE)(wanted.device)  # loads torch, which the common case need not wait for
    return wanted, paths


def bench(wanted: ProtocolData, paths: Encoders, *, root: Path, launcher: Launcher) -> Result:
    """Carry out the missing runs of a protocol, with the encoders that its agents need by kind, and read all of it.

    Raises:
        RunFailedError: Some runs failed; the others are done, and the message names the logs.
        BusyError: Another bench works in the same folder.
        SetupError: The folder cannot be written, there is no GL, or an extra of this package is not installed.
        ArtefactError: A file is damaged or foreign; it is left untouched.
    """
    wanted = as_begun(root, wanted)
    folder = bench_folder(root, wanted)
    failures, missing = carry_out([(wanted, paths)], root=root, launcher=launcher)
    require_done(failures, missing)
    if not missing:
        print(f"All runs lie in {folder} already; nothing was run.")
        _warn(BenchStore(folder, wanted).changed(describe_environment()), folder)
    return load_bench(folder)


def require_done(failures: Sequence[Failure], jobs: int) -> None:
    """Raise RunFailedError if some of so many runs failed."""
    if failures:
        line = f"{len(failures)} of {jobs} runs failed; the same command tries them again and keeps the others."
        raise RunFailedError("\n  ".join([line, *map(str, failures)]))


def carry_out(
    planned: Sequence[tuple[ProtocolData, Encoders]], *, root: Path, launcher: Launcher
) -> tuple[list[Failure], int]:
    """Carry out the missing runs of several protocols as one piece of work, shown as one.

    Returns:
        The runs that failed, and how many were missing before. Raises as :func:`bench`, but for runs that fail.
    """
    require_modules("matplotlib", "PIL", "rerun")  # torch only where an agent is made of it
    _say_doubts(paths for _, paths in planned)
    for wanted, _ in planned:
        _say_other_code(bench_folder(root, wanted), wanted)
    with ExitStack() as held:
        work = list[_Bench]()
        missing = 0
        for wanted, paths in {each.hash: (each, paths) for each, paths in planned}.values():  # each bench once
            store = BenchStore(bench_folder(root, wanted), wanted)
            held.enter_context(store.held())
            if store.missing():
                missing += len(store.missing())
                work.append((store, paths))
        if any(task_type(store.protocol.task).draws for store, _ in work):
            gl_renderer()  # fails here, in one sentence, rather than in every run
        environment = describe_environment() if work else {}
        for store, paths in work:
            used = {encoders.identity(path): encoders.short_card(path) for path in _artefacts([paths])}
            facts = {**environment, "encoders": used} if used else environment
            _warn(store.begin_session(facts, certificate_of), store.folder)
            held.callback(store.save_time)
        jobs = [job for store, paths in work for job in _jobs(store, paths)]
        with ProgressBar([job.spec for job in jobs]) as show:
            return list(launcher.launch(jobs, show)) if jobs else [], missing


def _say_other_code(folder: Path, wanted: ProtocolData) -> None:
    """Say of which benches the agents or the task had other code, if this one is new."""
    for other in with_other_code(folder, wanted) if wanted.code and not folder.exists() else ():
        print(
            f"Note: the code of an agent or of the task was changed since {other}, which stays as it is; all runs "
            "begin anew. To go on there, bring that code back and run the same command."
        )


def _say_doubts(needed: Iterable[Encoders]) -> None:
    """Say of each encoder once, through which agents see, if few frames are read right from it."""
    for path in _artefacts(needed):
        words = encoders.reading_warning(path.stem, encoders.card_of(path))
        if words:
            print(f"Note: agents see through {words}.")


def _artefacts(needed: Iterable[Encoders]) -> list[Path]:
    """The files of encoders, each once."""
    return sorted({path for paths in needed for kind, path in paths.items() if kind != "dataset" and path is not None})


@functools.cache
def certificate_of(task: str, split: str | None) -> Certificate | None:
    """Return the exact facts of a task from the starts that tests have; None for a package's whose rules fail."""
    try:
        return certificate(spec_of(task, split, testing=True))
    except (Exception, SystemExit) as error:
        if registry.is_own(task):
            raise
        print(f"Note: {task} has no certificate ({type(error).__name__}: {plain(error)}).")
        return None


_Bench = tuple[BenchStore, Encoders]


def _jobs(store: BenchStore, paths: Encoders) -> list[Job]:
    """The missing runs of a bench, seed by seed, the costliest runs of each first: all cores are busy to the end.

    Of agents that cost alike, those that are listed last come first.
    """
    protocol = store.protocol
    acts = registry.has_task(protocol.task)  # regressors have no encoder
    jobs = []
    for agent, seed in store.missing():
        entry = registry.agent_entry(agent) if acts else None
        encoder = paths[entry.encoder_kind] if entry is not None and entry.needs_encoder else None
        spec = RunSpec(protocol=protocol, agent=agent, seed=seed, encoder=encoder, dataset=paths.get("dataset"))
        jobs.append(Job(spec=spec, folder=store.run_folder(agent, seed)))
    places = protocol.agents.index
    return sorted(jobs, key=lambda job: (job.spec.seed, -expected_cost(job.spec), -places(job.spec.agent)))


def _warn(changed: Sequence[str], folder: Path) -> None:
    if changed:
        print(
            f"Note: {folder} was begun with another {', '.join(changed)}. Runs it finished are kept as they are, "
            "others go on from their checkpoints with the present state; give another folder with --out to run all of "
            "them anew."
        )
