"""The commands that run, plan and report benches and sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import tyro

from imagine_bench import registry
from imagine_bench.adapters.tracking import TOOLS, Tracked, track
from imagine_bench.cli.options import (
    Count,
    Counts,
    DeviceWord,
    EncoderWord,
    ExecutionWord,
    File,
    Launch,
    ManyWords,
    MaybeTaskWord,
    Number,
    OfBench,
    Repeated,
    TaskWord,
    Word,
    Words,
    added_up,
    one_of,
    shown,
)
from imagine_bench.errors import InvalidValueError, RunFailedError
from imagine_bench.interfaces import DEVICES
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import Encoders, Launcher, ProtocolData, Result, digest
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.registry.entries import file_name, parse_settings
from imagine_bench.running.bench import bench, load_so_far, plan
from imagine_bench.running.headlines import until_decided
from imagine_bench.seeding import seeds_text
from imagine_bench.store import loading
from imagine_bench.store.bench_folder import newest_bench
from imagine_bench.store.results import BenchResult
from imagine_bench.sweep.grid import SUITE, Study, Suite, grid_named
from imagine_bench.sweep.run import run_study, run_suite

if TYPE_CHECKING:
    from imagine_bench.report.page import Page

_MOST_SEEDS = 19
"""Where --until-decided stops."""
_ADDED = "added"
"""Folder of benches of added seeds, below that of all benches, so that none is taken for the newest bench."""


TrackWord = Annotated[str | None, shown(f"{{{','.join(TOOLS)}}}")]


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """Options of the world."""

    execution: ExecutionWord = None
    """How macro-actions happen: physics (the default), or kinematic (their outcome is set)."""
    appearance: Word = None
    """How much frames vary: clean (the default), mild, strong, patched (from a finite pool), harsh (shifted, shadowed,
    occluded and noisy), or factors such as light=0.5,camera=0.2."""
    physics: ManyWords = ()
    """Settings of the physics of grasping, as name=value, such as pad_friction=0.5."""
    observation: Word = None
    """Observation of agents: frame (the default), human, state (privileged) or proprio, several separated by commas."""
    observation_size: Count = None
    """Edge of images that agents see, 32 to 256 pixels; 64 by default."""


@dataclass(frozen=True, kw_only=True)
class Learner:
    """Options of the agents and of their training data."""

    agents: Words = None
    """Agents to compare, by default the preset's; one with settings of its own is written
    'dqn:controller.discount=0.99'."""
    set: ManyWords = ()
    """Agent settings that replace the preset's, as name=value, such as controller.discount=0.9."""
    encoder: EncoderWord = None
    """Another encoder than the task's own: a bundled name or a .safetensors file."""
    after: Words = None
    """Tasks of the same world to be trained on before, in this order; the model of the world is carried over."""
    after_episodes: Count = None
    """Real training episodes on each of them; 100 by default."""
    unannounced: bool = False
    """With --after: learners are not told when the next task begins, so the rules change within one run."""
    demonstrations: Count = None
    """First training episodes, 0 by default, that the oracle plays and learners watch; budgets count them."""
    dataset: File = None
    """Folder of a dataset whose episodes come first in training; budgets count them, and are them alone by default."""
    queries: Count = None
    """Most oracle queries of a learner in a training episode; 0 by default."""
    feedback: Number = None
    """Reward that a teacher adds for an optimal macro-action, and takes off for another, in training; 0 by default."""
    feedback_error: Number = None
    """Probability with which the teacher says the opposite; 0 by default."""
    device: DeviceWord = DEVICES[0]
    """Where agents compute: cpu or cuda."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Options of how much is run."""

    seeds: Counts = None
    """Seeds, by default the preset's, such as 0 1 2 or 0-21. Each agent has one run a seed; without --agents, some of
    the preset quick have fewer."""
    budgets: Counts = None
    """Real training episodes at which agents are tested, ascending; by default the preset's."""
    variants: ManyWords = ()
    """Of regression tasks: datasets, or numbers of samples, to learn from; by default all."""
    networks: Count = None
    """Of regression tasks: networks a run, by default the preset's, each on data of its own."""
    until_decided: bool = False
    """Add seeds, three at a time, until every headline of the preset is decided; p-values allow for all looks."""
    most_seeds: Count = None
    """With --until-decided: seeds of an agent at most; 19 by default."""


