"""Questions to a bench's trained agents, each with its table and files: plans, causes of failures, verification."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import reference, registry, statistics
from imagine_bench.appearance import appearance_typed
from imagine_bench.arrays import Pixels
from imagine_bench.errors import (
    ArtefactError,
    CheckFailedError,
    IncompleteCheckError,
    InvalidValueError,
    brief,
    writing,
)
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.causes import Tested, causes_of, causes_of_player
from imagine_bench.judge.plans import PlanResult, make_plans, require_threshold
from imagine_bench.judge.verify import UNSHOWN, verify_runs
from imagine_bench.recording.filmstrips import filmstrip, png
from imagine_bench.registry.machine import describe_environment
from imagine_bench.report.bench import bench_page
from imagine_bench.report.data import known_agent
from imagine_bench.report.page import DASH, Table, percent, texts, write_page
from imagine_bench.report.sections import HEAD, causes_table
from imagine_bench.running.bench import counted, load_bench, task_type
from imagine_bench.running.retraining import Retraining, Verdict, chance_to_find, judged, train_again
from imagine_bench.running.trained import (
    best_run,
    learners,
    load_trained,
    protocol_of_agents,
    require_control,
)
from imagine_bench.store.bench_folder import (
    BenchStore,
    bench_facts,
    is_archive,
    newest_bench,
    read_control,
    require_either,
)
from imagine_bench.store.files import (
    csv_text,
    lock,
    make_folder,
    table_text,
    write_bytes,
    write_json,
)
from imagine_bench.store.loading import load_so_far
from imagine_bench.values import Json

RECORDING = "recording.rrd"
_SHOWN = 6  # the first plans, and the first that failed, as filmstrips
_COUNTS: Mapping[str, tuple[str, Callable[[PlanResult], int]]] = {
    "attempted": ("plans", lambda plan: 1),
    "solved": ("solved", lambda plan: plan.solved),
    "optimal": ("of these optimal", lambda plan: plan.optimal),
    "refused": ("refused as too uncertain", lambda plan: bool(plan.refused)),
    "steps": ("macro-actions carried out", lambda plan: plan.done),
    "steps_as_imagined": ("that led where imagined", lambda plan: int(plan.as_imagined.sum())),
    "faults": ("faults of the physics", lambda plan: plan.faults),
}
"""The counts over plans by name: their words in the table, and how many each plan adds."""
_IMAGE = re.compile("base64,[A-Za-z0-9+/=]*")


def chosen(given: Path | None, root: Path, task: str | None) -> Path:
    """The given folder, or else the newest bench of a task in which agents act, or of all such tasks.

    Raises:
        ImagineBenchError: Both are given, or there is no such bench.
    """
    require_either(given, task)
    if task is not None:
        task_type(task)  # knows every name
        require_control(task, task)
    return given or newest_bench(root, *(registry.tasks() if task is None else (task,)))


def provenance(protocol_hash: str) -> dict[str, Json]:
    """Protocol, commit and command of a figure."""
    environment = describe_environment()
    return {"protocol_hash": protocol_hash, "commit": environment.get("commit"), "command": environment.get("command")}


# Plans -------------------------------------------------------------------------------------------------------------


def plan_report(
    run: Path | None, *, root: Path, task: str | None, count: int, execution: str | None, max_epistemic: float | None,
    encoder: str | None, recorded: int = 0,
) -> str:  # fmt: skip
    """Plan, carry out, and leave a table, filmstrips and a recording in the run's folder, below ``plans``.

    ``run`` is a run's folder, or a bench's, whose best imagining run is taken; None is the newest bench of ``task``,
    or of any. ``max_epistemic`` is as in :func:`imagine_bench.judge.plans.make_plans`, ``encoder`` as in
    :func:`imagine_bench.running.trained.load_trained`. The first ``recorded`` plans are recorded.
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
    whose: dict[str, Json] = {"agent": spec.agent, "seed": spec.seed, "episodes": trained.episodes}
    how: dict[str, Json] = {
        "appearance": spec.protocol.appearance_in_tests,
        "execution": execution,
        "max_epistemic": max_epistemic,
    }
    with lock(folder / ".lock", f"The folder {folder}"):
        made = make_plans(trained, count=count, execution=execution, max_epistemic=max_epistemic)
        plans = list(counted(made, "plans", total=count))
        text = write_plans(folder, plans, trained.task, {**provenance(spec.protocol.hash), **whose, **how})
        if recorded:
            from imagine_bench.recording.plans import record_plans  # noqa: PLC0415 - Rerun loads slowly

            path = folder / RECORDING
            record_plans(
                trained, count=min(recorded, count), execution=execution, max_epistemic=max_epistemic, path=path
            )
            text += f"\nRecording:  {path} (imagine-bench view opens it)"
    return text


