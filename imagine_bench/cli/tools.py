"""The commands beside benches: viewing, encoders, films, speed, and what this machine has."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imagine_bench import registry
from imagine_bench.cli.options import ANY, NEWEST, listed, only, require_values, shown
from imagine_bench.interfaces import APPEARANCES, DEVICES
from imagine_bench.store.bench_folder import newest_recording
from imagine_bench.store.files import require_writable
from imagine_bench.tools.doctor import examine

_RETRAIN = "imagine_bench.agents.encoders.cli:retrain"


@dataclass(frozen=True, kw_only=True)
class View:
    """Open a recording in the Rerun viewer."""

    file: Annotated[Path | None, tyro.conf.Positional, NEWEST] = None
    """The .rrd file."""
    task: Annotated[str | None, ANY] = None
    """Task whose newest recording is taken."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Find and open."""
        from imagine_bench.recording import open_in_viewer  # noqa: PLC0415 - Rerun loads slowly

        tasks = only(self.task, self.file)
        open_in_viewer(self.file or newest_recording(self.out, *tasks))


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """Train an encoder anew and say how it compares to the bundled one."""

    task: str
    """Task whose frames it learns."""
    appearance: str = APPEARANCES[0]
    """Appearance of the frames: a level, or factors such as light=0.5,camera=0.2."""
    recipe: str = "default"
    """How it is trained: default, thesis, joint (the arrow puzzles: eight latents of the whole image), or codes,
    for agents that read factors and their values."""
    seed: int = 0
    """Seed of data and training."""
    steps: Annotated[int | None, shown("INT", "(default: the recipe's)")] = None
    """Gradient steps, at least 1."""
    batch: Annotated[int | None, shown("INT", "(default: the recipe's)")] = None
    """Images a gradient step, at least 1."""
    latents: Annotated[int | None, shown("INT", "(default: the recipe's)")] = None
    """Latents of the image, or of each strip, at least 1."""
    device: str = DEVICES[0]
    """Where gradient steps are made: cpu, or cuda (an NVIDIA GPU)."""
    out: Path = Path("encoders")
    """Folder for artefact, card and figure; never overwritten."""

    def __call__(self) -> None:
        """Train."""
        retrain = registry.load(_RETRAIN)
        spec = registry.task(self.task)
        require_writable(self.out)
        names = ("recipe", "appearance", "steps", "batch", "latents", "device")
        choices = {name: getattr(self, name) for name in names}
        print(retrain(spec, **choices, seed=self.seed, out=self.out))


@dataclass(frozen=True, kw_only=True)
class Describe:
    """Say what a task is: macro-actions, macrostates, chance, optimum, plan lengths, all exact."""

    task: Annotated[str, tyro.conf.Positional]
    """Task; 'imagine-bench list' names them."""

    def __call__(self) -> None:
        """Describe."""
        from imagine_bench.tools.describe import describe  # noqa: PLC0415 - nothing else needs it

        print(describe(self.task))


@dataclass(frozen=True, kw_only=True)
class Film:
    """Film an episode of optimal macro-actions in contact physics, as a GIF."""

    task: str
    """Task to film."""
    appearance: str = APPEARANCES[0]
    """Appearance: a level, or factors."""
    seed: int = 0
    """Chooses the episode."""
    out: Path = Path("film.gif")
    """The GIF to write; never overwritten."""

    def __call__(self) -> None:
        """Film."""
        from imagine_bench.tools.film import film  # noqa: PLC0415 - numpy and pillow only when filming

        print(film(self.task, self.out, seed=self.seed, appearance=self.appearance))


