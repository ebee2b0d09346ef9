"""One run: one agent, one seed, through all budgets of a protocol. The only loop that steps an environment to learn.

Whatever is needed to go on is in the newest checkpoint, so a run that was killed at any moment and started again ends
in the same bits as one that was not; only CPU times differ.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict

from imagine_bench.errors import DivergedError
from imagine_bench.interfaces.capabilities import ExternalTrainer
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.runs import OnProgress, RunSpec
from imagine_bench.running import phases
from imagine_bench.running.run_state import Run, environments
from imagine_bench.store import run_folder
from imagine_bench.store.results import Checkpoint, ComparedRollout, OpenLoop, PolicyTable


class AtBudget(TypedDict, total=False):
    """What observers measure at a budget: fields of :class:`.Checkpoint`."""

    open_loop: OpenLoop
    beliefs: PolicyTable


class AtEnd(TypedDict, total=False):
    """What observers measure at the end: fields of :class:`.RunResult`."""

    imagined: tuple[ComparedRollout, ...]
    sampled_rollouts: tuple[ComparedRollout, ...]


class RunObserver:
    """Looks at a run after each test and at its end, and changes nothing in it; this one measures nothing."""

    def at_budget(self, run: Run, budget: int) -> AtBudget:
        """Measure what was just tested."""
        return {}

    def at_end(self, run: Run) -> AtEnd:
        """Measure, or record, what has been through all budgets."""
        return {}


def run(spec: RunSpec[Protocol], folder: Path, on_progress: OnProgress, observers: Sequence[RunObserver] = ()) -> None:
    """Do a run, or what is left of it, as far as the budget at which it pauses. Nothing is done of a finished run.

    Raises:
        BusyError: Another process is at this run.
        ArtefactError: The folder holds something damaged, foreign or begun with other settings.
        DivergedError: NaN in physics or learning; the message says where the state lies.
        SetupError: The folder cannot be written, or there is no GL.
    """
    with run_folder.unfinished(folder) as left:
        if left:
            with environments(spec.protocol) as (env, test_env):
                _go_on(Run(spec, folder, on_progress, env, test_env), observers)


def _go_on(run: Run, observers: Sequence[RunObserver]) -> None:
    """Train and test at every budget that is wanted now; after the last one of all, finish."""
    try:
        if isinstance(run.agent, ExternalTrainer):
            phases.train_externally(run, run.agent, lambda budget: _test(run, budget, observers))
        else:
            phases.transfer(run)
            for budget in run.budgets_left:
                if run.entry.learns:
                    phases.train(run, budget)
                _test(run, budget, observers)
    except DivergedError as error:
        raise DivergedError(f"{error} The agent's state lies in {run.save('diverged')}.") from error
    if len(run.counters.rows) == len(run.protocol.budgets):
        measured = AtEnd()
        for observer in observers:
            measured.update(observer.at_end(run))
        run_folder.finish(run.folder, **measured)
    run.tell("done", at_once=True)


def _test(run: Run, budget: int, observers: Sequence[RunObserver]) -> None:
    """Test at ``budget``; an agent that does not learn is tested once, and its row stands at every budget."""
    counters = run.counters
    if counters.rows and not run.entry.learns:
        row = dataclasses.replace(counters.rows[0], episodes=budget)
    else:
        row = _row(run, budget, observers)
    counters.rows.append(row)
    counters.test = None
    run.save()
    run_folder.write_metrics(run.folder, counters.rows)


def _row(run: Run, budget: int, observers: Sequence[RunObserver]) -> Checkpoint:
    test = phases.test(run)
    start_s = time.process_time()
    measured = AtBudget()
    for observer in observers:
        measured.update(observer.at_budget(run, budget))
    return Checkpoint(
        episodes=budget,
        env_steps=run.counters.env_steps,
        **test.figures(),
        kept=test.kept(),
        train_cpu_s=run.counters.train_cpu_s,
        eval_cpu_s=test.cpu_s + time.process_time() - start_s,
        diagnostics=test.diagnostics,
        open_loop=measured.get("open_loop"),
        beliefs=measured.get("beliefs"),
    )
