"""How far a bench's agents generalise, as a table for the terminal, a page, and one row a transition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench import reference
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.generalisation import Answers, Generalisation, Probing, consequence
from imagine_bench.report.text import agent_words, few_words, mean_text, origin, percent
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import csv_text, make_folder, with_null, write_bytes, write_json

_ROWS = {
    "unseen": "next macrostate right, out of terminal macrostates (never seen), %",
    "unseen_legal": "of these out of legal ones (goals), %",
    "unseen_likeliest": "of all these by what the model holds likeliest, instead of what it draws, %",
    "seen": "next macrostate right, out of all others, %",
    "seen_likeliest": "of these by what the model holds likeliest, %",
    "auroc": "doubt tells the unseen from the others (AUROC, %)",
}


_Groups = dict[tuple[str, int], list[Generalisation]]
"""The seeds of an agent after so many real episodes; runs of an unfinished bench may differ in these."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """One run, and what it answered after ``episodes`` real training episodes."""

    agent: str
    seed: int
    episodes: int
    answers: Answers
    summary: Generalisation


def generalisation_table(asked: Sequence[Asked], probe: Probing, task: TaskSpec) -> str:
    """Means over the seeds of each agent with 95 % intervals, as Markdown, the thesis' figure beside them."""
    thesis = {} if task.reference is None else reference.load(task.reference).get("generalisation", {})
    groups = _groups(asked)
    fewest = min((len(runs) for runs in groups.values() if len(runs) > 1), default=1)
    unseen = int(probe.terminal.sum())
    heads = [f"{_title(group)} ({len(runs)} seed(s))" for group, runs in groups.items()]
    lines = [
        f"{unseen} transitions out of terminal macrostates, {len(probe.terminal) - unseen} others; mean over seeds "
        f"[95 % interval over seeds]. {' '.join(few_words(fewest))}".rstrip(),
        "",
        f"| {task.title} | {' | '.join(heads)} | thesis |",
        f"|---|{'---|' * len(groups)}---|",
    ]
    for name, words in _ROWS.items():
        cells = [_cell([getattr(run, name) for run in runs], name) for runs in groups.values()]
        there = f"{thesis['correct']} (of {thesis['attempted']})" if name == "unseen" and thesis else "–"
        if any(cell != "–" for cell in (*cells, there)):
            lines.append(f"| {words} | {' | '.join(cells)} | {there} |")
    return "\n".join([*lines, "", *_consequence_lines(groups), *_experience_lines(groups)])


def _groups(asked: Sequence[Asked]) -> _Groups:
    groups: _Groups = {}
    for one in asked:
        groups.setdefault((one.agent, one.episodes), []).append(one.summary)
    return groups


def _title(group: tuple[str, int]) -> str:
    return f"{agent_words(group[0]).title}, {group[1]:,} episodes"


def _consequence_lines(groups: _Groups) -> list[str]:
    """The transitions that training can contain, by what the rules say comes of them: one row an agent and kind."""
    lines = [
        "The others, by what the rules say comes of them:",
        "",
        "| agent | consequence | transitions | next macrostate right, % | end right, % | reward's mean error |",
        "|---|---|---|---|---|---|",
    ]
    for group, runs in groups.items():
        for name in runs[0].consequences:
            marks = [run.consequences[name] for run in runs]
            right = _cell([one.right for one in marks], f"{name} right")
            end = _cell([one.end_right for one in marks], f"{name} end")
            reward = _cell([one.reward_error for one in marks], f"{name} reward", _plain)
            lines.append(f"| {_title(group)} | {name} | {marks[0].count} | {right} | {end} | {reward} |")
    return lines


def _experience_lines(groups: _Groups) -> list[str]:
    """The same transitions by how often the agents had them: one row an agent that can say so, and number."""
    lines = [
        "",
        "The others, by how often the agent remembers having had them:",
        "",
        "| agent | had | transitions | next macrostate right, % | by what the model holds likeliest, % |",
        "|---|---|---|---|---|",
    ]
    rows = []
    for group, runs in groups.items():
        for name in runs[0].experience:
            parts = [run.experience[name] for run in runs]
            count = _cell([float(one.count) for one in parts], f"{name} count", "{:.0f}".format)
            right = _cell([one.right for one in parts], f"{name} right")
            likeliest = _cell([one.likeliest_right for one in parts], f"{name} likeliest")
            rows.append(f"| {_title(group)} | {name} | {count} | {right} | {likeliest} |")
    return [*lines, *rows] if rows else []


def write_generalisation(
    folder: Path, asked: Sequence[Asked], probe: Probing, task: TaskSpec, facts: dict[str, Any]
) -> None:
    """Write ``transitions.csv``, ``summary.json`` and ``generalisation.md``.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    runs = [{"agent": one.agent, "seed": one.seed, "episodes": one.episodes, **asdict(one.summary)} for one in asked]
    write_bytes(folder / "transitions.csv", _csv(asked, probe).encode())
    write_json(folder / "summary.json", {**facts, "runs": with_null(runs)})
    table = generalisation_table(asked, probe, task)
    page = f"# {task.title}: transitions that no training can contain\n\n{table}\n\n{origin(facts)}\n"
    write_bytes(folder / "generalisation.md", page.encode())


def _number(values: NDArray[np.bool_] | NDArray[np.int64] | None, index: int) -> str:
    return "" if values is None else str(int(values[index]))


def _plain(value: float) -> str:
    return f"{value:.2f}"


def _cell(values: Sequence[float], name: str, words: Callable[[float], str] = percent) -> str:
    return mean_text(values, SeedTree(0).child("report", "generalisation", name).generator(), words)


def _csv(asked: Sequence[Asked], probe: Probing) -> str:
    head = [
        "agent", "seed", "episodes", "macrostate", "action", "terminal", "legal", "consequence",
        "right", "end_right", "reward_error", "epistemic", "likeliest_right", "times",
    ]  # fmt: skip
    rows = [
        [
            one.agent, one.seed, one.episodes, " ".join(map(str, state)), int(probe.actions[index]),
            int(probe.terminal[index]), int(probe.legal[index]), consequence(probe.possible[index]) or "open",
            int(one.answers.right[index]), int(one.answers.end_right[index]),
            f"{one.answers.reward_error[index]:.6g}", f"{one.answers.epistemic[index]:.6g}",
            _number(one.answers.likeliest_right, index), _number(one.answers.times, index),
        ]
        for one in asked
        for index, state in enumerate(probe.macrostates)
    ]  # fmt: skip
    return csv_text([head, *rows])
