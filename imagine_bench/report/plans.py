"""Plans imagined from one frame and carried out without a second look: a table, one row a plan, and filmstrips."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imagine_bench import reference, statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.plans import PlanResult, make_plans, require_threshold
from imagine_bench.recording.filmstrips import filmstrip, png
from imagine_bench.report.page import chosen, provenance
from imagine_bench.report.tables import DASH, Table, percent
from imagine_bench.running.progress import counted
from imagine_bench.running.task_types import load_bench
from imagine_bench.running.trained import best_run, load_trained, protocol_of_agents
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
    """PlanResult, carry out, and leave a table, filmstrips and a recording in the run's folder, below ``plans``.

    ``run`` is a run's folder, or a bench's, whose best imagining run is taken; None is the newest bench of ``task``,
    or of any. ``max_epistemic`` is as in :func:`imagine_bench.judge.plans.make_plans`, ``encoder`` as in
    :func:`imagine_bench.running.trained.load_trained`. The first ``recorded`` plans go to ``record``.
    Returns the text to print.

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
    spec = trained.spec
    with lock(folder / ".lock", f"The folder {folder}"):
        made = make_plans(trained, count=count, execution=execution, max_epistemic=max_epistemic)
        plans = list(counted(made, "plans", total=count))
        origin: dict[str, object] = {
            **provenance(spec.protocol.hash), "agent": spec.agent, "seed": spec.seed, "episodes": trained.episodes,
            "appearance": spec.protocol.appearance, "execution": execution, "max_epistemic": max_epistemic,
        }  # fmt: skip
        summary = write_plans(folder, plans, trained.task, origin, filmstrips=_FILMSTRIPS)
        lines = [
            f"{trained.task.title}: {spec.agent}, seed {spec.seed}, after {trained.episodes:,} real episodes, "
            f"{spec.protocol.appearance}, {execution}\n",
            f"{plan_table(summary, trained.task).markdown}\n",
            *_failed(plans),
            f"Filmstrips: {folder / 'plans.png'}",
        ]
        if record is not None and recorded:
            shown = {"count": min(recorded, count), "execution": execution, "max_epistemic": max_epistemic}
            path = record(trained, **shown, path=folder / RECORDING)
            lines.append(f"Recording:  {path} (imagine-bench view opens it)")
    return "\n".join(lines)


@dataclasses.dataclass(frozen=True, kw_only=True)
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


def summarise(plans: Sequence[PlanResult]) -> PlanSummary:
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


def plan_table(found: PlanSummary, task: TaskSpec) -> Table:
    """The counts, the thesis' beside them where it has any."""
    thesis = {} if task.reference is None else reference.load(task.reference).get("plans", {})
    low, high = statistics.wilson(found.solved, found.attempted)
    share = f"{percent(found.solved / found.attempted)} % [{percent(low)}, {percent(high)}]"
    lengths = f"{found.shortest} to {found.longest}, mean {found.mean_length:.2f}" if found.solved else DASH
    rows = [
        ["plans", f"{found.attempted}", f"{thesis.get('attempted', DASH)}"],
        ["solved", f"{found.solved} = {share}", f"{thesis.get('solved', DASH)}"],
        ["of these optimal", f"{found.optimal}", f"{thesis.get('optimal_among_solved', DASH)}"],
        ["refused as too uncertain", f"{found.refused}", DASH],
        ["macro-actions of a solved plan", lengths, f"{thesis['shortest']} to {thesis['longest']}" if thesis else DASH],
        ["macro-actions that led where imagined", f"{found.steps_as_imagined} of {found.steps}", DASH],
        ["faults of the physics", f"{found.faults}", DASH],
    ]
    return Table("plans", ["open-loop plans, carried out blindly", "here", "thesis"], rows)


def write_plans(
    folder: Path, plans: Sequence[PlanResult], task: TaskSpec, origin: Mapping[str, object], *, filmstrips: int
) -> PlanSummary:
    """Write ``plans.csv``, ``summary.json``, ``plans.md``, ``plans.png`` and filmstrips of the first plans that failed.

    The files of an earlier call, its recording included, go. ``plans.png`` shows as many ``filmstrips``, of plans of
    different lengths; ``summary.json`` holds the ``origin`` too.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    with writing(folder):
        for earlier in (*folder.glob("failed_*.png"), folder / RECORDING):
            earlier.unlink(missing_ok=True)
    summary = summarise(plans)
    write_bytes(folder / "plans.csv", csv_text([_COLUMNS, *map(_row, plans)]).encode())
    write_json(folder / "summary.json", {**origin, **with_null(dataclasses.asdict(summary))})
    picture = "![Plans: real images above, imagined ones below](plans.png)"
    failed = "\n".join(f"- {line}" for line in _failed(plans))
    heading = f"# {task.title}: plans imagined from one frame"
    text = f"{heading}\n\n{plan_table(summary, task).markdown}\n\n{picture}\n\n{failed}\n"
    write_bytes(folder / "plans.md", text.encode())
    write_bytes(folder / "plans.png", png(_stack(_varied(plans, filmstrips), task)))
    for plan in [plan for plan in plans if not plan.solved][:_SHOWN_FAILURES]:
        write_bytes(folder / f"failed_{plan.number:03d}.png", png(_stack([plan], task)))
    return summary


def _failed(plans: Sequence[PlanResult]) -> list[str]:
    return [f"plan {plan.number} from {plan.start}: {plan.outcome}" for plan in plans if not plan.solved]


def _row(plan: PlanResult) -> list[object]:
    """A row of plans.csv."""
    rollout = plan.compared.rollout
    start, actions = (" ".join(map(str, each)) for each in (plan.start, rollout.actions.tolist()))
    counts = [plan.shortest, plan.length, plan.done, int(plan.solved), int(plan.optimal), plan.refused]
    as_imagined = int(plan.as_imagined.sum())
    return [plan.number, start, *counts, as_imagined, plan.faults, f"{float(rollout.epistemic.max()):.6g}", actions]


def _varied(plans: Sequence[PlanResult], count: int) -> list[PlanResult]:
    """The first plan of each length, shortest first, then others in order, up to ``count``."""
    first = {plan.length: plan for plan in reversed(plans)}
    ranked = sorted(plans, key=lambda plan: first[plan.length] is not plan)
    return sorted(ranked[:count], key=lambda plan: (plan.length, plan.number))


def _stack(plans: Sequence[PlanResult], task: TaskSpec) -> NDArray[np.uint8]:
    """The filmstrips of plans below one another. Shape (height, width, 3)."""
    columns = max(plan.length for plan in plans)
    return np.concatenate([filmstrip(plan.compared, task.action_names, columns=columns) for plan in plans])
