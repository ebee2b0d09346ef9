"""The commands that run and report comparisons."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from imagine_bench import registry
from imagine_bench.adapters.tracking import track
from imagine_bench.cli.options import (
    FolderOrTask,
    Launch,
    MaybeInt,
    MaybeTaskWord,
    OfTask,
    Repeated,
    TaskWord,
    added_up,
    listed,
    only,
    path_or_task,
    require_values,
    shown,
)
from imagine_bench.errors import InvalidValueError, RunFailedError
from imagine_bench.interfaces import DEVICES
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.protocols.runs import Encoders, Result
from imagine_bench.registry.entries import file_name, parse_settings
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.control import load_bench_of_agents
from imagine_bench.running.task_types import load_so_far
from imagine_bench.store.bench_folder import newest_bench
from imagine_bench.store.merge import merge
from imagine_bench.store.results import BenchResult
from imagine_bench.sweep.catalogue import SUITE, grid_named
from imagine_bench.sweep.grid import SUITE_AGENTS, Study, Suite
from imagine_bench.sweep.run import run_study, run_suite

if TYPE_CHECKING:
    from imagine_bench.report.tables import Page


@dataclass(frozen=True, kw_only=True)
class WorldOptions:
    """Options of the world."""

    execution: Annotated[str | None, shown("STR", "(default: physics)")] = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    appearance: Annotated[str | None, shown("STR", "(default: clean)")] = None
    """How much frames vary: clean, mild, strong, photo (a finite pool), or factors such as light=0.5,camera=0.2."""
    physics: Annotated[Repeated[str], listed("STR", "(default: none)")] = ()
    """What decides whether a grasp holds, as name=value, such as pad_friction=0.5."""
    observation: Annotated[str | None, shown("STR", "(default: frame)")] = None
    """What agents see: frame, human, state (privileged) or proprio, several separated by commas."""
    observation_size: Annotated[int | None, shown("INT", "(default: 64)")] = None
    """Edge of images that agents see, 32 to 256 pixels."""


@dataclass(frozen=True, kw_only=True)
class Learner:
    """Options of the agents and of what they learn from."""

    agents: Annotated[tuple[str, ...] | None, listed("STR")] = None
    """Agents to compare; one with settings of its own is written 'dqn:controller.discount=0.99'."""
    set: Annotated[Repeated[str], listed("STR", "(default: none)")] = ()
    """Agent settings that replace the preset's, as name=value, such as controller.discount=0.9."""
    encoder: Annotated[str | None, shown("NAME|FILE", "(default: the task's own)")] = None
    """Another encoder: a bundled name or a .safetensors file."""
    after: Annotated[tuple[str, ...] | None, listed("STR", "(default: none)")] = None
    """Tasks of the same world to be trained on before, in this order; the model of the world is carried over."""
    after_episodes: Annotated[int | None, shown("INT", "(default: 100)")] = None
    """Real training episodes on each of them."""
    demonstrations: Annotated[int | None, shown("INT", "(default: 0)")] = None
    """First training episodes that the oracle plays and learners watch; budgets count them."""
    dataset: Annotated[Path | None, shown("PATH", "(default: none)")] = None
    """Folder of a dataset whose episodes come first in training; budgets count them, and are them alone by default."""
    queries: Annotated[int | None, shown("INT", "(default: 0)")] = None
    """Most oracle queries of a learner in a training episode."""
    feedback: Annotated[float | None, shown("FLOAT", "(default: 0)")] = None
    """Reward that a teacher adds for an optimal macro-action, and takes off for another, in training."""
    feedback_error: Annotated[float | None, shown("FLOAT", "(default: 0)")] = None
    """Probability with which the teacher says the opposite."""
    device: str = DEVICES[0]
    """Where agents compute: cpu or cuda."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Options of how much is run."""

    seeds: Annotated[tuple[int, ...] | None, listed("INT")] = None
    """Seeds; each agent has one run a seed."""
    budgets: Annotated[tuple[int, ...] | None, listed("INT")] = None
    """Real training episodes at which agents are tested, ascending."""
    variants: Annotated[Repeated[str], listed("STR")] = ()
    """Of regression tasks: datasets, or numbers of samples, to learn from."""
    networks: MaybeInt = None
    """Of regression tasks: networks a run, each on data of its own."""


