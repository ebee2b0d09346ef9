"""The section on why agents failed, from what 'imagine-bench verify --causes' left in the bench's folder."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from imagine_bench.judge.causes import CAUSES
from imagine_bench.report import figures
from imagine_bench.report.tables import DASH, Section, Table
from imagine_bench.report.text import agent_words, percent
from imagine_bench.store.files import reading

HEAD = ("agent", "seed", "episodes", "tests", "test", "cause")
_FILE = Path("why") / "causes.csv"


def read_failures(bench: Path) -> figures.Failures:
    """What was found of a bench, if anything. Raises ArtefactError: the file is damaged."""
    path = bench / _FILE
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
    tested: dict[tuple[str, int], dict[str, int]] = {}
    for agent, seed, episodes, tests, _, cause in rows:
        key = (str(agent), int(str(episodes)))
        tested.setdefault(key, {})[str(seed)] = int(str(tests))
        counts = found.setdefault(key[0], {}).setdefault(key[1], (0, Counter()))[1]
        if cause:
            if cause not in CAUSES:
                raise ValueError(f"{cause!r} is no cause")
            counts[str(cause)] += 1
    return {
        agent: {budget: (sum(tested[agent, budget].values()), counts) for budget, (_, counts) in by_budget.items()}
        for agent, by_budget in found.items()
    }


def causes(found: figures.Failures) -> Section:
    """Causes by agent and budget."""
    figure = figures.image(
        "causes", lambda: figures.causes_figure(found), svg=True, dpi=180,
        alt="Failed test episodes by cause, against real training episodes, a panel an agent.",
        caption="Test episodes of all seeds that failed, by cause. What is above a bar was solved.",
    )  # fmt: skip
    return Section(
        title="Why agents failed",
        words=(
            "What an optimal policy fails with the same draws of chance, too, was bad luck. Else truth is swapped in, "
            "one stage at a time, until the episode is solved: frames read right; then a perfect plan in the agent's "
            "own model; then the truth about transitions that it never experienced; then all of the truth; then "
            "physics as the rules say. The first stage that solves it names the cause.",
        ),
        images=(figure,),
        tables=(causes_table(found),),
    )


def causes_table(found: figures.Failures) -> Table:
    """Shares of the failures by agent and budget."""
    rows = [
        [
            agent_words(agent).title, f"{budget:,}", f"{counts.total():,} of {tests:,}",
            *(percent(counts[name] / counts.total()) if counts else DASH for name in CAUSES),
        ]
        for agent, by_budget in found.items()
        for budget, (tests, counts) in by_budget.items()
    ]  # fmt: skip
    words = "; ".join(f"{name}: {words}" for name, words in CAUSES.items())
    return Table(
        name="causes", header=["agent", "real episodes", "failures", *(f"{name}, %" for name in CAUSES)], rows=rows,
        caption=f"Shares of the failures. {words}.", why_dash="nothing failed",
    )  # fmt: skip
