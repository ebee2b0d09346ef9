"""The command line: words to calls, errors to one line and an exit code. No logic, nothing heavy until it is needed."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from imagine_bench import __version__, registry
from imagine_bench.bench.bench import bench, plan
from imagine_bench.bench.launchers import LAUNCHERS, launcher
from imagine_bench.bench.protocol import digest
from imagine_bench.errors import ImagineBenchError, InvalidValueError, require_known
from imagine_bench.interfaces import APPEARANCES, DEVICES, EXECUTIONS
from imagine_bench.store.archive import is_archive
from imagine_bench.store.bench_folder import newest_bench, newest_recording, read_protocol, require_either
from imagine_bench.store.encoders import bundled
from imagine_bench.store.files import require_writable
from imagine_bench.task_types import TASK_TYPES, task_type
from imagine_bench.tools.doctor import examine

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
_RETRAIN = "imagine_bench.agents.encoders.cli:retrain"
_TOGETHER = "imagine_bench.store.merge:load_merged"
_ARCHIVED = "imagine_bench.store.archive:load_archive"
_ABREAST = "(default: equal shares for local workers; with ray 1)"
_ADDING_UP = ("--set", "--beside", "--variants")
_LISTS = (*_ADDING_UP, "--agents", "--seeds", "--budgets", "--after")
"""Options that take several values; of those that do not add up, the last one counts, as with any option."""
_PRESETS_OWN = "(default: the preset's)"
_NONE = tyro.conf.arg(help_behavior_hint="(default: none)")
_NEWEST = tyro.conf.arg(metavar="[PATH]", help_behavior_hint="(default: the newest)")
_ANY = tyro.conf.arg(metavar="STR", help_behavior_hint="(default: any)")
_OF_PRESET = tyro.conf.arg(help_behavior_hint=_PRESETS_OWN)


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Train and compare agents on a task; leaves a report and recordings. The same command again goes on."""

    task: str
    """Task to compare on; 'imagine-bench list' names them."""
    preset: str = "quick"
    """Size of the comparison; 'imagine-bench list' names them."""
    agents: Annotated[tuple[str, ...], _OF_PRESET] = ()
    """Agents to compare."""
    seeds: Annotated[tuple[int, ...], _OF_PRESET] = ()
    """Seeds; each agent has one run a seed."""
    budgets: Annotated[tuple[int, ...], _OF_PRESET] = ()
    """Real training episodes at which agents are tested, ascending."""
    evaluation_episodes: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=_PRESETS_OWN)] = None
    """Test episodes at each budget."""
    execution: Annotated[str | None, tyro.conf.arg(metavar="STR", help_behavior_hint="(default: physics)")] = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    appearance: Annotated[str | None, tyro.conf.arg(metavar="STR", help_behavior_hint="(default: clean)")] = None
    """How much light, colors and poses vary: clean, mild or strong."""
    variants: Annotated[tuple[str, ...], _OF_PRESET] = ()
    """Of regression tasks: datasets, or numbers of samples, to learn from."""
    networks: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=_PRESETS_OWN)] = None
    """Of regression tasks: networks a run, each on data of its own."""
    encoder: Annotated[
        str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint="(default: the task's own)")
    ] = None
    """Another encoder: a bundled name or a .safetensors file."""
    after: Annotated[tuple[str, ...], _NONE] = ()
    """Tasks of the same world to be trained on before, in this order; the model of the world is carried over."""
    after_episodes: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 100)")] = None
    """Real training episodes on each of them."""
    demonstrations: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """First training episodes that the oracle plays and learners watch; budgets count them."""
    questions: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: 0)")] = None
    """Most questions to a teacher in a training episode."""
    set: Annotated[tuple[str, ...], _NONE] = ()
    """Agent settings that replace the preset's, as name=value, such as controller.discount=0.9."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: one a core)")] = None
    """Processes at a time."""
    abreast: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint=_ABREAST)] = None
    """Runs of one agent that go on side by side in a process and learn as one computation."""
    launcher: str = "local"
    """Where runs are carried out: local processes, or ray (the cluster at RAY_ADDRESS, else one started here)."""
    device: str = DEVICES[0]
    """Where agents compute: cpu or cuda."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def planned(self) -> tuple[Any, Any]:
        """The protocol of what it would run, and the encoders, checked."""
        names = (
            "agents", "seeds", "budgets", "evaluation_episodes", "execution", "appearance", "variants", "networks",
            "encoder", "after", "after_episodes", "demonstrations", "questions",
        )  # fmt: skip
        options: dict[str, Any] = {name: getattr(self, name) for name in names if getattr(self, name) not in ((), None)}
        return plan(self.task, self.preset, device=self.device, overrides=parse_settings(self.set), **options)

    def __call__(self) -> None:
        """Plan, run, report."""
        wanted, encoder = self.planned()
        where = launcher(self.launcher, self.workers, self.abreast)
        _show(bench(wanted, encoder, root=self.out, launcher=where).folder)


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write a bench's report again, from its files, and show its table; of agents' unfinished ones, what there is."""

    folder: Annotated[Path | None, tyro.conf.Positional, _NEWEST] = None
    """The bench's folder."""
    task: Annotated[str | None, _ANY] = None
    """Task whose newest bench is taken."""
    beside: Annotated[tuple[Path, ...], _NONE] = ()
    """Folders of other benches, or of results that were kept, whose agents are shown beside it, or where those are
    the same, whose seeds; all else in their protocols must be the same."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Load and write."""
        tasks = _only(self.task, self.folder)
        folder = self.folder or newest_bench(self.out, tasks)
        _show(folder, registry.load(_TOGETHER)([folder, *self.beside], self.out) if self.beside else None)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Imagine whole plans from one frame each and let the arm carry them out blindly; leaves pictures, a recording."""

    run: Annotated[Path | None, tyro.conf.Positional, _NEWEST] = None
    """The folder of a run, or of a bench, whose best imagining run is taken."""
    task: Annotated[str | None, _ANY] = None
    """Task whose newest bench is taken."""
    count: int = 100
    """Plans."""
    recorded: int = 5
    """Plans that are recorded too; 0 for none."""
    execution: str = EXECUTIONS[0]
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    max_epistemic: Annotated[
        float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(default: the agent's own filter)")
    ] = None
    """A plan with an imagined step of more epistemic uncertainty is refused."""
    encoder: Annotated[
        str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint="(default: the run's, if bundled)")
    ] = None
    """The encoder the run saw through, where it is not bundled."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Find, plan, report."""
        from imagine_bench.judge.quality import plan_report  # noqa: PLC0415 - matplotlib's fonts and pillow load slowly

        print(
            plan_report(
                self.run,
                root=self.out,
                task=self.task,
                count=self.count,
                recorded=self.recorded,
                execution=self.execution,
                max_epistemic=self.max_epistemic,
                encoder=self.encoder,
            )
        )