def summarise(plans: Sequence[PlanResult]) -> dict[str, int]:
    """The counts over plans, by their names in ``summary.json``."""
    return {name: sum(map(of, plans)) for name, (_, of) in _COUNTS.items()}


def plan_table(plans: Sequence[PlanResult], task: TaskSpec) -> Table:
    """The counts, the thesis' beside them where it has any."""
    found = summarise(plans)
    thesis = {} if task.reference is None else reference.load(task.reference).get("plans", {})
    low, high = statistics.wilson(found["solved"], len(plans))
    share = f" = {percent(found['solved'] / len(plans))} % [{percent(low)}, {percent(high)}]"
    rows = []
    for name, (words, _) in _COUNTS.items():
        printed = thesis.get("optimal_among_solved" if name == "optimal" else name, DASH)
        rows.append([words, f"{found[name]}{share if name == 'solved' else ''}", str(printed)])
    return Table("plans", ["open-loop plans, carried out blindly", "here", "thesis"], rows)


def write_plans(folder: Path, plans: Sequence[PlanResult], task: TaskSpec, origin: Mapping[str, Json]) -> str:
    """Write ``plans.csv``, ``summary.json``, ``plans.png``, the first plans, and ``failed.png``, the first failed.

    The files of an earlier call, its recording included, go. ``summary.json`` holds the ``origin`` too.
    Returns the text to print.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    with writing(folder):
        for earlier in ("failed.png", RECORDING):
            (folder / earlier).unlink(missing_ok=True)
    failures = [plan for plan in plans if not plan.solved]
    write_bytes(folder / "plans.csv", table_text([_row(plan) for plan in plans]).encode())
    write_json(folder / "summary.json", {**origin, **summarise(plans)})
    for name, shown in (("plans.png", plans), ("failed.png", failures)):
        if shown:
            write_bytes(folder / name, png(_stack(shown[:_SHOWN], task)))
    facts = ", ".join(f"{name} {value}" for name, value in origin.items())
    words = "\n".join(f"- plan {plan.number} from {plan.start}: {plan.outcome}" for plan in failures)
    table = plan_table(plans, task)
    return f"{task.title}: {facts}\n\n{table.text}\n\n{words}\nFilmstrips: {folder / 'plans.png'}"


def _row(plan: PlanResult) -> dict[str, float | str]:
    """A row of plans.csv."""
    rollout = plan.compared.rollout
    return {
        "plan": plan.number,
        "start": " ".join(map(str, plan.start)),
        "shortest": "" if plan.shortest is None else plan.shortest,
        "planned": plan.length,
        "done": plan.done,
        "solved": int(plan.solved),
        "optimal": int(plan.optimal),
        "refused": plan.refused,
        "as_imagined": int(plan.as_imagined.sum()),
        "faults": plan.faults,
        "max_epistemic": f"{float(rollout.epistemic.max()):.6g}",
        "actions": " ".join(map(str, rollout.actions.tolist())),
    }


def _stack(plans: Sequence[PlanResult], task: TaskSpec) -> Pixels:
    """The filmstrips of plans below one another. Shape (height, width, 3)."""
    columns = max(plan.length for plan in plans)
    return np.concatenate([filmstrip(plan.compared, task.action_names, columns=columns) for plan in plans])


# Causes of failures ------------------------------------------------------------------------------------------------


def why_report(folder: Path | None, *, root: Path, task: str | None, encoder: str | None) -> str:
    """Find the one cause of every failed test of a bench's learners, keep them, and write its report anew.

    The bench is as in :func:`chosen`, ``encoder`` as in :func:`imagine_bench.running.trained.load_trained`.
    Returns the text to print.

    Raises:
        ImagineBenchError: No bench, or none with an agent that can be taken up again.
        BusyError: Another process is at the same.
        SetupError: The bench's folder cannot be written.
    """
    bench = chosen(folder, root, task)
    where = bench / "why"
    protocol = protocol_of_agents(bench)
    store = BenchStore(bench, protocol)
    spec = registry.task(protocol.task)
    appearance = protocol.appearance_in_tests
    players = [store.run_folder(*pair) for pair in protocol.runs if registry.is_player(pair[0])]
    folders = () if players else learners(bench)
    with lock(bench / ".why.lock", f"The folder {where}"):
        rows: list[Sequence[object]] = []
        for run in counted(folders, "runs", total=len(folders)):
            trained = load_trained(run, encoder=encoder)
            rows += _cause_rows(trained.spec.agent, trained.spec.seed, causes_of(trained))
        for run, pair in zip(players, protocol.runs, strict=False):
            rows += _cause_rows(*pair, causes_of_player(run))
        table = causes_table(rows)
        made = {**provenance(protocol.hash), "appearance": appearance, "frames": "kinematic"}
        make_folder(where)
        write_bytes(where / "causes.csv", csv_text([HEAD, *rows]).encode())
        write_json(where / "summary.json", made)
    write_page(bench / "report", bench_page(load_so_far(bench)))
    title = f"{spec.title}, {appearance_typed(appearance)}"
    return f"{title}\n\n{table.text}\n\n{table.remark}\n\nAll rows:   {where / 'causes.csv'}"


def _cause_rows(agent: str, seed: int, tested: Sequence[Tested]) -> Iterator[Sequence[object]]:
    """A row a failure; and one a test without any, whose cause is empty."""
    for each in tested:
        for failure in each.causes.items() or [("", "")]:
            yield (agent, seed, each.episodes, each.tests, *failure)


# Verification ------------------------------------------------------------------------------------------------------


def verify(folder: Path, retraining: Retraining | None = None) -> list[Verdict]:
    """Play a bench's runs again: one verdict a run and, where all runs hold, one on the tables of its report.

    Where these hold, too, some runs are trained again if they shall be: one more verdict each.

    Raises:
        ArtefactError: It is no bench of agents with folders of their own, or its protocol is damaged.
        InvalidValueError: Fewer than one run of each agent is to be trained again.
    """
    if is_archive(folder):
        if retraining is not None:
            raise ArtefactError(f"{folder} keeps results and no runs; give a bench's folder, runs/<task>/<preset>-...")
        load_so_far(folder)
        return [Verdict(what=str(folder), holds="its table can be read", unshown=("its figures: no episode is kept",))]
    found = with_report(folder, verify_runs(folder))
    if retraining is None or any(each.complaint for each in found):
        return found
    return [*found, *train_again(folder, retraining)]


def conclusion(found: Sequence[Verdict]) -> CheckFailedError | IncompleteCheckError | None:
    """The error that names claims that do not hold, or that could not be compared; None where there are none."""
    complaints = [each for each in found if each.complaint]
    if complaints:
        return CheckFailedError(f"Does not hold. {len(complaints)} of {len(found)} verdicts are complaints.")
    unshown = dict.fromkeys(claim for each in found for claim in each.unshown)
    if unshown:
        return IncompleteCheckError(f"Holds as far as it was compared. Not compared: {'; '.join(unshown)}.")
    return None


def what_is_shown(folder: Path, found: Sequence[Verdict], retraining: Retraining | None = None) -> str:
    """The claims that no verdict shows, and the chance that training again finds a forged run, as text."""
    protocol = read_control(folder)
    environment = bench_facts(folder)["environment"]
    benches = [each for each in (environment, *environment.values()) if isinstance(each, Mapping) and "commit" in each]
    commits = ", ".join(sorted({str(each["commit"]) for each in benches}))
    lines = [*(f"Not shown: {each}." for each in UNSHOWN), f"Made at commit {commits}, as it says."]
    trained = sum(each.of_training for each in found)
    if trained and retraining is not None:
        lines[0] = f"{lines[0][:-1]}, but in the runs that were trained again."
        counts = {len(protocol.seeds_of(agent)) for agent in protocol.agents}
        drawn_of = {count: min(retraining.runs, count) for count in sorted(counts)}
        words = " or ".join(f"{drawn} of an agent's {count}" for count, drawn in drawn_of.items())
        lines.append(f"Trained again: {trained} runs, {words}, drawn by --nonce {retraining.nonce}.")
        for count, drawn in drawn_of.items():
            chances = ((forged, chance_to_find(count, forged, drawn)) for forged in _few(count))
            said = "; ".join(f"{forged} of {count} forged: {percent(chance)} %" for forged, chance in chances)
            lines.append(f"Chance that a draw finds a forged run of an agent: {said}.")
    elif retraining is not None:
        lines.append("Training again: no run was.")
    elif not is_archive(folder):
        lines.append("Training again, verify --train 1, shows whether a run of each agent repeats.")
    return "\n".join(lines)


def _few(count: int) -> list[int]:
    """Some numbers up to ``count``."""
    return sorted({1, 2, (count + 1) // 2, count} & {*range(1, count + 1)})


def with_report(folder: Path, runs: list[Verdict]) -> list[Verdict]:
    """The verdicts on the runs of a bench and, where all hold, one on its report."""
    if any(each.complaint for each in runs) or not (folder / "report").is_dir():
        return runs
    elsewhere = [agent for agent in read_control(folder).agents if not known_agent(agent).make]
    if elsewhere:  # a script's, or of a package that is not installed here
        unshown = f"its words, for no package here offers {', '.join(elsewhere)}"
        return [*runs, Verdict(what="report", holds="not compared", unshown=(unshown,))]
    return [*runs, judged("report", lambda: _verify_report(folder))]


def _verify_report(folder: Path) -> Verdict:
    """Compare the report with the runs, line by line; another version's reports have other words.

    Raises:
        ArtefactError: The bench was made by this version, and a line of its report does not follow from its runs.
    """
    made_by, here = (_version(facts) for facts in (bench_facts(folder)["environment"], describe_environment()))
    try:
        _require_lines(folder)
    except ArtefactError as error:
        if made_by == here:
            raise
        again = f"'imagine-bench report {shlex.quote(str(folder))}' writes it as this version does"
        unshown = f"its report, which another version may have written ({made_by}, as it says); {again}"
        return Verdict(what="report", holds=f"not compared: {error}", unshown=(unshown,))
    return Verdict(what="report")


def _version(environment: Mapping[str, Any]) -> str:
    """The commit and version that an environment's description names."""
    versions = environment.get("versions", {})
    return f"commit {environment.get('commit')}, version {versions.get('imagine-bench')}"


def _require_lines(folder: Path) -> None:
    """Raise ArtefactError for the first line of the report that does not follow from the runs."""
    for name, text in texts(bench_page(load_so_far(folder)), images=False).items():
        path = folder / "report" / name
        there = path.read_text() if path.is_file() else ""
        both = zip_longest(_IMAGE.sub("base64,", there).splitlines(), text.splitlines(), fillvalue="nothing")
        for has, wanted in both:
            if has != wanted:
                raise ArtefactError(f"{name} has {brief(has)} where the runs give {brief(wanted)}.")
