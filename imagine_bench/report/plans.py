"""Plans imagined from one frame and carried out without a second look: a table, one row a plan, and filmstrips."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench import reference, statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.filmstrips import filmstrip, png
from imagine_bench.judge.plans import Plan, make_plans, require_threshold
from imagine_bench.report.analysis import chosen, markdown, provenance
from imagine_bench.report.text import percent
from imagine_bench.running.progress import counted
from imagine_bench.running.task_types import load_bench
from imagine_bench.running.trained import Trained, best_run, load_trained, protocol_of_agents
from imagine_bench.store.files import csv_text, lock, make_folder, with_null, write_bytes, write_json, writing

_COLUMNS = (
    *("plan", "start", "shortest", "planned", "done", "solved", "optimal", "refused", "as_imagined", "faults"),
    *("max_epistemic", "actions"),
)
RECORDING = "recording.rrd"
_FILMSTRIPS = 6  # plans in plans.png, of as many lengths as there are
_SHOWN_FAILURES = 12

Record = Callable[..., Path]  # records plans: :func:`imagine_bench.recording.plans.record_plans`


def plan_report(
    run: Path | None, *, root: Path, task: str | None, count: int, execution: str | None, max_epistemic: float | None,
    encoder: str | None, recorded: int = 0, record: Record | None = None,
) -> str:  # fmt: skip
    """Plan, carry out, and leave a table, filmstrips and a recording in the run's folder, below ``plans``.

    ``run`` is a run's folder, or a bench's, whose best imagining run is taken; None is the newest bench of ``task``,
    or of any. ``max_epistemic`` is as in :func:`imagine_bench.judge.plans.make_plans`, ``encoder`` as in
    :func:`imagine_bench.running.trained.load_trained`. The first ``recorded`` plans go to ``record``.
    Returns what to print.

    Raises:
        ImagineBenchError: Nothing to plan with, or a value out of range; nothing was written.
        BusyError: Another process makes the same plans.
    """
    if recorded < 0 or count < 1:
        raise InvalidValueError(f"Asked for {count} plans, {recorded} of them recorded; give at least 1 and 0.")
    require_threshold(max_epistemic)
    run = chosen(run, root, task)
    if (run / "protocol.json").exists():  # a bench's folder
        protocol_of_agents(run)
        run = best_run(load_bench(run)).folder
    trained = load_trained(run, encoder=encoder)
    execution = trained.task.execution(execution)
    name = f"{execution}-{count}{'' if max_epistemic is None else f'-below-{max_epistemic:g}'}"
    folder = make_folder(run / "plans" / name)
    how: dict[str, Any] = {"execution": execution, "max_epistemic": max_epistemic}
    with lock(folder / ".lock", f"The folder {folder}"):
        plans = list(counted(make_plans(trained, count=count, **how), "plans", total=count))
        lines = _write(trained, plans, folder, how)
        if record is not None and recorded:
            path = record(trained, count=min(recorded, count), **how, path=folder / RECORDING)
            lines.append(f"Recording:  {path} (imagine-bench view opens it)")
    return "\n".join(lines)


def _write(trained: Trained, plans: Sequence[Plan], folder: Path, how: dict[str, Any]) -> list[str]:
    """Keep the plans of a trained agent, and say what became of them."""
    spec, task = trained.spec, trained.task
    run = {"agent": spec.agent, "seed": spec.seed, "episodes": trained.episodes}
    origin = {**provenance(spec.protocol.hash), **run, "appearance": spec.protocol.appearance, **how}
    summary = write_plans(folder, plans, task, origin, filmstrips=_FILMSTRIPS)
    return [
        f"{task.title}: {spec.agent}, seed {spec.seed}, after {trained.episodes:,} real episodes, "
        f"{spec.protocol.appearance}, {how['execution']}",
        "",
        plan_table(summary, task),
        "",
        *(f"plan {plan.number} from {plan.start}: {plan.outcome}" for plan in plans if not plan.solved),
        f"Filmstrips: {folder / 'plans.png'}",
    ]


@dataclass(frozen=True, kw_only=True)
class PlanSummary:
    """Counts over plans, and macro-actions of the solved ones (0 and NaN where none was).

    ``steps`` are macro-actions carried out, ``steps_as_imagined`` those that led where they were imagined to, and
    ``faults`` those whose physics disagreed with the rules.
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
    share = f"{summary.solved} = {percent(summary.solved / summary.attempted)} % [{percent(low)}, {percent(high)}]"
    lengths = f"{summary.shortest} to {summary.longest}, mean {summary.mean_length:.2f}" if summary.solved else "–"
    rows = [
        ("plans", f"{summary.attempted}", thesis.get("attempted")),
        ("solved", share, thesis.get("solved")),
        ("of these optimal", f"{summary.optimal}", thesis.get("optimal_among_solved")),
        ("refused as too uncertain", f"{summary.refused}", None),
        ("macro-actions of a solved plan", lengths, f"{thesis['shortest']} to {thesis['longest']}" if thesis else None),
        ("macro-actions that led where imagined", f"{summary.steps_as_imagined} of {summary.steps}", None),
        ("faults of the physics", f"{summary.faults}", None),
    ]
    shown = [(name, here, "–" if there is None else there) for name, here, there in rows]
    return "\n".join(markdown(["open-loop plans, carried out blindly", "here", "thesis"], shown))


def write_plans(
    folder: Path, plans: Sequence[Plan], task: TaskSpec, provenance: dict[str, Any], *, filmstrips: int
) -> PlanSummary:
    """Write ``plans.csv``, ``summary.json``, ``plans.md``, ``plans.png`` and filmstrips of the first plans that failed.

    What an earlier call left there, its recording included, goes. ``plans.png`` shows as many ``filmstrips``, of plans
    of different lengths; ``summary.json`` says the ``provenance`` too.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    with writing(folder):
        for earlier in (*folder.glob("failed_*.png"), folder / RECORDING):
            earlier.unlink(missing_ok=True)
    summary = summarise(plans)
    write_bytes(folder / "plans.csv", _csv(plans).encode())
    write_json(folder / "summary.json", {**provenance, **with_null(dataclasses.asdict(summary))})
    failures = [plan for plan in plans if not plan.solved]
    write_bytes(folder / "plans.md", _page(summary, failures, task).encode())
    write_bytes(folder / "plans.png", png(_stack(_varied(plans, filmstrips), task)))
    for plan in failures[:_SHOWN_FAILURES]:
        write_bytes(folder / f"failed_{plan.number:03d}.png", png(_stack([plan], task)))
    return summary


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
    """The filmstrips of plans below one another. Shape (height, width, 3)."""
    columns = max(plan.length for plan in plans)
    return np.concatenate([filmstrip(plan.compared, task.action_names, columns=columns) for plan in plans])