@dataclass(frozen=True, kw_only=True)
class _OfBench:
    """Which bench a question is put to."""

    folder: Annotated[Path | None, tyro.conf.Positional, _NEWEST] = None
    """A bench's folder."""
    task: Annotated[str | None, _ANY] = None
    """Task whose newest bench is taken."""
    encoder: Annotated[
        str | None, tyro.conf.arg(metavar="NAME|FILE", help_behavior_hint="(default: the runs', if bundled)")
    ] = None
    """The encoder the runs saw through, where it is not bundled."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""


@dataclass(frozen=True, kw_only=True)
class Generalise(_OfBench):
    """Ask the models of a bench, finished or not, for every transition: also those that no training can contain."""

    def __call__(self) -> None:
        """Ask and report."""
        from imagine_bench.judge.quality import generalisation_report  # noqa: PLC0415 - as above

        print(generalisation_report(self.folder, root=self.out, task=self.task, encoder=self.encoder))


@dataclass(frozen=True, kw_only=True)
class Policy(_OfBench):
    """Follow the policies of a bench, finished or not, from every start by the rules: what they miss, and how."""

    def __call__(self) -> None:
        """Ask and follow."""
        from imagine_bench.judge.quality import policy_report  # noqa: PLC0415 - as above

        print(policy_report(self.folder, root=self.out, task=self.task, encoder=self.encoder))


@dataclass(frozen=True, kw_only=True)
class StudyCommand:
    """Change one factor of a comparison at a time, on tuning seeds. The same command again goes on."""

    task: str
    """Task to study on; 'imagine-bench list' names them."""
    name: str = "factors"
    """Which study; 'imagine-bench list' names them."""
    variants: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all)")] = ()
    """Only these variants and what they are compared with."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(default: one a core)")] = None
    """Processes at a time."""
    launcher: str = "local"
    """Where runs are carried out: local or ray."""
    out: Path = Path("runs")
    """Folder of all benches."""

    def __call__(self) -> None:
        """Run, compare, write."""
        from imagine_bench.bench.studies import STUDIES  # noqa: PLC0415 - as above
        from imagine_bench.bench.study import run_study  # noqa: PLC0415 - as above
        from imagine_bench.report.study import study_table, write_study  # noqa: PLC0415 - matplotlib loads slowly

        study = STUDIES[require_known("study", self.name, STUDIES)].only(self.variants)
        where = launcher(self.launcher, self.workers)
        lines = run_study(study, self.task, root=self.out, launcher=where)
        runs = digest(sorted({line.folder.name for line in lines}))  # other runs overwrite no study
        folder = self.out / self.task / f"study-{study.name}-{runs}"
        write_study(folder, study, lines)
        print(study_table(study, lines))
        print(f"\nStudy:      {folder / 'study.md'}")