@dataclass(frozen=True, kw_only=True)
class Tests:
    """Options of the tests."""

    evaluation_episodes: MaybeInt = None
    """Test episodes at each budget."""
    test_appearance: Annotated[str | None, shown("STR", "(default: the training's)")] = None
    """The appearance in tests."""
    split: Annotated[str | None, shown("STR", "(default: none)")] = None
    """Tests start where training never does, such as plan_length=2: after at most 2 macro-actions training can end."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Train and compare agents on a task; leaves a report and recordings. The same command again goes on."""

    task: TaskWord
    """Task to compare on, also as --task TASK; 'imagine-bench describe' names them."""
    preset: str = "quick"
    """Size of the comparison; 'imagine-bench describe' names them."""
    world: WorldOptions = field(default_factory=WorldOptions)
    learner: Learner = field(default_factory=Learner)
    budget: Budget = field(default_factory=Budget)
    tests: Tests = field(default_factory=Tests)
    launch: Launch = field(default_factory=Launch)

    def asked(self) -> tuple[str, str, dict[str, Any]]:
        """The task, the preset and the options that replace values of the preset, by name."""
        given: dict[str, Any] = {}
        for section in (self.world, self.learner, self.budget, self.tests):
            for option in fields(section):
                value = getattr(section, option.name)
                if value is not None:
                    given[option.name] = value
        for name in ("agents", "seeds", "budgets", "after"):
            require_values(name, given.get(name))
        overrides = parse_settings(added_up("set", given.pop("set")))
        physics = parse_settings(added_up("physics", given.pop("physics")), "--physics")
        variants = added_up("variants", given.pop("variants"))
        if physics:
            given["physics"] = physics
        if variants:
            given["variants"] = variants
        return self.task, self.preset, {"overrides": overrides, **given}

    def planned(self) -> tuple[ProtocolData, Encoders]:
        """The protocol of the comparison, and the encoders, checked."""
        task, preset, options = self.asked()
        return plan(task, preset, **options)

    def __call__(self) -> None:
        """Plan, run, report."""
        wanted, encoders = self.planned()
        launcher = self.launch.chosen()
        _show(bench(wanted, encoders, root=self.launch.out, launcher=launcher))


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write a bench's report again, from its files, and show its table; of agents' unfinished ones, what there is."""

    folder: FolderOrTask = None
    """The bench's folder, or a task whose newest bench is taken."""
    task: OfTask = None
    """Task whose newest bench is taken."""
    merge: Annotated[Repeated[Path], listed("PATH", "(default: none)")] = ()
    """Folders of other benches, or of results that were kept, whose agents are added, or where those are the same,
    whose seeds; all else in their protocols must be the same."""
    track: Annotated[str | None, shown("STR", "(default: no tool)")] = None
    """Write the metrics so far for a tool instead: tensorboard, or wandb (offline)."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Load and write."""
        given, task = path_or_task(self.folder, self.task)
        folder = given or newest_bench(self.out, only(task))
        if self.track is not None:
            print(f"Metrics: {track(folder, self.track)}")
            return
        others = added_up("merge", self.merge)
        if others:
            _show(merge([load_bench_of_agents(each) for each in (folder, *others)], self.out))
        else:
            _show(load_so_far(folder))


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Run a grid of benches: the benchmark suite, or a study on TASK. The same command again goes on."""

    task: MaybeTaskWord = None
    """Task of a study, also as --task TASK; without one the suite is run."""
    name: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME|FILE", aliases=["--file"], help_behavior_hint="(default: factors, suite)"),
    ] = None
    """Which grid; 'imagine-bench describe' names them. Or one of your own, a .toml or .json file."""
    variants: Annotated[Repeated[str], listed("STR", "(default: all)")] = ()
    """Of a study: only these variants and those they are compared with."""
    experiment: Annotated[Repeated[str], listed("STR", "(default: all)")] = ()
    """Of a suite: only these experiments, such as memory."""
    agents: Annotated[
        tuple[str, ...] | None, listed("STR", "(default: dqn imagination_uncertainty factored:given)")
    ] = None
    """Of a suite: agents to compare, also of other packages."""
    seeds: Annotated[tuple[int, ...] | None, listed("INT", "(default: the suite's)")] = None
    """Of a suite: seeds; each agent has one run a seed and level."""
    launch: Launch = field(default_factory=Launch)

    def __call__(self) -> None:
        """Run, compare or score, write."""
        grid = grid_named(self.name or ("factors" if self.task else SUITE))
        of_suite = {"experiment": self.experiment, "agents": self.agents, "seeds": self.seeds}
        foreign = of_suite if isinstance(grid, Study) else {"variants": self.variants, "task": self.task}
        for option, value in foreign.items():
            if value:
                raise InvalidValueError(f"{grid.name} takes no --{option}; leave it out.")
        for option in ("agents", "seeds"):
            require_values(option, getattr(self, option))
        if isinstance(grid, Study):
            self._study(grid.only(added_up("variants", self.variants)))
        else:
            suite = grid.only(added_up("experiment", self.experiment))
            self._suite(replace(suite, seeds=tuple(sorted(self.seeds))) if self.seeds else suite)

    def _study(self, study: Study) -> None:
        if self.task is None:
            raise InvalidValueError(f"{study.name} is a study of one task; give a task as the first word.")
        lines = run_study(study, self.task, root=self.launch.out, launcher=self.launch.chosen())
        runs = digest(sorted({line.folder.name for line in lines}))  # other runs overwrite no study
        folder = self.launch.out / file_name(registry.task_name(self.task)) / f"study-{study.name}-{runs}"
        _write(registry.load(_PAGES["study"])(study, lines), folder)

    def _suite(self, suite: Suite) -> None:
        launcher = self.launch.chosen()
        agents = self.agents or SUITE_AGENTS
        result = run_suite(suite, agents, root=self.launch.out, launcher=launcher, planners=self.launch.workers)
        page = registry.load(_PAGES["suite"])(result)
        _write(page, self.launch.out / "suite" / f"{suite.name}-{suite.hash}" / "report")
        if result.failures:
            raise RunFailedError(f"{len(result.failures)} runs failed; the same command tries them again.")


_PAGES = {
    "control": "imagine_bench.report:bench_page",
    "regression": "imagine_bench.report.regression:report_page",
    "study": "imagine_bench.report.sweep:study_page",
    "suite": "imagine_bench.report.sweep:suite_page",
}
"""Functions that make the page of a bench of each type of task and of a sweep; matplotlib loads with them."""


def _show(result: Result) -> None:
    """Report a bench, and say where its recordings lie."""
    page = registry.load(_PAGES["control" if isinstance(result, BenchResult) else "regression"])(result)
    _write(page, result.folder / "report")
    recordings = [run.recording for run in result.runs if run.recording is not None]
    if recordings:
        print(f"Recordings: {len(recordings)}, such as {recordings[-1]} (imagine-bench view opens the newest)")


def _write(page: Page, folder: Path) -> None:
    """Print the tables and the verdict of a page, write it, and say where it lies."""
    from imagine_bench.report.page import write_page  # noqa: PLC0415 - matplotlib loads slowly

    print(page.summary)  # first, as it needs no place to write
    print(f"\nReport:     {write_page(folder, page)}")