@dataclass(frozen=True, kw_only=True)
class Play:
    """Solve a task by keyboard; says at the end how often, beside chance and optimum."""

    task: Annotated[str | None, tyro.conf.Positional, shown("STR", "(default: the model's)")] = None
    """Task to play."""
    model: Annotated[Path | None, shown("PATH", "(default: none)")] = None
    """A run's folder, whose agent imagines the same keys beside the real scene."""
    execution: Annotated[str | None, shown("STR", "(default: the model's, else the task's)")] = None
    """physics or kinematic."""
    appearance: Annotated[str | None, shown("STR", "(default: the model's, else the task's)")] = None
    """Appearance: a level, or factors."""
    encoder: Annotated[str | None, shown("STR", "(default: the bundled one)")] = None
    """Name or file of the encoder that the model used."""
    seed: int = 0
    """Chooses the episodes."""

    def __call__(self) -> None:
        """Play."""
        from imagine_bench.tools.play import play  # noqa: PLC0415 - an extra

        print(play(self.task, model=self.model, seed=self.seed, execution=self.execution,
                   appearance=self.appearance, encoder=self.encoder))  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Speed:
    """Measure every speed and fidelity figure that has a target, beside the target."""

    turns: int = 2_000
    """Macro-actions of the fidelity measurement."""
    worlds: Annotated[tuple[str, ...] | None, listed("STR", "(default: none)")] = None
    """Worlds, such as arrows:cubes=5, whose fidelity is measured and nothing else."""
    appearances: Annotated[tuple[str, ...], listed("STR")] = APPEARANCES[:1]
    """Appearance levels at which it is."""
    out: Path = Path("runs/speed.json")
    """Where the figures are kept, with the machine's description."""

    def __call__(self) -> None:
        """Measure."""
        from imagine_bench.tools.speed import speed_report  # noqa: PLC0415 - nothing else needs it

        require_values("worlds", self.worlds)
        require_values("appearances", self.appearances)
        if not speed_report(self.out, self.turns, worlds=self.worlds or (), appearances=self.appearances):
            sys.exit(1)


@dataclass(frozen=True, kw_only=True)
class Check:
    """Say whether a task, an agent or a world model, of this suite or another package, keeps the contract."""

    task: Annotated[str | None, shown("STR", "(default: none)")] = None
    """Task to check; with --agent or --model, the one that these are checked in."""
    agent: Annotated[str | None, shown("STR", "(default: none)")] = None
    """Agent to check."""
    model: Annotated[str | None, shown("STR", "(default: none)")] = None
    """World model to check."""

    def __call__(self) -> None:
        """Check."""
        from imagine_bench.testing.contract import checks, report  # noqa: PLC0415 - nothing else needs it

        if report(checks(self.task, self.agent, self.model)):
            sys.exit(1)


@dataclass(frozen=True, kw_only=True)
class New:
    """Write a package of your own with a task, an agent or a world model in it, ready to be changed."""

    kind: Annotated[str, tyro.conf.Positional]
    """task, agent or model."""
    name: Annotated[str, tyro.conf.Positional]
    """Name of the package and of what it offers."""
    out: Path = Path()
    """Folder in which the package's folder is made."""

    def __call__(self) -> None:
        """Write."""
        from imagine_bench.tools.new import new_package  # noqa: PLC0415 - nothing else needs it

        print(new_package(self.kind, self.name, self.out))


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Simulate whether intervals and tests keep their promise on scores such as the kept ones."""

    results: Path = Path("docs/results")
    """Folder of kept results."""
    draws: int = 2_000
    """Benches of every kind."""
    out: Path = Path("runs/coverage.json")
    """Where the rates are kept."""

    def __call__(self) -> None:
        """Simulate."""
        from imagine_bench.tools.coverage import coverage_report  # noqa: PLC0415 - nothing else needs it

        coverage_report(self.results, self.out, self.draws)


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Measure how far friction, force, mass and the planner's errors may go before macro-actions fail."""

    task: str
    """Task whose scene is measured."""
    trials: int = 200
    """Macro-actions of each value."""
    out: Path = Path("runs/margins.json")
    """Where the figures are kept, with the machine's description."""

    def __call__(self) -> None:
        """Measure."""
        from imagine_bench.tools.margins import measure_margins  # noqa: PLC0415 - nothing else needs it

        measure_margins(self.task, self.out, self.trials)


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what this machine and installation have, and in words what is wrong with them."""

    def __call__(self) -> None:
        """Examine."""
        report = examine()
        print(report)
        if report.complaints:
            sys.exit(1)