@dataclass(frozen=True, kw_only=True)
class View:
    """Open a recording in the Rerun viewer."""

    file: Annotated[Path | None, tyro.conf.Positional, _NEWEST] = None
    """The .rrd file."""
    task: Annotated[str | None, _ANY] = None
    """Task whose newest recording is taken."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Find and open."""
        from imagine_bench.recording import open_in_viewer  # noqa: PLC0415 - Rerun loads slowly

        tasks = _only(self.task, self.file)
        open_in_viewer(self.file or newest_recording(self.out, *tasks))


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """Train an encoder anew and say how it compares to the bundled one."""

    task: str
    """Task whose frames it learns."""
    appearance: str = APPEARANCES[0]
    """Appearance level of the frames."""
    recipe: str = "default"
    """How it is trained: default, thesis, joint (the arrow puzzles: eight latents of the whole picture), or codes,
    for agents that read parts and their values."""
    seed: int = 0
    """Seed of data and training."""
    out: Path = Path("encoders")
    """Folder for artefact, card and picture; never overwritten."""

    def __call__(self) -> None:
        """Train."""
        retrain = registry.load(_RETRAIN)
        spec = registry.task(self.task)
        require_writable(self.out)
        print(retrain(spec, recipe=self.recipe, appearance=self.appearance, seed=self.seed, out=self.out))


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what this machine and installation have, and in words what is wrong with them."""

    def __call__(self) -> None:
        """Examine."""
        report = examine()
        print(report)
        if report.complaints:
            sys.exit(1)


@dataclass(frozen=True, kw_only=True)
class List:
    """Name the tasks, agents, presets and bundled encoders."""

    def __call__(self) -> None:
        """List."""
        from imagine_bench.bench.studies import STUDIES  # noqa: PLC0415 - no other command but study needs them

        for title, names in {
            **{f"{name} tasks": kind.tasks for name, kind in TASK_TYPES.items()},
            **{f"{name} learners": kind.learners() for name, kind in TASK_TYPES.items()},
            **{f"{name} presets": registry.load(kind.presets) for name, kind in TASK_TYPES.items()},
            "studies": STUDIES,
            "executions": EXECUTIONS,
            "launchers": LAUNCHERS,
            "appearances": APPEARANCES,
            "encoders": bundled(),
        }.items():
            print(f"{title:22}{', '.join(names)}")


@dataclass(frozen=True, kw_only=True)
class Film:
    """Film an episode of optimal macro-actions in contact physics, as a GIF."""

    task: str
    """Task to film."""
    appearance: str = APPEARANCES[0]
    """Appearance level."""
    seed: int = 0
    """Chooses the episode."""
    out: Path = Path("film.gif")
    """The GIF to write; never overwritten."""

    def __call__(self) -> None:
        """Film."""
        from imagine_bench.tools.film import film  # noqa: PLC0415 - numpy and pillow only when filming

        print(film(self.task, self.out, seed=self.seed, appearance=self.appearance))


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Measure every speed and fidelity figure that is promised, beside the promise."""

    turns: int = 2_000
    """Macro-actions of the fidelity measurement."""
    out: Path = Path("runs/speed.json")
    """Where the figures are kept, with the machine's description."""

    def __call__(self) -> None:
        """Measure."""
        from imagine_bench.tools.speed import speed_report  # noqa: PLC0415 - nothing else needs it

        if not speed_report(self.out, self.turns):
            sys.exit(1)


