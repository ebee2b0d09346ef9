"""Observers of the runs of a bench: they measure imagination, and keep example rollouts, and recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np

from imagine_bench.arrays import Frame
from imagine_bench.interfaces.capabilities import Imaginer
from imagine_bench.judge.causes import beliefs, can_be_asked, frames_to_ask_with
from imagine_bench.judge.open_loop import (
    OPEN_LOOP_DEPTH,
    examples,
    imagine_sampled_rollouts,
    open_loop,
    surviving_actions,
)
from imagine_bench.judge.questions import EvalSet
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import Failure, Job, Launcher, OnProgress, ProtocolData
from imagine_bench.running.run_state import Run, make_env
from imagine_bench.running.runner import AtBudget, AtEnd, RunObserver
from imagine_bench.seeding import Purpose, SeedTree, evaluation_split
from imagine_bench.store import run_folder


class _InTests(TypedDict):
    """The appearance and the purpose of a run's tests, as the judge's functions take it."""

    appearance: str
    purpose: Purpose


def _in_tests(run: Run) -> _InTests:
    return {"appearance": run.protocol.appearance_in_tests, "purpose": evaluation_split(run.spec.seed)}


class BenchObserver(RunObserver):
    """Compares open-loop imagination with the rules, asks learners about every macrostate, keeps rollouts, records."""

    def __init__(self) -> None:
        self._begun = False
        self._questions: EvalSet | None = None
        self._frames: Frame | None = None

    def at_budget(self, run: Run, budget: int) -> AtBudget:
        """``open_loop`` of an agent that imagines, and of a learner ``beliefs``, for ``verify --causes``."""
        found: AtBudget = {}
        if not run.protocol.shows_frames_alone:
            return found
        if isinstance(run.agent, Imaginer):
            if not self._begun:  # the same at every budget
                self._begun = True
                starts = run.protocol.open_loop_starts
                self._questions = surviving_actions(run.task, starts=starts, depth=OPEN_LOOP_DEPTH, **_in_tests(run))
            if self._questions is not None:
                run.tell("imagining", at_once=True)
                seeds = SeedTree(run.spec.seed).child("open_loop", budget)
                loop = open_loop(run.agent, self._questions, seeds)
                if run.protocol.feedback:  # the agent imagines the teacher's rewards, not those of the rules
                    loop = replace(loop, reward_mae=np.full_like(loop.reward_mae, math.nan))
                found["open_loop"] = loop
        if run.entry.learns and can_be_asked(run.task):
            if self._frames is None:  # likewise
                self._frames = frames_to_ask_with(run.agent, run.task, **_in_tests(run))
            rng = SeedTree(run.spec.seed).child("beliefs", budget).generator()
            found["beliefs"] = beliefs(run.agent, run.task.rules, self._frames, rng, privileged=run.entry.privileged)
        return found

    def at_end(self, run: Run) -> AtEnd:
        """``imagined`` from several starts and ``sampled_rollouts`` from one, of an agent that imagines; a recording.

        The recording, of some greedy episodes, lies beside the results; the file appears whole or not at all. The first
        of them that was solved and the first that was not are ``recorded``.
        """
        found: AtEnd = {}
        if isinstance(run.agent, Imaginer) and run.protocol.shows_frames_alone:
            run.tell("imagining", at_once=True)
            seeds = SeedTree(run.spec.seed)
            found["imagined"] = examples(run.agent, run.task, seeds=seeds.child("examples"), **_in_tests(run))
            seeds = seeds.child("sampled_rollouts")
            found["sampled_rollouts"] = imagine_sampled_rollouts(run.agent, run.task, seeds=seeds, **_in_tests(run))
        recorded = run.protocol.seeds[: run.protocol.recorded_seeds or None]
        if run.protocol.recorded_episodes > 0 and run.spec.seed in recorded:
            from imagine_bench.recording.episodes import record_run  # noqa: PLC0415 - Rerun loads slowly

            run.tell("recording", at_once=True)
            with closing(make_env(run.protocol, run.protocol.task, testing=True)) as env:
                found["recorded"] = record_run(
                    run.protocol.task,
                    run.agent,
                    name=run.spec.agent,
                    seed=run.spec.seed,
                    env=env,
                    appearance=run.protocol.appearance_in_tests,
                    episodes=run.protocol.recorded_episodes,
                    path=run_folder.recording_path(run.folder),
                )
        return found


OBSERVERS = (f"{__name__}:{BenchObserver.__name__}",)
"""The observers of every run of a control task, each as ``"module:attr"``."""


def observers_of(protocol: ProtocolData) -> tuple[str, ...]:
    """The observers of each run of a bench, by ``"module:attr"``."""
    return OBSERVERS if isinstance(protocol, Protocol) else ()  # a regression task names its own recorder


@dataclass(frozen=True)
class Observed:
    """A launcher whose runs are looked at, as :func:`observers_of` says."""

    launcher: Launcher

    def launch(self, jobs: Sequence[Job], on_progress: OnProgress) -> tuple[Failure, ...]:
        """Carry out every job by the launcher within; see :class:`.Launcher`."""
        observed = [replace(job, spec=replace(job.spec, observers=observers_of(job.spec.protocol))) for job in jobs]
        return self.launcher.launch(observed, on_progress)
