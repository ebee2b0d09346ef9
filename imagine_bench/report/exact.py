"""Sections that follow from the rules: the world itself, where greedy policies lead, and why agents failed."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from imagine_bench.exact.certificate import certificate_rows
from imagine_bench.judge.causes import CAUSES
from imagine_bench.judge.values import optimal_length, terminations
from imagine_bench.report.data import ReportData, agent_title
from imagine_bench.report.tables import DASH, Cell, Section, Table, decimals, over_seeds, percent
from imagine_bench.rules import greedy
from imagine_bench.store.files import reading

HEAD = ("agent", "seed", "episodes", "tests", "test", "cause")
"""Columns of ``why/causes.csv``: a row a failure, and one a test without any, whose cause is empty."""
_SHARES = {
    "success": "solved",
    "failure": "ends otherwise",
    "late_success": "out of time, then solved",
    "late_failure": "out of time, then ends otherwise",
    "endless": "never ends",
}


def world(data: ReportData) -> Section | None:
    """What follows from the rules alone."""
    found = data.result.certificate
    if found is None:
        return None
    rows = {
        "macrostates": f"{found.macrostates:,}, {found.starts:,} of them starts; {found.horizon} macro-actions",
        "chance level": f"{percent(found.chance_level)} % by uniformly random macro-actions",
        "optimum": f"{percent(found.optimum)} % by perfect play that remembers all that frames showed",
        **certificate_rows(found),
    }
    words = "Nothing here is measured: all of it follows from the rules, by enumeration."
    return Section(
        "The world", [words], tables=[Table("certificate", ["", "certificate"], [*rows.items()], prose=True)]
    )


def policies(data: ReportData) -> Section | None:
    """What policies do from every start of the tests, by the rules.

    Only agents whose macro-action in every macrostate was kept at the last budget are followed. In each macrostate an
    agent does what it did in a frame of it that it read right, if one of a few was.
    """
    if not data.installed:
        return None
    starts = data.result.protocol.spec(testing=True).rules.start_states
    rows = []
    for agent in data.result.protocol.agents:
        kept = [run.checkpoints[-1].beliefs for run in data.result.of(agent)]
        if all(kept):
            actions = [greedy(one.action.astype(np.int64), data.spec.n_actions) for one in kept if one]
            found = [terminations(data.spec, policy, starts) for policy in actions]
            row: dict[str, str | Cell] = {"agent, %": agent_title(agent)}
            for name, words in _SHARES.items():
                row[words] = over_seeds([float(getattr(one, name).mean()) for one in found], share=True)
            row["macro-actions"] = over_seeds([float(one.length.mean()) for one in found], decimals)
            rows.append(row)
    if not rows:
        return None
    optimal = optimal_length(data.spec, starts).mean()
    words = (
        f"At the last budget, each policy is followed by the rules from all {len(starts)} starts, of which the optimal "
        f"one solves each in {optimal:.2f} macro-actions: no episode is sampled, and no frame misread that can be read "
        "right. Interquartile means over seeds [95 %]."
    )
    return Section("Where the greedy policies lead", [words], tables=[Table.of("policies", rows)])


def causes(data: ReportData) -> Section | None:
    """Causes by agent and budget, where 'imagine-bench verify --causes' left them in the bench's folder."""
    table = read_causes(data.result.folder)
    words = (
        "What an optimal policy fails with the same draws of chance, too, was bad luck. Else truth is swapped in, one "
        "stage at a time, until the episode is solved: frames read right; then a perfect plan in the agent's own "
        "model; then the truth about transitions that it never experienced; then all of the truth; then physics as the "
        "rules say. The first stage that solves it names the cause."
    )
    return Section("Why agents failed", [words], tables=[table]) if table.rows else None


def read_causes(bench: Path) -> Table:
    """What was found of a bench; without rows where nothing was. Raises ArtefactError: the file is damaged."""
    path = bench / "why" / "causes.csv"
    if not path.is_file():
        return causes_table([])
    with reading(path, "a table of causes"):
        head, *rows = csv.reader(path.read_text().splitlines())
        if tuple(head) != HEAD:
            raise ValueError(f"its columns are {head}")
        return causes_table(rows)


def causes_table(rows: Iterable[Sequence[object]]) -> Table:
    """Shares of the failures of all seeds by agent and budget, from rows below :data:`HEAD`; no cause is no failure.

    Raises:
        ValueError: A cause that is none.
    """
    found: dict[tuple[str, str], list[list[str]]] = {}
    for row in rows:
        agent, seed, budget, tests, _, cause = map(str, row)
        if cause and cause not in CAUSES:
            raise ValueError(f"{cause!r} is no cause")
        found.setdefault((agent, budget), []).append([seed, tests, cause])
    lines = []
    for (agent, budget), own in found.items():
        counts = Counter(cause for _, _, cause in own if cause)
        total = counts.total()
        tested = sum({seed: int(tests) for seed, tests, _ in own}.values())
        shares = [percent(counts[name] / total) if total else DASH for name in CAUSES]
        lines.append([agent_title(agent), f"{int(budget):,}", f"{total:,} of {tested:,}", *shares])
    header = ["agent", "real episodes", "failures", *(f"{name}, %" for name in CAUSES)]
    meanings = "; ".join(f"{name}: {words}" for name, words in CAUSES.items())
    return Table("causes", header, lines, f"Shares of the failures. {meanings}.", why_dash="nothing failed")
