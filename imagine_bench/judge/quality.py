"""What can be asked of trained agents beyond the bench's test.

Plans carried out blindly, transitions nobody ever saw, and where the policy leads from every start.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.bench.progress import counted
from imagine_bench.capabilities import Imaginer
from imagine_bench.errors import ArtefactError, InvalidValueError, require_known
from imagine_bench.interfaces import EXECUTIONS
from imagine_bench.judge.generalisation import Probing, answer, probing, summarise
from imagine_bench.judge.plans import make_plans, require_threshold
from imagine_bench.judge.policy import choices, follow, situations
from imagine_bench.machine import describe_environment
from imagine_bench.report.generalisation import Asked, generalisation_table, write_generalisation
from imagine_bench.report.plans import RECORDING, plan_table, write_plans
from imagine_bench.report.policy import Followed, policy_table, write_policy
from imagine_bench.seeding import SeedTree, evaluation_split
from imagine_bench.store.bench_folder import load_bench, newest_bench, read_protocol, require_either
from imagine_bench.store.files import lock, make_folder
from imagine_bench.store.trained import Trained, best_run, learners, load_trained, require_control, require_runs
from imagine_bench.task_types import task_type

_STRIPS = 6
"""Plans in the picture, of as many lengths as there are."""


def plan_report(
    run: Path | None,
    *,
    root: Path,
    task: str | None,
    count: int,
    recorded: int,
    execution: str,
    max_epistemic: float | None,
    encoder: str | None,
) -> str:
    """Plan, carry out, and leave a table, pictures and a recording in the run's folder, below ``plans``.

    Args:
        run: A run's folder; None for the best imagining run of the newest bench.
        root: Folder of all benches.
        task: Whose newest bench; None for that of any task.
        count: Plans.
        recorded: Plans that are recorded.
        execution: ``"physics"`` or ``"kinematic"``.
        max_epistemic: See :func:`imagine_bench.judge.plans.make_plans`.
        encoder: See :func:`imagine_bench.store.trained.load_trained`.

    Returns:
        What to print.

    Raises:
        ImagineBenchError: Nothing to plan with, or a value out of range; nothing was written.
        BusyError: Another process makes the same plans.
    """
    require_known("execution", execution, EXECUTIONS)
    if recorded < 0 or count < 1:
        raise InvalidValueError(f"Asked for {count} plans, {recorded} of them recorded; give at least 1 and 0.")
    require_threshold(max_epistemic)
    run = _chosen(run, root, task)
    if (run / "protocol.json").exists():  # a bench's folder
        require_control(read_protocol(run).task, str(run))
        require_runs(run)
        run = best_run(load_bench(run)).folder
    trained = load_trained(run, encoder=encoder)
    name = f"{execution}-{count}{'' if max_epistemic is None else f'-below-{max_epistemic:g}'}"
    folder = make_folder(run / "plans" / name)
    with lock(folder / ".lock", f"The folder {folder}"):
        return _plan(trained, folder, count, recorded, execution, max_epistemic)


def _plan(
    trained: Trained, folder: Path, count: int, recorded: int, execution: str, max_epistemic: float | None
) -> str:
    plans = list(
        counted(
            make_plans(trained, count=count, execution=execution, max_epistemic=max_epistemic), "plans", total=count
        )
    )
    facts = {**_facts(trained), "execution": execution, "max_epistemic": max_epistemic}
    summary = write_plans(folder, plans, trained.task, facts, strips=_STRIPS)
    said = [f"{_title(trained)}, {execution}", "", plan_table(summary, trained.task), ""]
    said += [f"plan {plan.number} from {plan.start}: {plan.outcome}" for plan in plans if not plan.solved]
    said += [f"Pictures:   {folder / 'plans.png'}"]
    if recorded:
        from imagine_bench.recording.plans import record_plans  # noqa: PLC0415 - loading Rerun costs a second

        path = folder / RECORDING
        record_plans(trained, count=min(recorded, count), execution=execution, max_epistemic=max_epistemic, path=path)
        said.append(f"Recording:  {path} (imagine-bench view opens it)")
    return "\n".join(said)


def generalisation_report(folder: Path | None, *, root: Path, task: str | None, encoder: str | None) -> str:
    """Ask every imagining run of a bench for every transition, and leave the answers in its folder.

    An unfinished bench will do: every run is asked as its last checkpoint left it.

    Args:
        folder: A bench's folder; None for the newest.
        root: Folder of all benches.
        task: Whose newest bench; None for that of any task.
        encoder: See :func:`imagine_bench.store.trained.load_trained`.

    Returns:
        What to print.

    Raises:
        ImagineBenchError: No bench, or none with an agent that imagines.
        BusyError: Another process asks the same.
        SetupError: The bench's folder cannot be written.
    """
    bench = _bench_of_agents(folder, root, task)
    with lock(bench / ".generalisation.lock", f"The folder {bench / 'generalisation'}"):
        return _generalise(bench, encoder)


def _generalise(bench: Path, encoder: str | None) -> str:
    protocol = read_protocol(bench)
    spec, runs = registry.task(protocol.task), learners(bench)
    probe = probing(spec, appearance=protocol.appearance, purpose=evaluation_split(protocol.seeds[0]))
    asked = []
    for run in counted(runs, "runs", total=len(runs)):
        trained = load_trained(run, encoder=encoder)
        if isinstance(trained.agent, Imaginer):
            asked.append(_asked(trained, probe))
    if not asked:
        raise ArtefactError(f"No agent of {bench} imagines; give a bench with one that does.")
    where = bench / "generalisation"
    facts = {**_origin(protocol.hash), "appearance": protocol.appearance, "frames": "kinematic"}
    write_generalisation(where, asked, probe, spec, facts)
    head = f"{spec.title}, {protocol.appearance}"
    return "\n".join([head, "", generalisation_table(asked, probe, spec), "", f"Answers:    {where}"])


def _asked(trained: Trained, probe: Probing) -> Asked:
    who = trained.spec
    answers = answer(trained.imaginer, probe, SeedTree(who.seed).child("generalisation"))
    summary = summarise(probe, answers)
    return Asked(agent=who.agent, seed=who.seed, episodes=trained.episodes, answers=answers, summary=summary)


def policy_report(folder: Path | None, *, root: Path, task: str | None, encoder: str | None) -> str:
    """Follow the policy of every learner of a bench by the rules, and leave where it leads in the bench's folder.

    An unfinished bench will do: every run is asked as its last checkpoint left it.

    Args:
        folder: A bench's folder; None for the newest.
        root: Folder of all benches.
        task: Whose newest bench; None for that of any task.
        encoder: See :func:`imagine_bench.store.trained.load_trained`.

    Returns:
        What to print.

    Raises:
        ImagineBenchError: No bench, or none with a learner that can be taken up again.
        BusyError: Another process asks the same.
        SetupError: The bench's folder cannot be written.
    """
    bench = _bench_of_agents(folder, root, task)
    with lock(bench / ".policy.lock", f"The folder {bench / 'policy'}"):
        return _follow_policies(bench, encoder)


def _follow_policies(bench: Path, encoder: str | None) -> str:
    protocol = read_protocol(bench)
    spec, runs = registry.task(protocol.task), learners(bench)
    met = situations(spec, appearance=protocol.appearance, purpose=evaluation_split(protocol.seeds[0]))
    followed = []
    for run in counted(runs, "runs", total=len(runs)):
        trained = load_trained(run, encoder=encoder)
        ends = follow(spec, met, choices(trained.agent, met, spec.n_actions))
        who = trained.spec
        followed.append(Followed(agent=who.agent, seed=who.seed, episodes=trained.episodes, ends=ends))
    where = bench / "policy"
    facts = {**_origin(protocol.hash), "appearance": protocol.appearance, "frames": "kinematic"}
    write_policy(where, followed, spec, facts)
    head = f"{spec.title}, {protocol.appearance}"
    return "\n".join([head, "", policy_table(followed, spec), "", f"All starts: {where / 'starts.csv'}"])


def _bench_of_agents(folder: Path | None, root: Path, task: str | None) -> Path:
    """The bench that a question is put to: one whose agents can act, and are there."""
    bench = _chosen(folder, root, task)
    require_control(read_protocol(bench).task, str(bench))
    require_runs(bench)
    return bench


def _chosen(given: Path | None, root: Path, task: str | None) -> Path:
    """What was given, or else the newest bench of a task in which agents act, or of all such tasks."""
    require_either(given, task)
    if task is not None:
        task_type(task)  # knows every name
        require_control(task, f"Task {task!r}")
    return given or newest_bench(root, tuple(registry.TASKS) if task is None else (task,))


def _title(trained: Trained) -> str:
    spec = trained.spec
    return (
        f"{trained.task.title}: {spec.agent}, seed {spec.seed}, after {trained.episodes:,} real episodes, "
        f"{spec.protocol.appearance}"
    )


def _facts(trained: Trained) -> dict[str, Any]:
    spec = trained.spec
    names = {"agent": spec.agent, "seed": spec.seed, "episodes": trained.episodes}
    return {**_origin(spec.protocol.hash), **names, "appearance": spec.protocol.appearance}


def _origin(protocol_hash: str) -> dict[str, Any]:
    environment = describe_environment()
    return {"protocol_hash": protocol_hash, **{name: environment.get(name) for name in ("commit", "command")}}