Command = (
    Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Generalise, tyro.conf.subcommand("generalise")]
    | Annotated[Policy, tyro.conf.subcommand("policy")]
    | Annotated[StudyCommand, tyro.conf.subcommand("study")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Encoder, tyro.conf.subcommand("encoder")]
    | Annotated[Film, tyro.conf.subcommand("film")]
    | Annotated[Speed, tyro.conf.subcommand("speed")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[List, tyro.conf.subcommand("list")]
)


def main(words: Sequence[str] | None = None) -> int:
    """Carry out a command line and return its exit code: 0, 1 (a run or check failed), 2 (bad input), 130 (Ctrl-C)."""
    given = sys.argv[1:] if words is None else list(words)
    command: Any = None
    try:
        if given == ["--version"]:
            print(f"imagine-bench {__version__}")
            return 0
        _require_clear(given)
        command = tyro.cli(
            Command,
            prog="imagine-bench",
            description="Robotics benchmarks that measure how far imagination cuts the real interaction a robot needs. "
            "--version says which this is.",
            args=given,
            config=(tyro.conf.OmitArgPrefixes,),
        )
        command()
        sys.stdout.flush()
    except ImagineBenchError as error:
        print(f"imagine-bench: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # who read along has seen enough, as `| head` does; nothing more can be said to them
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        resumes = isinstance(command, Bench | StudyCommand)
        then = "goes on from the last checkpoints" if resumes else "begins anew"
        print(f"imagine-bench: interrupted; the same command {then}.", file=sys.stderr)
        return INTERRUPTED
    return 0


def _require_clear(words: Sequence[str]) -> None:
    """Refuse what would be taken for something else in silence: a list without values, one of two lists.

    Raises:
        InvalidValueError: An option that takes a list has no value, or such an option that adds up comes twice.
    """
    for name in _LISTS:
        places = [place for place, word in enumerate(words) if word.partition("=")[0] == name]
        values = [_first_value(words, place) for place in places]
        if any(not value or value.startswith("--") for value in values):
            raise InvalidValueError(f"{name} has no value; give at least one behind it, or leave it out.")
        if len(places) > 1 and name in _ADDING_UP:
            raise InvalidValueError(f"{name} comes {len(places)} times; give all its values behind one.")


def _first_value(words: Sequence[str], place: int) -> str:
    """The first value of the option at a place: behind its equals sign, or else the next word."""
    _, equals, value = words[place].partition("=")
    return value if equals else next(iter(words[place + 1 :]), "")


def parse_settings(pairs: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """``name=value`` words to sorted (name, value) pairs; values are read as JSON, and as text where they are none.

    Raises:
        InvalidValueError: A word without ``=``, or a name given twice.
    """
    settings: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise InvalidValueError(f"--set {pair!r} is not of the form name=value, such as controller.discount=0.9.")
        if name in settings:
            raise InvalidValueError(f"--set names {name!r} twice; give it once.")
        settings[name] = _value(text)
    return tuple(sorted(settings.items()))


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _only(task: str | None, given: Path | None) -> tuple[str, ...]:
    """A task by itself, or none for any.

    Raises:
        UnknownNameError: No such task; the message lists those of every kind.
        InvalidValueError: A path was given too.
    """
    require_either(given, task)
    if task is None:
        return ()
    task_type(task)  # knows every name
    return (task,)


def _show(folder: Path, result: Any = None) -> None:
    """Write a bench's report, or that of another result of its kind, and print its table and where everything lies."""
    kind = task_type(read_protocol(folder).task)
    result = result or registry.load(_ARCHIVED if is_archive(folder) else kind.load_so_far)(folder)
    print(registry.load(kind.summary_table)(result))  # first, as it needs no place to write
    page = registry.load(kind.write_report)(result)
    print(f"\nReport:     {page}")
    recordings = [run.recording for run in result.runs if run.recording is not None]
    if recordings:
        print(f"Recordings: {len(recordings)}, such as {recordings[-1]} (make view opens the newest)")
