"""Where the greedy policies of a bench's agents lead, as a table for the terminal, a page, and one row a start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.policy import FRAMES, Ends, optimal_length
from imagine_bench.report.text import agent_words, few_words, mean_text, origin, percent
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import csv_text, make_folder, write_bytes, write_json

_SHARES = {
    "success": "solved",
    "failure": "ends otherwise",
    "late_success": "out of time, then solved",
    "late_failure": "out of time, then ends otherwise",
    "endless": "never ends",
}
_SURE = 0.999
"""From here on a start counts as always solved: rules may leave something to chance."""
_LISTED = 12
"""Starts that the page lists; starts.csv has all."""

_Groups = dict[tuple[str, int], list[Ends]]
"""The seeds of an agent after so many real episodes; runs of an unfinished bench may differ in these."""


@dataclass(frozen=True, kw_only=True)
class Followed:
    """One run, and where its policy led after ``episodes`` real training episodes."""

    agent: str
    seed: int
    episodes: int
    ends: Ends


def policy_table(followed: Sequence[Followed], task: TaskSpec) -> str:
    """Means over the seeds of each agent with 95 % intervals, and the starts that are missed most, as Markdown."""
    groups, optimal = _groups(followed), optimal_length(task)
    fewest = min((len(ends) for ends in groups.values() if len(ends) > 1), default=1)
    lines = [
        f"All {len(task.rules.start_states)} starts, followed by the rules; every visit of a macrostate shows one of "
        f"{FRAMES} frames of it. Mean over seeds [95 % interval over seeds]. "
        f"{' '.join(few_words(fewest))}".rstrip(),
        "",
        f"| agent | real episodes | seeds | {' | '.join(f'{words}, %' for words in _SHARES.values())} "
        f"| macro-actions (optimal: {optimal.mean():.2f}) |",
        f"|---|---|---|{'---|' * len(_SHARES)}---|",
    ]
    for (agent, episodes), ends in groups.items():
        cells = [_cell([getattr(one, share) for one in ends], f"{agent} {share}") for share in _SHARES]
        cells.append(_cell([one.length for one in ends], f"{agent} length", "{:.2f}".format))
        lines.append(f"| {agent_words(agent).title} | {episodes:,} | {len(ends)} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *_by_distance(groups, optimal), "", *_missed(groups, optimal, task)])


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
            **{name: float(getattr(one.ends, name).mean()) for name in (*_SHARES, "length")},
        }
        for one in followed
    ]
    write_bytes(folder / "starts.csv", _csv(followed, task).encode())
    write_json(folder / "summary.json", {**facts, "runs": runs})
    page = f"# {task.title}: where the greedy policies lead\n\n{policy_table(followed, task)}\n\n{origin(facts)}\n"
    write_bytes(folder / "policy.md", page.encode())


def _groups(followed: Sequence[Followed]) -> _Groups:
    groups: _Groups = {}
    for one in followed:
        groups.setdefault((one.agent, one.episodes), []).append(one.ends)
    return groups


def _by_distance(groups: _Groups, optimal: NDArray[np.float64]) -> list[str]:
    """What is solved of the starts from which an optimal agent needs equally long, in whole macro-actions."""
    needs = optimal.round().astype(int)
    solved = _solved(groups)
    lines = [f"| optimal macro-actions | starts | {_heads(groups)} |", f"|---|---|{'---|' * len(groups)}"]
    for need in np.unique(needs):
        cells = " | ".join(percent(float(share)) for share in solved[:, needs == need].mean(axis=1))
        lines.append(f"| {need} | {int((needs == need).sum())} | {cells} |")
    return lines


def _missed(groups: _Groups, optimal: NDArray[np.float64], task: TaskSpec) -> list[str]:
    """The starts that are solved least, with what an optimal agent needs there."""
    solved = _solved(groups)
    worst = np.min([one.success for ends in groups.values() for one in ends], axis=0)  # [starts]
    order = [index for index in np.argsort(solved.mean(axis=0), kind="stable") if worst[index] < _SURE]
    if not order:
        return ["Every run solves every start."]
    lines = [
        f"Starts that some run does not always solve: {len(order)} of {len(optimal)}. Solved least:",
        "",
        f"| start | optimal macro-actions | {_heads(groups)} |",
        f"|---|---|{'---|' * len(groups)}",
    ]
    for index in order[:_LISTED]:
        cells = " | ".join(percent(float(share)) for share in solved[:, index])
        lines.append(f"| {_words(task.rules.start_states[index], task)} | {optimal[index]:.2f} | {cells} |")
    return lines


def _solved(groups: _Groups) -> NDArray[np.float64]:
    """Mean over the seeds of each group, of each start. Shape (groups, starts)."""
    return np.array([np.mean([one.success for one in ends], axis=0) for ends in groups.values()])


def _heads(groups: _Groups) -> str:
    return " | ".join(f"{agent_words(agent).title}, {episodes:,} episodes: solved, %" for agent, episodes in groups)


def _words(macrostate: tuple[int, ...], task: TaskSpec) -> str:
    named = zip(task.macrostate_names, task.value_names(macrostate), strict=True)
    return ", ".join(f"{name} {value}" for name, value in named)


def _cell(parts: Sequence[NDArray[np.float64]], name: str, words: Callable[[float], str] = percent) -> str:
    values = [float(part.mean()) for part in parts]
    return mean_text(values, SeedTree(0).child("report", "policy", name).generator(), words)


def _csv(followed: Sequence[Followed], task: TaskSpec) -> str:
    optimal = optimal_length(task)
    rows = [["agent", "seed", "episodes", *task.macrostate_names, *_SHARES, "length", "optimal_length"]]
    for one in followed:
        for index, state in enumerate(task.rules.start_states):
            numbers = [*(getattr(one.ends, name)[index] for name in (*_SHARES, "length")), optimal[index]]
            shares = [f"{number:.6g}" for number in numbers]
            rows.append([one.agent, str(one.seed), str(one.episodes), *task.value_names(state), *shares])
    return csv_text(rows)
