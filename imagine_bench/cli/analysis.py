"""The commands that put questions to trained agents."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from imagine_bench import registry
from imagine_bench.cli.options import FolderOrTask, MaybeEncoder, OfTask, TaskWord, listed, path_or_task, shown
from imagine_bench.errors import InvalidValueError, RunFailedError
from imagine_bench.interfaces import APPEARANCES
from imagine_bench.judge.judgement import Judgement, judge
from imagine_bench.judge.verify import cost


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Imagine whole plans from one frame each and let the arm carry them out blindly; leaves figures, a recording."""

    run: FolderOrTask = None
    """The folder of a run, or of a bench, whose best imagining run is taken; or a task whose newest bench is."""
    task: OfTask = None
    """Task whose newest bench is taken."""
    count: int = 100
    """Plans."""
    recorded: int = 5
    """Plans that are recorded too; 0 for none."""
    execution: Annotated[str | None, shown("STR", "(default: the task's)")] = None
    """How macro-actions happen: physics, or kinematic (their outcome is set)."""
    max_epistemic: Annotated[float | None, shown("FLOAT", "(default: the agent's own filter)")] = None
    """A plan with an imagined step of more epistemic uncertainty is refused."""
    encoder: MaybeEncoder = None
    """The encoder the run saw through, where it is not bundled."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Find, plan, report."""
        from imagine_bench.recording.plans import record_plans  # noqa: PLC0415 - Rerun, fonts and pillow load slowly
        from imagine_bench.report.plans import plan_report  # noqa: PLC0415 - as above

        run, task = path_or_task(self.run, self.task)
        print(
            plan_report(
                run,
                root=self.out,
                task=task,
                count=self.count,
                recorded=self.recorded,
                record=record_plans,
                execution=self.execution,
                max_epistemic=self.max_epistemic,
                encoder=self.encoder,
            )
        )


@dataclass(frozen=True, kw_only=True)
class Judge:
    """Judge world models, of this suite and of other packages, against the exact truth of a task's rules."""

    task: TaskWord = "arrow_puzzle"
    """Task whose world is imagined, also as --task TASK."""
    models: Annotated[tuple[str, ...] | None, listed("STR", "(default: all of this suite but slow ones)")] = None
    """World models, as 'imagine-bench describe' names them, or folders of a finished run or of all of an agent's."""
    sizes: Annotated[tuple[int, ...], listed("INT", "(default: 100 300 1000 3000 10000)")] = (
        100,
        300,
        1000,
        3000,
        10000,
    )
    """Transitions of the same data after which models are compared, ascending."""
    seeds: Annotated[tuple[int, ...], listed("INT", "(default: 0 1 2)")] = (0, 1, 2)
    """Seeds, each of data and of models."""
    samples: int = 8
    """Futures imagined of each question."""
    appearance: str = APPEARANCES[0]
    """How much frames vary: a level, or factors such as light=0.5,camera=0.2."""
    policy: str = "random"
    """Who collects the data: random, uniform, oracle or mixed."""
    encoder: Annotated[str | None, shown("NAME|FILE", "(default: the task's)")] = None
    """What models see through that read what it gives, latents or codes."""
    workers: Annotated[int | None, shown("INT", "(default: one a core)")] = None
    """Processes at a time."""
    out: Path = Path("runs/judge")
    """Folder in which judgements are kept; the same command again goes on."""

    def __call__(self) -> None:
        """Judge and report."""
        from imagine_bench.recording.judgement import record_judgement  # noqa: PLC0415 - as above
        from imagine_bench.report.judge import judgement_report  # noqa: PLC0415 - as above

        usual = tuple(name for name, entry in registry.WORLD_MODELS.items() if entry.by_default)
        judgement = Judgement(
            task=self.task, models=self.models or usual, sizes=self.sizes, seeds=self.seeds,
            samples=self.samples, appearance=self.appearance, policy=self.policy, encoder=self.encoder,
        )  # fmt: skip
        folder, failed = judge(judgement, self.out, workers=self.workers or os.cpu_count() or 1)
        print(judgement_report(folder, judgement))
        print(f"Recording: {record_judgement(folder, judgement)}")
        if failed:
            raise RunFailedError("\n".join(failed))


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Play every test episode of a bench again, and say in a line a run whether its tables follow from them.

    With --causes, every failed test episode gets the one cause that it has instead; the report then shows them.
    """

    folder: FolderOrTask = None
    """A bench's folder, or a task whose newest bench is taken."""
    task: OfTask = None
    """Task whose newest bench is taken."""
    causes: bool = False
    """Find the causes of failures: play, swap truth in for each part of the agent, report."""
    encoder: MaybeEncoder = None
    """With --causes: the encoder the runs saw through, where it is not bundled."""
    out: Path = Path("runs")
    """Folder of all benches, where the newest is looked for."""

    def __call__(self) -> None:
        """Play and compare."""
        from imagine_bench.report import page, verify, why  # noqa: PLC0415 - matplotlib loads slowly

        given, task = path_or_task(self.folder, self.task)
        if self.causes:
            print(why.why_report(given, root=self.out, task=task, encoder=self.encoder))
            return
        if self.encoder is not None:
            raise InvalidValueError("--encoder goes with --causes; replaying episodes needs none.")
        folder = page.chosen(given, self.out, task)
        begun_s = time.process_time()
        verdicts = verify.verify(folder)
        print(*verdicts, cost(folder, verdicts, time.process_time() - begun_s), sep="\n")
        if any(verdict.complaint for verdict in verdicts):
            sys.exit(1)
