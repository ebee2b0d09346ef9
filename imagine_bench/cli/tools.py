"""The commands beside benches: viewing, playing, describing, checking, and what this machine has."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from imagine_bench.cli.options import (
    FolderOrTask,
    MaybeTaskWord,
    OfTask,
    listed,
    only,
    path_or_task,
    require_values,
    shown,
)
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import APPEARANCES
from imagine_bench.store.bench_folder import newest_recording
from imagine_bench.tools.describe import describe, names
from imagine_bench.tools.doctor import examine


@dataclass(frozen=True, kw_only=True)
class ViewCommand:
    """Open a recording in the Rerun viewer."""

    file: FolderOrTask = None
    """The .rrd file, or a task whose newest recording is taken."""
    task: OfTask = None
    """Task whose newest recording is taken."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Find and open."""
        from imagine_bench.recording.stream import open_in_viewer  # noqa: PLC0415 - Rerun loads slowly

        file, task = path_or_task(self.file, self.task)
        open_in_viewer(file or newest_recording(self.out, *only(task)))


@dataclass(frozen=True, kw_only=True)
class Describe:
    """Say what a task is, exactly: macro-actions, chance, optimum, plan lengths. Without a task, name everything."""

    task: MaybeTaskWord = None
    """Task to describe, also as --task TASK."""

    def __call__(self) -> None:
        """Describe, or list."""
        print(names() if self.task is None else describe(self.task))


@dataclass(frozen=True, kw_only=True)
class Play:
    """Solve a task by keyboard; says at the end how often, beside chance and optimum. Or film the oracle."""

    task: MaybeTaskWord = None
    """Task to play, also as --task TASK; by default that of --model."""
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
    film: bool = False
    """Film an episode of optimal macro-actions in contact physics instead, as a GIF."""
    out: Path = Path("film.gif")
    """With --film: the GIF to write; never overwritten."""

    def __call__(self) -> None:
        """Play, or film."""
        from imagine_bench.tools import film, play  # noqa: PLC0415 - pillow loads slowly

        if not self.film:
            options = {"execution": self.execution, "appearance": self.appearance, "encoder": self.encoder}
            print(play.play(self.task, model=self.model, seed=self.seed, **options))
            return
        if self.task is None or self.model is not None:
            raise InvalidValueError("A film is of the oracle in a task; give a task and no --model.")
        print(film.film(self.task, self.out, seed=self.seed, appearance=self.appearance or APPEARANCES[0]))


@dataclass(frozen=True, kw_only=True)
class CheckCommand:
    """Say whether a task, an agent or a world model, of this suite or another package, keeps the contract."""

    task: MaybeTaskWord = None
    """Task to check, also as --task TASK; with --agent or --model, the one that these are checked in."""
    agent: Annotated[str | None, shown("STR", "(default: none)")] = None
    """Agent to check."""
    model: Annotated[str | None, shown("STR", "(default: none)")] = None
    """World model to check."""
    physics: bool = False
    """Measure the task's contact physics instead: fidelity to the rules at random, then how far friction, force, mass
    and the planner's errors may go before macro-actions fail."""
    turns: int = 2_000
    """With --physics: macro-actions of the fidelity measurement; 0 for none."""
    trials: int = 200
    """With --physics: macro-actions of each value of each setting; 0 for none."""
    appearances: Annotated[tuple[str, ...], listed("STR", "(default: clean)")] = APPEARANCES[:1]
    """With --physics: appearance levels at which fidelity is measured."""
    out: Path = Path("runs/margins.json")
    """With --physics: the file in which the figures are kept, with the machine's description."""

    def __call__(self) -> None:
        """Check."""
        from imagine_bench.testing import contract, physics  # noqa: PLC0415 - nothing else needs them

        if not self.physics:
            failed = contract.report(contract.checks(self.task, self.agent, self.model)) > 0
        elif self.task is None:
            raise InvalidValueError("Physics is measured of a task; give one.")
        else:
            require_values("appearances", self.appearances)
            failed = not physics.check_physics(
                self.task, self.out, turns=self.turns, trials=self.trials, appearances=self.appearances
            )
        if failed:
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
class Doctor:
    """Say what this machine and installation have, and in words what is wrong with them."""

    def __call__(self) -> None:
        """Examine."""
        report = examine()
        print(report)
        if report.complaints:
            sys.exit(1)
