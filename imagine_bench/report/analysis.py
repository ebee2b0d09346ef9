"""Analyses of trained agents: find a bench, take its agents up again, measure each, and keep a table, page and rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from imagine_bench import registry
from imagine_bench.bench.progress import counted
from imagine_bench.interfaces import TaskSpec
from imagine_bench.machine import describe_environment
from imagine_bench.protocols.task_types import task_type
from imagine_bench.report.text import agent_words, origin
from imagine_bench.seeding import Purpose, evaluation_split
from imagine_bench.store.bench_folder import newest_bench, require_either
from imagine_bench.store.files import csv_text, lock, make_folder, with_null, write_bytes, write_json
from imagine_bench.store.trained import Trained, learners, load_trained, protocol_of_agents, require_control

Value = TypeVar("Value")
MEANS = "mean over seeds [95 % interval over seeds]."  # what the figures of a table are


@dataclass(frozen=True, kw_only=True)
class Measured(Generic[Value]):
    """What an analysis measured of one run after ``episodes`` real training episodes."""

    agent: str
    seed: int
    episodes: int
    value: Value

    @property
    def head(self) -> dict[str, Any]:
        """Which run it is."""
        return {"agent": self.agent, "seed": self.seed, "episodes": self.episodes}


class Groups(dict[tuple[str, int], list[Value]]):
    """The seeds of an agent after so many real episodes; runs of an unfinished bench may differ in these."""

    def __init__(self, runs: Sequence[Measured[Value]]) -> None:
        for run in runs:
            self.setdefault((run.agent, run.episodes), []).append(run.value)

    @property
    def titles(self) -> list[str]:
        """What each group is called."""
        return [f"{agent_words(agent).title}, {episodes:,} episodes" for agent, episodes in self]


class Analysis(ABC, Generic[Value]):
    """One analysis of a task's agents, on kinematic frames; a bench's folder keeps it as ``<name>/``."""

    name: ClassVar[str]
    heading: ClassVar[str]
    rows_file: ClassVar[str]

    def __init__(self, spec: TaskSpec, *, appearance: str, purpose: Purpose = "evaluation") -> None:
        self.spec = spec

    @abstractmethod
    def measure(self, trained: Trained) -> Value:
        """Measure one agent, which is not changed."""

    @abstractmethod
    def table(self, runs: Sequence[Measured[Value]]) -> str:
        """Means over the seeds of each agent with 95 % intervals, as Markdown."""

    @abstractmethod
    def rows(self, runs: Sequence[Measured[Value]]) -> Iterable[Sequence[object]]:
        """Every figure of every run, the head first."""

    @abstractmethod
    def summary(self, value: Value) -> dict[str, Any]:
        """One run in a few numbers."""

    def write(self, folder: Path, runs: Sequence[Measured[Value]], provenance: dict[str, Any]) -> None:
        """Write all rows, ``summary.json`` and ``<name>.md``.

        Raises:
            SetupError: The folder cannot be written.
        """
        make_folder(folder)
        write_bytes(folder / self.rows_file, csv_text(self.rows(runs)).encode())
        summaries = [{**run.head, **self.summary(run.value)} for run in runs]
        write_json(folder / "summary.json", {**provenance, "runs": with_null(summaries)})
        page = f"# {self.spec.title}: {self.heading}\n\n{self.table(runs)}\n\n{origin(provenance)}\n"
        write_bytes(folder / f"{self.name}.md", page.encode())


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a table."""
    first, *others = (f"| {' | '.join(map(str, row))} |" for row in (head, *rows))
    return [first, f"|{'---|' * len(head)}", *others]


def analyse(
    analysis: type[Analysis[Value]], folder: Path | None, *, root: Path, task: str | None, encoder: str | None,
) -> str:  # fmt: skip
    """Measure every learner of a bench, and leave the analysis in its folder.

    An unfinished bench will do: every run is measured as its last checkpoint left it. The bench is as in
    :func:`chosen`, ``encoder`` is as in :func:`imagine_bench.store.trained.load_trained`. Returns what to print.

    Raises:
        ImagineBenchError: No bench, or none with an agent that can be taken up again.
        BusyError: Another process is at the same analysis.
        SetupError: The bench's folder cannot be written.
    """
    bench = chosen(folder, root, task)
    protocol = protocol_of_agents(bench)
    where = bench / analysis.name
    with lock(bench / f".{where.name}.lock", f"The folder {where}"):
        spec, appearance, folders = registry.task(protocol.task), protocol.appearance_in_tests, learners(bench)
        found = analysis(spec, appearance=appearance, purpose=evaluation_split(protocol.seeds[0]))
        runs = []
        for run in counted(folders, "runs", total=len(folders)):
            trained = load_trained(run, encoder=encoder)
            name, seed, value = trained.spec.agent, trained.spec.seed, found.measure(trained)
            runs.append(Measured(agent=name, seed=seed, episodes=trained.episodes, value=value))
        facts = {**provenance(protocol.hash), "appearance": appearance, "frames": "kinematic"}
        found.write(where, runs, facts)
    return f"{spec.title}, {appearance}\n\n{found.table(runs)}\n\nAll rows:   {where / found.rows_file}"


def chosen(given: Path | None, root: Path, task: str | None) -> Path:
    """What was given, or else the newest bench of a task in which agents act, or of all such tasks.

    Raises:
        ImagineBenchError: Both are given, or there is no such bench.
    """
    require_either(given, task)
    if task is not None:
        task_type(task)  # knows every name
        require_control(task, f"Task {task!r}")
    return given or newest_bench(root, tuple(registry.tasks()) if task is None else (task,))


def provenance(protocol_hash: str) -> dict[str, Any]:
    """Protocol, commit and command of a figure."""
    environment = describe_environment()
    return {"protocol_hash": protocol_hash, **{name: environment.get(name) for name in ("commit", "command")}}
