"""Sections that follow from the rules: the world itself, where greedy policies lead, and why agents failed."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from imagine_bench.exact.certificate import certificate_rows
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.judge.causes import CAUSES
from imagine_bench.judge.values import Terminations, optimal_length, terminations
from imagine_bench.report import figures
from imagine_bench.report.data import ReportData, agent_title
from imagine_bench.report.tables import DASH, Section, Table, decimals, mean_text, percent
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
_SURE = 0.999  # from here on a start counts as always solved: rules may leave something to chance
_LISTED = 12  # starts that are listed, those solved least


# The world ---------------------------------------------------------------------------------------------------------


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
    words = ["Nothing here is measured: all of it follows from the rules, by enumeration."]
    table = Table("certificate", ["", "certificate"], [*map(list, rows.items())], prose=True)
    return Section("The world", words, tables=[table])


# Policies ----------------------------------------------------------------------------------------------------------


def followed(data: ReportData) -> dict[str, list[Terminations]]:
    """By agent, where the greedy policy of each seed leads from the tests' starts, by the rules.

    Only agents whose macro-action in every macrostate was kept at the last budget are followed. In each macrostate an
    agent does what it did in a frame of it that it read right, if one of a few was.
    """
    found = {}
    for agent in data.agents if data.installed else ():
        kept = [run.checkpoints[-1].beliefs for run in data.result.of(agent)]
        if all(kept):
            actions = [greedy(one.action.astype(np.int64), data.spec.n_actions) for one in kept if one]
            found[agent] = [terminations(data.spec, policy, _starts(data)) for policy in actions]
    return found


def _starts(data: ReportData) -> tuple[State, ...]:
    return data.result.protocol.spec(testing=True).rules.start_states


def policies(data: ReportData) -> Section | None:
    """What policies do from every start, by the shortest plan, and from the starts that they miss."""
    found = followed(data)
    if not found:
        return None
    starts = _starts(data)
    optimal = optimal_length(data.spec, starts)
    needs = optimal.round().astype(int)
    titles = list(map(agent_title, found))
    solved = np.array([np.mean([one.success for one in seeds], axis=0) for seeds in found.values()])  # [agents, starts]
    worst = np.min([one.success for seeds in found.values() for one in seeds], axis=0)  # [starts]
    missed = [at for at in np.argsort(solved.mean(axis=0), kind="stable") if worst[at] < _SURE]
    rows = []
    for title, seeds in zip(titles, found.values(), strict=True):
        shares = [mean_text([float(getattr(one, name).mean()) for one in seeds]) for name in _SHARES]
        rows.append([title, *shares, mean_text([float(one.length.mean()) for one in seeds], decimals)])
    lengths = []
    for need in np.unique(needs):
        here = needs == need
        lengths.append([str(need), str(here.sum()), *map(percent, solved[:, here].mean(axis=1))])
    listed = []
    for at in missed[:_LISTED]:
        listed.append([_start_words(data.spec, starts[at]), decimals(optimal[at]), *map(percent, solved[:, at])])
    header = ["agent, %", *_SHARES.values(), f"macro-actions (optimal: {optimal.mean():.2f})"]
    caption = f"After {data.budgets[-1]:,} real episodes, from all {len(starts)} starts. Means over seeds [95 %]."
    missing = f"Solved, %. {len(missed)} starts are not always solved by every run."
    words = "Each policy is followed by the rules: no episode is sampled, and no frame misread that can be read right."
    tables = [
        Table("policies", header, rows, caption),
        Table("policies_by_length", ["optimal macro-actions", "starts", *titles], lengths, "Solved, %."),
        Table("policies_missed", ["start", "optimal macro-actions", *titles], listed, missing),
    ]
    shown = [table for table in tables if table.rows]
    return Section("Where the greedy policies lead", [words], tables=shown)


def _start_words(spec: TaskSpec, state: State) -> str:
    named = zip(spec.macrostate_names, spec.value_names(state), strict=True)
    return ", ".join(f"{name} {value}" for name, value in named)


# Causes ------------------------------------------------------------------------------------------------------------


def causes(data: ReportData) -> Section | None:
    """Causes by agent and budget, where 'imagine-bench verify --causes' left them in the bench's folder."""
    found = read_failures(data.result.folder)
    if not found:
        return None
    caption = "Test episodes of all seeds that failed, by cause. What is above a bar was solved."
    words = (
        "What an optimal policy fails with the same draws of chance, too, was bad luck. Else truth is swapped in, one "
        "stage at a time, until the episode is solved: frames read right; then a perfect plan in the agent's own "
        "model; then the truth about transitions that it never experienced; then all of the truth; then physics as the "
        "rules say. The first stage that solves it names the cause."
    )
    images = [figures.plot("causes", lambda: figures.causes_figure(found), caption)]
    return Section("Why agents failed", [words], images, [causes_table(found)])


def read_failures(bench: Path) -> figures.Failures:
    """What was found of a bench, if anything. Raises ArtefactError: the file is damaged."""
    path = bench / "why" / "causes.csv"
    if not path.is_file():
        return {}
    with reading(path, "a table of causes"):
        head, *rows = csv.reader(path.read_text().splitlines())
        if tuple(head) != HEAD:
            raise ValueError(f"its columns are {head}")
        return failures(rows)


def failures(rows: Iterable[Sequence[object]]) -> figures.Failures:
    """Tests, and failures by cause, of all seeds together, from rows below :data:`HEAD`; no cause is no failure."""
    found: figures.Failures = {}
    counted = set()
    for agent, seed, episodes, tested, _, cause in rows:
        by_budget = found.setdefault(str(agent), {})
        budget = int(str(episodes))
        tests, counts = by_budget.get(budget, (0, Counter()))
        if (agent, seed, budget) not in counted:
            counted.add((agent, seed, budget))
            tests += int(str(tested))
        if cause and cause not in CAUSES:
            raise ValueError(f"{cause!r} is no cause")
        if cause:
            counts[str(cause)] += 1
        by_budget[budget] = (tests, counts)
    return found


def causes_table(found: Mapping[str, Mapping[int, tuple[int, Counter[str]]]]) -> Table:
    """Shares of the failures by agent and budget."""
    rows = []
    for agent, by_budget in found.items():
        for budget, (tests, counts) in by_budget.items():
            total = counts.total()
            shares = [percent(counts[name] / total) if total else DASH for name in CAUSES]
            rows.append([agent_title(agent), f"{budget:,}", f"{total:,} of {tests:,}", *shares])
    header = ["agent", "real episodes", "failures", *(f"{name}, %" for name in CAUSES)]
    meanings = "; ".join(f"{name}: {words}" for name, words in CAUSES.items())
    return Table("causes", header, rows, f"Shares of the failures. {meanings}.", why_dash="nothing failed")
