"""Where the greedy policies of a bench's agents lead, as a table for the terminal, a page, and one row a start."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.files import make_folder, write_bytes, write_json
from imagine_bench.interfaces import TaskSpec
from imagine_bench.policy import FRAMES, Ends
from imagine_bench.report.words import agent_words, few_words, mean_text, percent
from imagine_bench.seeding import SeedTree

_SHARES = ("success", "failure", "late", "never")
_SURE = 0.999
_LISTED = 12
"""Starts that the page lists; the others are in the table of all."""


@dataclass(frozen=True, kw_only=True)
class Followed:
    """One run, and where its policy led after ``episodes`` real training episodes."""

    agent: str
    seed: int
    episodes: int
    ends: Ends


def policy_table(followed: Sequence[Followed], task: TaskSpec) -> str:
    """Means over the seeds of each agent with 95 % intervals, and the starts that are not solved, as Markdown."""
    starts = len(task.rules.start_states)
    groups = list(dict.fromkeys((one.agent, one.episodes) for one in followed))
    most = max(Counter((one.agent, one.episodes) for one in followed).values())
    lines = [
        f"All {starts} starts, followed by the rules; every visit of a macrostate shows one of {FRAMES} frames of it. "
        f"Mean over seeds [95 % interval over seeds]. {' '.join(few_words(most))}".rstrip(),
        "",
        "| agent | real episodes | seeds | solved, % | ends otherwise, % | solved after the last macro-action, % "
        f"| never, % | macro-actions (optimal: {_optimal(followed):.2f}) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for agent, episodes in groups:
        ends = [one.ends for one in followed if (one.agent, one.episodes) == (agent, episodes)]
        cells = [_cell([getattr(one, share) for one in ends], f"{agent} {share}") for share in _SHARES]
        cells.append(_cell([one.length for one in ends], f"{agent} length", "{:.2f}".format))
        lines.append(f"| {agent_words(agent).title} | {episodes:,} | {len(ends)} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *_unsolved(followed, task)])


def write_policy(folder: Path, followed: Sequence[Followed], task: TaskSpec, facts: dict[str, Any]) -> None:
    """Write ``starts.csv``, ``summary.json`` and ``policy.md``.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    runs = [
        {
            "agent": one.agent,
            "seed": one.seed,
            "episodes": one.episodes,
            **{name: float(getattr(one.ends, name).mean()) for name in (*_SHARES, "length", "shortest")},
        }
        for one in followed
    ]
    write_bytes(folder / "starts.csv", _csv(followed, task).encode())
    write_json(folder / "summary.json", {**facts, "runs": runs})
    page = f"# {task.title}: where the greedy policies lead\n\n{policy_table(followed, task)}\n"
    write_bytes(folder / "policy.md", page.encode())


def _optimal(followed: Sequence[Followed]) -> float:
    return float(followed[0].ends.shortest.mean())


def _unsolved(followed: Sequence[Followed], task: TaskSpec) -> list[str]:
    """The starts that most runs do not solve for sure, with what an optimal agent needs there."""
    failing = np.array([one.ends.success < _SURE for one in followed])  # [runs, starts]
    order = [index for index in np.argsort(-failing.sum(axis=0), kind="stable") if failing[:, index].any()]
    if not order:
        return ["Every run solves every start."]
    lines = [
        f"Starts that some run does not always solve: {len(order)}; the {min(len(order), _LISTED)} of most runs:",
        "",
        "| start | optimal macro-actions | runs that do not always solve it |",
        "|---|---|---|",
    ]
    for index in order[:_LISTED]:
        runs = Counter(one.agent for one, fails in zip(followed, failing[:, index], strict=True) if fails)
        who = ", ".join(f"{agent_words(agent).title}: {count}" for agent, count in runs.items())
        needs = followed[0].ends.shortest[index]
        lines.append(f"| {_words(task.rules.start_states[index], task)} | {needs:.2f} | {who} |")
    return lines


def _words(macrostate: tuple[int, ...], task: TaskSpec) -> str:
    named = zip(task.macrostate_names, task.macrostate_values, macrostate, strict=True)
    return ", ".join(f"{name} {values[value]}" for name, values, value in named)


def _cell(parts: Sequence[NDArray[np.float64]], name: str, words: Callable[[float], str] = percent) -> str:
    values = [float(part.mean()) for part in parts]
    return mean_text(values, SeedTree(0).child("report", "policy", name).generator(), words)


def _csv(followed: Sequence[Followed], task: TaskSpec) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["agent", "seed", "episodes", *task.macrostate_names, *_SHARES, "length", "shortest"])
    for one in followed:
        for index, state in enumerate(task.rules.start_states):
            named = [values[value] for values, value in zip(task.macrostate_values, state, strict=True)]
            numbers = [getattr(one.ends, name)[index] for name in (*_SHARES, "length", "shortest")]
            table.writerow([one.agent, one.seed, one.episodes, *named, *(f"{number:.6g}" for number in numbers)])
    return text.getvalue()
