"""What became of an agent's plans: a table for the terminal and for a page, one row a plan, and the pictures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench import reference, statistics
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.filmstrips import png, rollout_strip
from imagine_bench.judge.plans import Plan
from imagine_bench.report.text import percent
from imagine_bench.store.files import csv_text, make_folder, with_null, write_bytes, write_json, writing

_COLUMNS = (
    *("plan", "start", "shortest", "planned", "done", "solved", "optimal", "refused", "as_imagined", "faults"),
    *("max_epistemic", "actions"),
)
RECORDING = "recording.rrd"
_SHOWN_FAILURES = 12


@dataclass(frozen=True, kw_only=True)
class PlanSummary:
    """Counts over plans.

    Attributes:
        attempted: Plans asked for.
        refused: Those not carried out for doubt.
        solved: Those that solved the task.
        optimal: Those of them that took the fewest macro-actions possible.
        shortest: Macro-actions of the shortest solved plan; 0 where none was solved.
        longest: Macro-actions of the longest solved plan.
        mean_length: Mean macro-actions of the solved plans; NaN where none was.
        steps: Macro-actions carried out.
        steps_as_imagined: Those that led where they were imagined to.
        faults: Those whose physics disagreed with the rules.
    """

    attempted: int
    refused: int
    solved: int
    optimal: int
    shortest: int
    longest: int
    mean_length: float
    steps: int
    steps_as_imagined: int
    faults: int


def summarise(plans: Sequence[Plan]) -> PlanSummary:
    """Count."""
    lengths = [plan.done for plan in plans if plan.solved]
    return PlanSummary(
        attempted=len(plans),
        refused=sum(bool(plan.refused) for plan in plans),
        solved=len(lengths),
        optimal=sum(plan.optimal for plan in plans),
        shortest=min(lengths, default=0),
        longest=max(lengths, default=0),
        mean_length=float(np.mean(lengths)) if lengths else math.nan,
        steps=sum(plan.done for plan in plans),
        steps_as_imagined=sum(int(plan.as_imagined.sum()) for plan in plans),
        faults=sum(plan.faults for plan in plans),
    )


def plan_table(summary: PlanSummary, task: TaskSpec) -> str:
    """The counts as Markdown, the thesis' beside them where it has any."""
    thesis = {} if task.reference is None else reference.load(task.reference).get("plans", {})
    low, high = statistics.wilson(summary.solved, summary.attempted)
    rows = [
        ("plans", f"{summary.attempted}", thesis.get("attempted")),
        (
            "solved",
            f"{summary.solved} = {percent(summary.solved / summary.attempted)} % [{percent(low)}, {percent(high)}]",
            thesis.get("solved"),
        ),
        ("of these optimal", f"{summary.optimal}", thesis.get("optimal_among_solved")),
        ("refused for doubt", f"{summary.refused}", None),
        ("macro-actions of a solved plan", _lengths(summary), _thesis_lengths(thesis)),
        ("macro-actions that led where imagined", f"{summary.steps_as_imagined} of {summary.steps}", None),
        ("faults of the physics", f"{summary.faults}", None),
    ]
    lines = ["| open-loop plans, carried out blindly | here | thesis |", "|---|---|---|"]
    lines += [f"| {name} | {here} | {'–' if there is None else there} |" for name, here, there in rows]
    return "\n".join(lines)


def write_plans(
    folder: Path, plans: Sequence[Plan], task: TaskSpec, facts: dict[str, Any], *, strips: int
) -> PlanSummary:
    """Write ``plans.csv``, ``summary.json``, ``plans.md``, ``plans.png`` and strips of the first plans that failed.

    What an earlier call left there, its recording included, goes.

    Args:
        folder: Where to; it is made.
        plans: What became of them.
        task: Their task.
        facts: How they were made, for ``summary.json``.
        strips: Plans in ``plans.png``, of as many lengths as there are.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    with writing(folder):
        for earlier in (*folder.glob("failed_*.png"), folder / RECORDING):
            earlier.unlink(missing_ok=True)
    summary = summarise(plans)
    write_bytes(folder / "plans.csv", _csv(plans).encode())
    write_json(folder / "summary.json", {**facts, **with_null(dataclasses.asdict(summary))})
    failures = [plan for plan in plans if not plan.solved]
    write_bytes(folder / "plans.md", (_page(summary, failures, task)).encode())
    write_bytes(folder / "plans.png", png(_stack(_varied(plans, strips), task)))
    for plan in failures[:_SHOWN_FAILURES]:
        write_bytes(folder / f"failed_{plan.number:03d}.png", png(_stack([plan], task)))
    return summary


def _lengths(summary: PlanSummary) -> str:
    return f"{summary.shortest} to {summary.longest}, mean {summary.mean_length:.2f}" if summary.solved else "–"


def _thesis_lengths(thesis: dict[str, Any]) -> str | None:
    return f"{thesis['shortest']} to {thesis['longest']}" if thesis else None


def _page(summary: PlanSummary, failures: Sequence[Plan], task: TaskSpec) -> str:
    lines = [f"# {task.title}: plans imagined from one frame", "", plan_table(summary, task), ""]
    lines += ["![Plans: what the camera saw above, what was imagined below](plans.png)", ""]
    lines += [f"- plan {plan.number} from {plan.start}: {plan.outcome}" for plan in failures]
    return "\n".join(lines) + "\n"


def _csv(plans: Sequence[Plan]) -> str:
    rows = [
        [
            plan.number, " ".join(map(str, plan.start)), plan.shortest, plan.length, plan.done, int(plan.solved),
            int(plan.optimal), plan.refused, int(plan.as_imagined.sum()), plan.faults,
            f"{float(plan.compared.rollout.epistemic.max()):.6g}",
            " ".join(str(int(action)) for action in plan.compared.rollout.actions),
        ]
        for plan in plans
    ]  # fmt: skip
    return csv_text([_COLUMNS, *rows])


def _varied(plans: Sequence[Plan], count: int) -> list[Plan]:
    """The first plan of each length, shortest first, then others in order, up to ``count``."""
    first: dict[int, Plan] = {}
    for plan in plans:
        first.setdefault(plan.length, plan)
    chosen = list(first.values())[:count]
    chosen += [plan for plan in plans if plan not in chosen][: count - len(chosen)]
    return sorted(chosen, key=lambda plan: (plan.length, plan.number))


def _stack(plans: Sequence[Plan], task: TaskSpec) -> NDArray[np.uint8]:
    """The strips of plans below one another. Shape (height, width, 3)."""
    columns = max(plan.length for plan in plans)
    return np.concatenate([rollout_strip(plan.compared, task.action_names, columns=columns) for plan in plans])
