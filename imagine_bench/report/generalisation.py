"""How far a bench's agents generalise, as a table for the terminal, a page, and one row a transition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from imagine_bench import reference
from imagine_bench.files import csv_text, make_folder, write_bytes, write_json
from imagine_bench.generalisation import Answers, Generalisation, Probing, consequence
from imagine_bench.interfaces import TaskSpec
from imagine_bench.report.words import agent_words, few_words, mean_text, percent
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
        f"seed(s) [95 % interval over seeds]. {' '.join(few_words(seeds))}".rstrip(),
        "",
        f"| {task.title} |{''.join(f' {agent_words(agent).title} |' for agent in agents)} thesis |",
        f"|---|{'---|' * len(agents)}---|",
    ]
    for name, words in _ROWS.items():
        cells = [_cell([getattr(one.summary, name) for one in asked if one.agent == agent], name) for agent in agents]
        there = f"{thesis['correct']} (of {thesis['attempted']})" if name == "unseen" and thesis else "–"
        lines.append(f"| {words} | {' | '.join(cells)} | {there} |")
    return "\n".join([*lines, "", *_consequence_lines(asked)])


def _consequence_lines(asked: Sequence[Asked]) -> list[str]:
    """The transitions that training can contain, by what the rules say comes of them: one row an agent and kind."""
    lines = [
        "The others, by what the rules say comes of them:",
        "",
        "| agent | consequence | transitions | next macrostate right, % | end right, % | reward's mean error |",
        "|---|---|---|---|---|---|",
    ]
    for agent in dict.fromkeys(one.agent for one in asked):
        runs = [one.summary.consequences for one in asked if one.agent == agent]
        for name in runs[0]:
            marks = [run[name] for run in runs]
            right = _cell([one.right for one in marks], f"{name} right")
            end = _cell([one.end_right for one in marks], f"{name} end")
            reward = _cell([one.reward_error for one in marks], f"{name} reward", _plain)
            lines.append(f"| {agent_words(agent).title} | {name} | {marks[0].count} | {right} | {end} | {reward} |")
    return lines


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


def _plain(value: float) -> str:
    return f"{value:.2f}"


def _cell(values: Sequence[float], name: str, words: Callable[[float], str] = percent) -> str:
    return mean_text(values, SeedTree(0).child("report", "generalisation", name).generator(), words)


def _csv(asked: Sequence[Asked], probe: Probing) -> str:
    head = [
        "agent", "seed", "macrostate", "action", "terminal", "legal", "consequence",
        "right", "end_right", "reward_error", "epistemic",
    ]  # fmt: skip
    rows = [
        [
            one.agent, one.seed, " ".join(map(str, state)), int(probe.actions[index]), int(probe.terminal[index]),
            int(probe.legal[index]), consequence(probe.possible[index]) or "open",
            int(one.answers.right[index]), int(one.answers.end_right[index]),
            f"{one.answers.reward_error[index]:.6g}", f"{one.answers.epistemic[index]:.6g}",
        ]
        for one in asked
        for index, state in enumerate(probe.macrostates)
    ]  # fmt: skip
    return csv_text([head, *rows])
