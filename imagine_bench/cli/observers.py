"""What looks at the runs of a bench: how right agents imagine, example rollouts, and recordings."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from imagine_bench.interfaces import Frame
from imagine_bench.interfaces.capabilities import Imaginer
from imagine_bench.judge.causes import MOST_STATES, beliefs, frames_to_ask_with
from imagine_bench.judge.open_loop import (
    OPEN_LOOP_DEPTH,
    examples,
    imagine_sampled_rollouts,
    open_loop,
    surviving_actions,
)
from imagine_bench.judge.questions import EvalSet
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import ProtocolData
from imagine_bench.protocols.runs import Failure, Job, Launcher, OnProgress, RunSpec
from imagine_bench.rules import states_of
from imagine_bench.running.control import run_control
from imagine_bench.running.run_state import Run, make_env
from imagine_bench.running.runner import AtBudget, AtEnd, RunObserver
from imagine_bench.seeding import SeedTree, evaluation_split
from imagine_bench.store import run_folder
from imagine_bench.store.results import RunResult


class OpenLoopObserver(RunObserver):
    """Compares open-loop imagination with the rules at every budget."""

    def __init__(self) -> None:
        self._begun = False
        self._questions: EvalSet | None = None

    def at_budget(self, run: Run, budget: int) -> AtBudget:
        """``open_loop`` of an agent that imagines."""
        if not isinstance(run.agent, Imaginer) or not run.protocol.shows_frames_alone:
            return {}
        if not self._begun:  # the same at every budget
            self._begun = True
            self._questions = surviving_actions(
                run.task,
                starts=run.protocol.open_loop_starts,
                depth=OPEN_LOOP_DEPTH,
                appearance=run.protocol.appearance_in_tests,
                purpose=evaluation_split(run.spec.seed),
            )
        if self._questions is None:
            return {}
        run.tell("imagining", at_once=True)
        seeds = SeedTree(run.spec.seed).child("open_loop", budget)
        return {"open_loop": open_loop(run.agent, self._questions, seeds)}


class BeliefsObserver(RunObserver):
    """Asks a learner about every macrostate at every budget, for ``imagine-bench verify --causes``."""

    def __init__(self) -> None:
        self._frames: Frame | None = None

    def at_budget(self, run: Run, budget: int) -> AtBudget:
        """``beliefs`` of an agent that learns, in a task of not too many macrostates, each of which frames show."""
        task = run.task
        entry = run.entry
        frames_tell_all = run.protocol.shows_frames_alone and task.sight is None
        if not entry.learns or not frames_tell_all or len(states_of(task.rules)) > MOST_STATES:
            return {}
        if self._frames is None:  # the same at every budget
            appearance = run.protocol.appearance_in_tests
            purpose = evaluation_split(run.spec.seed)
            self._frames = frames_to_ask_with(run.agent, task, appearance=appearance, purpose=purpose)
        rng = SeedTree(run.spec.seed).child("beliefs", budget).generator()
        return {"beliefs": beliefs(run.agent, task.rules, self._frames, rng, privileged=entry.privileged)}


class ExamplesObserver(RunObserver):
    """Keeps a few imagined rollouts of the agent as it is at its end."""

    def at_end(self, run: Run) -> AtEnd:
        """``imagined`` from several starts, and ``sampled_rollouts`` from one."""
        if not isinstance(run.agent, Imaginer) or not run.protocol.shows_frames_alone:
            return {}
        run.tell("imagining", at_once=True)
        agent = run.agent
        task = run.task
        appearance = run.protocol.appearance_in_tests
        seeds = SeedTree(run.spec.seed)
        purpose = evaluation_split(run.spec.seed)
        several = seeds.child("sampled_rollouts")
        return {
            "imagined": examples(agent, task, appearance=appearance, seeds=seeds.child("examples"), purpose=purpose),
            "sampled_rollouts": imagine_sampled_rollouts(
                agent, task, appearance=appearance, seeds=several, purpose=purpose
            ),
        }


class RecordingObserver(RunObserver):
    """Records some greedy episodes beside the results; the file appears whole or not at all."""

    def at_end(self, run: Run) -> AtEnd:
        """Nothing that the result holds."""
        protocol = run.protocol
        if protocol.recorded_episodes == 0:
            return {}
        from imagine_bench.recording.episodes import record_run  # noqa: PLC0415 - loading Rerun costs a second

        run.tell("recording", at_once=True)
        with closing(make_env(protocol, protocol.task, testing=True)) as env:
            record_run(
                protocol.task,
                run.agent,
                name=run.spec.agent,
                seed=run.spec.seed,
                env=env,
                appearance=protocol.appearance_in_tests,
                episodes=protocol.recorded_episodes,
                path=run_folder.recording_path(run.folder),
            )
        return {}


OBSERVERS = tuple(
    f"{__name__}:{observer.__name__}"
    for observer in (OpenLoopObserver, BeliefsObserver, ExamplesObserver, RecordingObserver)
)
"""What looks at every run of a control task, in this order, each as ``"module:attr"``."""
RECORDERS = {
    "toy_regression": "imagine_bench.recording.toy_regression:record",
    "robot_ik": "imagine_bench.recording.robot_ik:record",
}
"""Functions that record the regression tasks of this suite; another package's task names its own."""


def observers_of(protocol: ProtocolData) -> tuple[str, ...]:
    """What looks at each run of a bench, by ``"module:attr"``."""
    if isinstance(protocol, Protocol):
        return OBSERVERS
    return (RECORDERS[protocol.task],) if protocol.task in RECORDERS else ()


class Observed:
    """A launcher whose runs are looked at, as :func:`observers_of` says."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job by the launcher within; see :class:`.Launcher`."""
        observed = [replace(job, spec=replace(job.spec, observers=observers_of(job.spec.protocol))) for job in jobs]
        return self._launcher.launch(observed, on_progress)


def run_observed(spec: RunSpec[Protocol], folder: Path, on_progress: OnProgress) -> RunResult | None:
    """Do a run in this process, looked at by :data:`OBSERVERS`; returns its result, None if it pauses before its end.

    Raises as :func:`.runner.run`.
    """
    run_control(replace(spec, observers=OBSERVERS), folder, on_progress)
    return run_folder.load_run(folder) if run_folder.is_done(folder) else None
