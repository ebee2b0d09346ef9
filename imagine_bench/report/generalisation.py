"""How far a bench's agents generalise, as a table for the terminal, a page, and one row a transition."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import reference, statistics
from imagine_bench.files import make_folder, write_bytes, write_json
from imagine_bench.generalisation import Answers, Generalisation, Probing
from imagine_bench.interfaces import TaskSpec
from imagine_bench.report.words import agent_words, percent
from imagine_bench.seeding import SeedTree

_ROWS = {
    "unseen": "next macrostate right, out of terminal macrostates (never seen), %",
    "unseen_legal": "of these out of legal ones (goals), %",
    "seen": "next macrostate right, out of all others, %",
    "auroc": "doubt tells the unseen from the others (AUROC, %)",
}


@dataclass(frozen=True, kw_only=True)
class Asked:
    """One run and what it answered."""

    agent: str
    seed: int
    answers: Answers
    summary: Generalisation


def generalisation_table(asked: Sequence[Asked], probe: Probing, task: TaskSpec) -> str:
    """Means over the seeds of each agent with 95 % intervals, as Markdown, the thesis' figure beside them."""
    thesis = {} if task.reference is None else reference.load(task.reference).get("generalisation", {})
    agents = list(dict.fromkeys(one.agent for one in asked))
    seeds = len({one.seed for one in asked})
    unseen = int(probe.terminal.sum())
    lines = [
        f"{unseen} transitions out of terminal macrostates, {len(probe.terminal) - unseen} others; mean of {seeds} "
        f"seed(s) [95 % interval over seeds]",
        "",
        f"| {task.title} |{''.join(f' {agent_words(agent).title} |' for agent in agents)} thesis |",
        f"|---|{'---|' * len(agents)}---|",
    ]
    for name, words in _ROWS.items():
        cells = [_cell([getattr(one.summary, name) for one in asked if one.agent == agent], name) for agent in agents]
        there = f"{thesis['correct']} (of {thesis['attempted']})" if name == "unseen" and thesis else "–"
        lines.append(f"| {words} | {' | '.join(cells)} | {there} |")
    return "\n".join(lines)


def write_generalisation(
    folder: Path, asked: Sequence[Asked], probe: Probing, task: TaskSpec, facts: dict[str, Any]
) -> None:
    """Write ``transitions.csv``, ``summary.json`` and ``generalisation.md``.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    runs = [{"agent": one.agent, "seed": one.seed, **asdict(one.summary)} for one in asked]
    write_bytes(folder / "transitions.csv", _csv(asked, probe).encode())
    write_json(folder / "summary.json", {**facts, "runs": runs})
    page = f"# {task.title}: transitions that no training can contain\n\n{generalisation_table(asked, probe, task)}\n"
    write_bytes(folder / "generalisation.md", page.encode())


def _cell(values: Sequence[float], name: str) -> str:
    if any(math.isnan(value) for value in values):
        return "–"
    mean = percent(float(np.mean(values)))
    if len(values) == 1:
        return mean
    rng = SeedTree(0).child("report", "generalisation", name).generator()
    low, high = statistics.bootstrap_interval(values, rng, statistic="mean")
    return f"{mean} [{percent(low)}, {percent(high)}]"


def _csv(asked: Sequence[Asked], probe: Probing) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["agent", "seed", "macrostate", "action", "terminal", "legal", "right", "epistemic"])
    for one in asked:
        for index, state in enumerate(probe.macrostates):
            table.writerow([
                one.agent, one.seed, " ".join(map(str, state)), int(probe.actions[index]), int(probe.terminal[index]),
                int(probe.legal[index]), int(one.answers.right[index]), f"{one.answers.epistemic[index]:.6g}",
            ])  # fmt: skip
    return text.getvalue()
