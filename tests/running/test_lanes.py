"""Test episodes in lanes: those that are played one after another, to the bit."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_fakes import Rememberer
from imagine_bench.tasks.motion.executor import MacroExecutor
from small_runs import run_observed, same_but_for_time, small

from imagine_bench.errors import DivergedError
from imagine_bench.protocols.runs import Job, RunSpec
from imagine_bench.running import lanes
from imagine_bench.running.launchers import jobs
from imagine_bench.running.run_state import Run
from imagine_bench.store.results import RunResult

PHYSICS: dict[str, Any] = {"execution": "physics", "budgets": (2, 3), "evaluation_episodes": 9}


def do(folder: Path, agent: str = "table", cores: int = 2, every_s: float = 20.0, **changes: Any) -> RunResult:
    wanted = small(**{**PHYSICS, **changes})
    spec = RunSpec(protocol=wanted, agent=agent, seed=0, checkpoint_every_s=every_s, cores=cores)
    result = run_observed(spec, folder, lambda progress: None)
    assert result is not None
    return result


@pytest.fixture
def in_lanes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Lanes wherever they are allowed: how many episodes each test has played in them."""
    played, play = list[int](), lanes._play

    def counted(*given: Any, **more: Any) -> Any:
        played.append(0)
        for episode in play(*given, **more):
            played[-1] += 1
            yield episode

    monkeypatch.setattr(lanes, "LEAST_EPISODES", 2)
    monkeypatch.setattr(lanes, "_play", counted)
    return played


@pytest.mark.parametrize("changes", [{}, {"test_appearance": "strong"}])
def test_lanes_change_no_result(changes: dict[str, Any], tmp_path: Path, in_lanes: list[int]) -> None:
    result = do(tmp_path / "lanes", **changes)
    assert in_lanes == [9, 9]
    alone = do(tmp_path / "alone", cores=1, **changes)
    assert in_lanes == [9, 9] and same_but_for_time(result, alone)
    lengths = [row.kept.lengths for row in result.checkpoints if row.kept is not None]
    assert len(set(np.concatenate(lengths).tolist())) > 1


def test_a_test_that_was_interrupted_goes_on(
    tmp_path: Path, in_lanes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = do(tmp_path / "whole")
    made_progress = Run.made_progress

    def interrupted(run: Run, phase: Any) -> None:
        made_progress(run, phase)
        if run.counters.test is not None and run.counters.test.episodes == 5:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Run, "made_progress", interrupted)
        do(tmp_path / "again", every_s=0.0)
    in_lanes.clear()
    assert same_but_for_time(do(tmp_path / "again"), whole)
    assert in_lanes == [4, 9]


def test_a_simulation_that_blows_up_ends_the_run(
    tmp_path: Path, in_lanes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = MacroExecutor.run
    runs = itertools.count()

    def failing(executor: MacroExecutor, trajectory: Any, **options: Any) -> Any:
        qpos = run(executor, trajectory, **options)
        number = next(runs)
        if in_lanes and number > 25:
            raise DivergedError("The simulation diverged.")
        return qpos

    monkeypatch.setattr(MacroExecutor, "run", failing)
    with pytest.raises(DivergedError, match=r"The simulation diverged\. The agent's state lies in"):
        do(tmp_path / "run")


def test_agents_of_chance_are_asked_in_order(tmp_path: Path, in_lanes: list[int]) -> None:
    do(tmp_path / "run", agent="random")
    do(tmp_path / "kinematic", execution="kinematic")
    assert not in_lanes


def test_who_remembers_an_episode_is_told_of_each_and_plays_it_alone(tmp_path: Path, in_lanes: list[int]) -> None:
    Rememberer.lengths.clear()
    result = do(tmp_path / "run", agent="rememberer", budgets=(4,))
    (row,) = result.checkpoints
    assert not in_lanes and row.kept is not None
    played = [*result.training_length.tolist(), *np.asarray(row.kept.lengths).tolist()]
    asked = [length for length in Rememberer.lengths[len(played) :] if length]
    assert Rememberer.lengths[: len(played)] == played and max(played) > 1
    assert asked == [1] * len(asked) and len(asked) > 50, "asked about each macrostate on its own"


def test_runs_share_the_cores_of_their_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given: list[int] = []

    def begun(job: Job, cores: int) -> None:
        given.append(cores)
        raise InterruptedError

    monkeypatch.setattr(jobs, "usable_cores", lambda: 8)
    monkeypatch.setattr(jobs, "_Child", begun)
    job = Job(spec=RunSpec(protocol=small(), agent="table", seed=0), folder=tmp_path)
    for workers, count in ((8, 1), (2, 5), (8, 8), (16, 20)):
        with pytest.raises(InterruptedError):
            jobs.LocalPool(workers).launch([job] * count, lambda progress: None)
    assert given == [8, 4, 1, 1]