@dataclass(frozen=True, kw_only=True)
class Tests:
    """Options of the tests."""

    evaluation_episodes: Count = None
    """Test episodes at each budget; by default the preset's."""
    test_appearance: Word = None
    """The appearance in tests; the training's by default."""
    split: Word = None
    """Tests start where training never does, such as plan_length=2: after at most 2 macro-actions training can end."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Train and compare agents on a task; leaves a report and recordings. The same command again goes on."""

    task: TaskWord
    """Task to compare on, also as --task TASK; 'imagine-bench list' names them."""
    preset: Annotated[str, one_of(*PRESETS)] = "quick"
    """Size of the comparison; 'imagine-bench list' says how large each is."""
    world: WorldOptions
    learner: Learner
    budget: Budget
    tests: Tests
    launch: Launch
    track: TrackWord = None
    """Also write metrics for a tool, as the runs go, into a folder of its name in the bench's; wandb offline."""

    def asked(self) -> tuple[str, str, dict[str, Any]]:
        """The task, the preset and the options that replace values of the preset, by name."""
        sections = (self.world, self.learner, self.budget, self.tests)
        given: dict[str, Any] = {name: value for section in sections for name, value in vars(section).items()}
        overrides = parse_settings(added_up(given.pop("set")))
        given["physics"] = parse_settings(added_up(self.world.physics), "--physics")
        given["variants"] = added_up(self.budget.variants)
        given.pop("until_decided")
        given.pop("most_seeds")
        given["unannounced"] = self.learner.unannounced or None
        options = {name: value for name, value in given.items() if value not in (None, ())}
        return self.task, self.preset, {"overrides": overrides, **options}

    def planned(self) -> tuple[ProtocolData, Encoders]:
        """The protocol of the comparison, and the encoders, checked."""
        task, preset, options = self.asked()
        return plan(task, preset, **options)

    def __call__(self) -> None:
        """Plan, run, report."""
        *parts, whole = carry_out(
            *self.asked(),
            root=self.launch.out,
            launcher=self.launch.chosen(),
            until=self.budget.until_decided,
            most=self.budget.most_seeds,
            track=self.track,
        )
        for part in parts:
            _written(page_of(part), part.folder / "report")
        _show(whole)
        if parts:
            print(f"Parts:      {', '.join(str(part.folder) for part in parts)}")


def carry_out(
    task: str,
    preset: str,
    options: Mapping[str, Any],
    *,
    root: Path,
    launcher: Launcher,
    until: bool = False,
    most: int | None = None,
    track: str | None = None,
) -> list[Result]:
    """Carry out the missing runs of a bench, or with ``until`` of its stages, and read it.

    Args:
        task: The task.
        preset: The preset.
        options: Fields of the protocol that differ from the preset's, as :func:`.running.bench.plan` takes them.
        root: The folder of all benches.
        launcher: Carries out the runs.
        until: Whether seeds are added until the headlines are decided.
        most: With it, seeds of an agent at most; 19 by default.
        track: Tool for which metrics are also written, as the runs go.

    Returns:
        The bench; or, if seeds were added, its parts, and last all of them as one bench.

    Raises:
        InvalidValueError: ``most`` without ``until``, or ``until`` for a task without headlines.
        ImagineBenchError: As :func:`.running.bench.plan` and :func:`.running.bench.bench`.
    """
    if most is not None and not until:
        raise InvalidValueError("--most-seeds goes with --until-decided; leave it out, or give both.")
    if track is not None:
        tracked = Tracked(launcher, track, task)
        results = carry_out(task, preset, options, root=root, launcher=tracked, until=until, most=most)
        tracked.note(results[-1])
        return results
    wanted, encoders = plan(task, preset, **options)
    if not until:
        return [bench(wanted, encoders, root=root, launcher=launcher)]
    if not isinstance(wanted, Protocol):
        raise InvalidValueError(f"{task} is a regression task without headlines; leave --until-decided out.")

    def staged(**changes: Any) -> BenchResult:
        stage, paths = plan(task, preset, **{**options, **changes})
        if stage.seeds[0] == wanted.seeds[0]:
            return cast("BenchResult", bench(stage, paths, root=root, launcher=launcher))
        print(f"Not decided: {' and '.join(stage.agents)} with the seeds {seeds_text(stage.seeds)} are added.")
        return cast("BenchResult", bench(stage, paths, root=root / _ADDED, launcher=launcher))

    return [*until_decided(staged, wanted, most=_MOST_SEEDS if most is None else most, root=root)]


