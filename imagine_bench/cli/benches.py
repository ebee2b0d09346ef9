"""The commands that run and report comparisons."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from imagine_bench import registry
from imagine_bench.cli.observers import Observed
from imagine_bench.cli.options import ANY, NEWEST, added_up, listed, only, require_values, shown
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import APPEARANCES, DEVICES, EXECUTIONS
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.protocols.runs import Encoders, Result
from imagine_bench.registry.entries import file_name, parse_settings
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.control import load_bench_of_agents
from imagine_bench.running.launchers.jobs import LAUNCHERS, launcher
from imagine_bench.running.task_types import load_so_far, task_types
from imagine_bench.store.bench_folder import newest_bench
from imagine_bench.store.encoders import bundled
from imagine_bench.store.merge import merge
from imagine_bench.store.results import BenchResult

_LISTS = ("agents", "seeds", "budgets", "after")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Train and compare agents on a task; leaves a report and recordings. The same command again goes on."""

    task: str
    """Task to compare on; 'imagine-bench list' names them."""
    preset: str = "quick"
    """Size of the comparison; 'imagine-bench list' names them."""
    agents: Annotated[tuple[str, ...] | None, listed("STR")] = None
    """Agents to compare; one with settings of its own is written 'dqn:controller.discount=0.99'."""
    seeds: Annotated[tuple[int, ...] | None, listed("INT")] = None
    """Seeds; each agent has one run a seed."""
    budgets: Annotated[tuple[int, ...] | None, listed("INT")] = None
    """Real training episodes at which agents are tested, ascending."""
    evaluation_episodes: Annotated[int | None, shown("INT")] = None
    """Test episodes at each budget."""
    execution: Annotated[str | None, shown("STR", "(default: physics)")] = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    appearance: Annotated[str | None, shown("STR", "(default: clean)")] = None
    """How much frames vary: clean, mild, strong, photo (a finite pool), or factors such as light=0.5,camera=0.2."""
    test_appearance: Annotated[str | None, shown("STR", "(default: the training's)")] = None
    """The appearance in tests."""
    physics: Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], listed("STR", "(default: none)")] = ()
    """What decides whether a grasp holds, as name=value, such as pad_friction=0.5."""
    observation: Annotated[str | None, shown("STR", "(default: frame)")] = None
    """What agents see: frame, human, state (privileged) or proprio, several separated by commas."""
    observation_size: Annotated[int | None, shown("INT", "(default: 64)")] = None
    """Edge of images that agents see, 32 to 256 pixels."""
    variants: Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], listed("STR")] = ()
    """Of regression tasks: datasets, or numbers of samples, to learn from."""
    networks: Annotated[int | None, shown("INT")] = None
    """Of regression tasks: networks a run, each on data of its own."""
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
    split: Annotated[str | None, shown("STR", "(default: none)")] = None
    """Tests start where training never does, such as plan_length=2: after at most 2 macro-actions training can end."""
    queries: Annotated[int | None, shown("INT", "(default: 0)")] = None
    """Most oracle queries of a learner in a training episode."""
    feedback: Annotated[float | None, shown("FLOAT", "(default: 0)")] = None
    """Reward that a teacher adds for an optimal macro-action, and takes off for another, in training."""
    feedback_error: Annotated[float | None, shown("FLOAT", "(default: 0)")] = None
    """Probability with which the teacher says the opposite."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], listed("STR", "(default: none)")] = ()
    """Agent settings that replace the preset's, as name=value, such as controller.discount=0.9."""
    workers: Annotated[int | None, shown("INT", "(default: one a core)")] = None
    """Processes at a time."""
    launcher: str = "local"
    """Where runs are carried out: local processes, or ray (the cluster at RAY_ADDRESS, else one started here)."""
    device: str = DEVICES[0]
    """Where agents compute: cpu or cuda."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def planned(self) -> tuple[ProtocolData, Encoders]:
        """The protocol of what it would run, and the encoders, checked."""
        for name in _LISTS:
            require_values(name, getattr(self, name))
        names = (
            *_LISTS, "evaluation_episodes", "execution", "appearance", "test_appearance", "networks", "encoder",
            "after_episodes", "demonstrations", "queries", "dataset", "feedback", "feedback_error",
            "observation", "observation_size", "split",
        )  # fmt: skip
        options: dict[str, Any] = {name: getattr(self, name) for name in names}
        options["variants"] = added_up("variants", self.variants) or None
        given = {name: value for name, value in options.items() if value is not None}
        if self.physics:
            given["physics"] = parse_settings(added_up("physics", self.physics), "--physics")
        overrides = parse_settings(added_up("set", self.set))
        return plan(self.task, self.preset, device=self.device, overrides=overrides, **given)

    def __call__(self) -> None:
        """Plan, run, report."""
        wanted, encoders = self.planned()
        where = Observed(launcher(self.launcher, self.workers))
        _show(bench(wanted, encoders, root=self.out, launcher=where))


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write a bench's report again, from its files, and show its table; of agents' unfinished ones, what there is."""

    folder: Annotated[Path | None, tyro.conf.Positional, NEWEST] = None
    """The bench's folder."""
    task: Annotated[str | None, ANY] = None
    """Task whose newest bench is taken."""
    merge: Annotated[tyro.conf.UseAppendAction[tuple[tuple[Path, ...], ...]], listed("PATH", "(default: none)")] = ()
    """Folders of other benches, or of results that were kept, whose agents are added, or where those are the same,
    whose seeds; all else in their protocols must be the same."""
    track: Annotated[str | None, shown("STR", "(default: no tool)")] = None
    """Write the metrics so far for a tool instead: tensorboard, or wandb (offline)."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Load and write."""
        tasks = only(self.task, self.folder)
        folder = self.folder or newest_bench(self.out, tasks)
        if self.track is not None:
            from imagine_bench.adapters.tracking import track  # noqa: PLC0415 - an extra

            print(f"Metrics: {track(folder, self.track)}")
            return
        others = added_up("merge", self.merge)
        if others:
            _show(merge([load_bench_of_agents(each) for each in (folder, *others)], self.out))
        else:
            _show(load_so_far(folder))