@dataclass(frozen=True, kw_only=True)
class Report(OfBench):
    """Write a bench's report again, from its files, and show its table; of an unfinished bench of agents, the runs so
    far.
    """

    merge: Annotated[Repeated[Path], shown("PATH [PATH ...]")] = ()
    """Folders of other benches, or of results that were kept, whose agents are added, or where those are the same,
    whose seeds; all else in their protocols must be the same. The merged bench is written into --out."""
    track: TrackWord = None
    """Write the metrics so far for a tool instead; wandb offline."""

    def __call__(self) -> None:
        """Load and write."""
        given, task = self.meant(writes=bool(self.merge))
        if self.track is not None and self.merge:
            raise InvalidValueError("--track writes the metrics of one bench; leave it or --merge out.")
        folder = given or newest_bench(self.out, task)
        if self.track is not None:
            print(f"Metrics: {track(folder, self.track)}")
            return
        others = added_up(self.merge)
        if others:
            _show(loading.merge([loading.load_so_far(each) for each in (folder, *others)], self.out))
        else:
            _show(load_so_far(folder))


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Run a grid of benches: the benchmark suite, or a study on TASK. The same command again goes on."""

    task: MaybeTaskWord = None
    """Task of a study, also as --task TASK; without one the suite is run."""
    name: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME|FILE", aliases=["--file"], help_behavior_hint="(optional)"),
    ] = None
    """Which grid, by default the study factors, or the suite; 'imagine-bench list' names them. Or one of your own,
    a .toml or .json file."""
    variants: ManyWords = ()
    """Of a study: only these variants, by default all, and those they are compared with."""
    experiment: ManyWords = ()
    """Of a suite: only these experiments, such as memory; by default all."""
    agents: Words = None
    """Of a suite: agents to compare, also of other packages; by default dqn, imagination_uncertainty and
    factored:given."""
    seeds: Counts = None
    """Of a suite: seeds, by default its own; each agent has one run a seed and level."""
    launch: Launch

    def __call__(self) -> None:
        """Run, compare or score, write."""
        name = self.name or ("factors" if self.task else SUITE)
        grid = grid_named(name)
        of_suite = {"experiment": self.experiment, "agents": self.agents, "seeds": self.seeds}
        foreign = of_suite if isinstance(grid, Study) else {"variants": self.variants, "task": self.task}
        for option, value in foreign.items():
            if value:
                raise InvalidValueError(f"{name} takes no --{option}; leave it out.")
        if isinstance(grid, Study):
            self._study(grid.only(added_up(self.variants)))
        else:
            suite = grid.only(added_up(self.experiment))
            self._suite(replace(suite, seeds=self.seeds) if self.seeds else suite)

    def _study(self, study: Study) -> None:
        if self.task is None:
            raise InvalidValueError(f"{study.name} is a study of one task; give a task as the first word.")
        lines = run_study(study, self.task, root=self.launch.out, launcher=self.launch.chosen())
        runs = digest(sorted({line.folder.name for line in lines}))  # other runs overwrite no study
        folder = self.launch.out / file_name(registry.task_name(self.task)) / f"study-{study.name}-{runs}"
        write_report(registry.load(_PAGES["study"])(study, lines), folder)

    def _suite(self, suite: Suite) -> None:
        launcher = self.launch.chosen()
        agents = self.agents
        if agents is None:
            agents, note = registry.installed_of(suite.agents)
            if note:
                print(note)
        result = run_suite(suite, agents, root=self.launch.out, launcher=launcher)
        page = registry.load(_PAGES["suite"])(result)
        name = f"{suite.name}-{suite.hash}-{digest(sorted(agents))[:6]}"  # the page of other agents stays
        write_report(page, self.launch.out / "suite" / name / "report")
        if result.failures:
            raise RunFailedError(f"{len(result.failures)} runs failed; the same command tries them again.")


@dataclass(frozen=True, kw_only=True)
class Plan(OfBench):
    """Imagine whole plans from one frame each and let the arm carry them out blindly; leaves figures, a recording.

    The first word may also be a run's folder; of a bench, the best imagining run is taken.
    """

    count: int = 100
    """Plans."""
    recorded: int = 5
    """Plans that are recorded too; 0 for none."""
    execution: ExecutionWord = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    max_epistemic: Number = None
    """A plan with an imagined step of more epistemic uncertainty is refused; by default the agent's filter decides."""
    encoder: EncoderWord = None
    """The encoder the run saw through, where it is not bundled."""

    def __call__(self) -> None:
        """Find, plan, report."""
        from imagine_bench.tools.audits import plan_report  # noqa: PLC0415 - fonts and pillow load slowly

        run, task = self.meant()
        print(
            plan_report(
                run,
                root=self.out,
                task=task,
                count=self.count,
                recorded=self.recorded,
                execution=self.execution,
                max_epistemic=self.max_epistemic,
                encoder=self.encoder,
            )
        )


_PAGES = {
    "control": "imagine_bench.report.bench:bench_page",
    "regression": "imagine_bench.report.regression:report_page",
    "study": "imagine_bench.report.sweep:study_page",
    "suite": "imagine_bench.report.sweep:suite_page",
}
"""Functions that make the page of a bench of each type of task and of a sweep; matplotlib loads with them."""


def _show(result: Result) -> None:
    """Report a bench, and say where its recordings lie."""
    write_report(page_of(result), result.folder / "report")
    recordings = [run.recording for run in result.runs if run.recording is not None]
    if recordings:
        print(f"Recordings: {len(recordings)}, such as {recordings[-1]} (imagine-bench view opens the newest)")


def page_of(result: Result) -> Page:
    """The report of a bench of any type of task."""
    page: Page = registry.load(_PAGES["control" if isinstance(result, BenchResult) else "regression"])(result)
    return page


def write_report(page: Page, folder: Path) -> None:
    """Print the tables and the verdict of a page, write it, and say where it lies."""
    print(page.summary)  # first, as it needs no place to write
    print(f"\nReport:     {_written(page, folder)}")


def _written(page: Page, folder: Path) -> Path:
    """Write a page; returns its path."""
    from imagine_bench.report.page import write_page  # noqa: PLC0415 - matplotlib loads slowly

    return write_page(folder, page)