@dataclass(frozen=True, kw_only=True)
class Study:
    """Change one factor of a comparison at a time, on tuning seeds. The same command again goes on."""

    task: str
    """Task to study on; 'imagine-bench list' names them."""
    name: Annotated[str | None, shown("STR", "(default: factors)")] = None
    """Which study; 'imagine-bench list' names them."""
    file: Annotated[Path | None, shown("FILE", "(default: none)")] = None
    """A study of your own, as .toml or .json."""
    observation: Annotated[str | None, shown("STR", "(default: frame)")] = None
    """What agents see: frame, human, state (privileged) or proprio, several separated by commas."""
    observation_size: Annotated[int | None, shown("INT", "(default: 64)")] = None
    """Edge of images that agents see, 32 to 256 pixels."""
    variants: Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], listed("STR", "(default: all)")] = ()
    """Only these variants and what they are compared with."""
    workers: Annotated[int | None, shown("INT", "(default: one a core)")] = None
    """Processes at a time."""
    launcher: str = "local"
    """Where runs are carried out: local or ray."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def __call__(self) -> None:
        """Run, compare, write."""
        from imagine_bench.report.study import study_table, write_study  # noqa: PLC0415 - matplotlib loads slowly
        from imagine_bench.studies.catalogue import STUDIES  # noqa: PLC0415 - as above
        from imagine_bench.studies.study import load_study, run_study  # noqa: PLC0415 - as above

        if self.file is not None and self.name is not None:
            raise InvalidValueError(
                f"Both --file {self.file} and --name {self.name} were given; leave one of them out."
            )
        found = registry.offered(self.name or "factors", STUDIES, registry.STUDY_GROUP)
        study = (found if self.file is None else load_study(self.file)).only(added_up("variants", self.variants))
        where = Observed(launcher(self.launcher, self.workers))
        lines = run_study(study, self.task, root=self.out, launcher=where)
        runs = digest(sorted({line.folder.name for line in lines}))  # other runs overwrite no study
        folder = self.out / file_name(registry.task_name(self.task)) / f"study-{study.name}-{runs}"
        write_study(folder, study, lines)
        print(study_table(study, lines))
        print(f"\nStudy:      {folder / 'study.md'}")


@dataclass(frozen=True, kw_only=True)
class List:
    """Name the tasks, agents, presets and bundled encoders."""

    def __call__(self) -> None:
        """List."""
        from imagine_bench.studies.catalogue import STUDIES  # noqa: PLC0415 - no other command but study needs them

        for title, names in {
            **{f"{name} tasks": kind.tasks() for name, kind in task_types().items()},
            **{f"{name} learners": kind.learners() for name, kind in task_types().items()},
            **{f"{name} presets": kind.presets for name, kind in task_types().items()},
            "studies": {**STUDIES, **registry.usable(registry.STUDY_GROUP)},
            "world models": registry.world_models(),
            "executions": EXECUTIONS,
            "launchers": LAUNCHERS,
            "appearances": APPEARANCES,
            "encoders": {**bundled(), **registry.usable(registry.ENCODER_GROUP)},
        }.items():
            print(f"{title:22}{', '.join(names)}")
        for guest in registry.absent_guests():
            names = [name for each in guest.names.values() for name in each]
            print(f"{'not installed':22}{', '.join(names)} ({guest.install})")
        for error in registry.refused_offers().values():
            print(f"\n{error}")


def _show(result: Result) -> None:
    """Write a bench's report, and print its table and where everything lies."""
    report = "imagine_bench.report" if isinstance(result, BenchResult) else "imagine_bench.regression.report"
    print(registry.load(f"{report}:summary_table")(result))  # first, as it needs no place to write
    page = registry.load(f"{report}:write_report")(result)
    print(f"\nReport:     {page}")
    recordings = [run.recording for run in result.runs if run.recording is not None]
    if recordings:
        print(f"Recordings: {len(recordings)}, such as {recordings[-1]} (imagine-bench view opens the newest)")
