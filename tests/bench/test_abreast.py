"""Runs of several seeds side by side in one process end as each ends alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_launchers import job
from test_resume_learners import KilledError, measured
from test_runner import final_arrays, small

from imagine_bench import registry
from imagine_bench.bench import runner
from imagine_bench.bench.cohort import side_by_side
from imagine_bench.bench.launchers import LocalPool, cohorts, launcher
from imagine_bench.bench.runs import Progress, RunSpec
from imagine_bench.errors import InvalidValueError
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.results import RunResult

SEEDS = (0, 1, 2)


def do(root: Path, agent: str, seed: int, every_s: float = 20.0) -> RunResult | None:
    overrides = (("imagination.rehearsal_episodes", 5), ("imagination.start_episode", 3))
    protocol = small(
        agents=(agent,), seeds=SEEDS, budgets=(6, 12), evaluation_episodes=4, open_loop_starts=3, overrides=overrides
    )
    encoder = encoders.resolve(registry.task("arrow_puzzle"), "clean")
    spec = RunSpec(protocol=protocol, agent=agent, seed=seed, encoder=encoder, checkpoint_every_s=every_s)
    return runner.run(spec, root / f"seed_{seed}", lambda progress: None)


@pytest.mark.parametrize("agent", ["dqn", "imagination_uncertainty", "imagination_only"])
def test_learners_side_by_side_end_as_alone(tmp_path: Path, agent: str) -> None:
    alone = [do(tmp_path / "alone", agent, seed) for seed in SEEDS]
    abreast = side_by_side([partial(do, tmp_path / "abreast", agent, seed) for seed in SEEDS])
    for seed, one, other in zip(SEEDS, alone, abreast, strict=True):
        assert isinstance(other, RunResult) and one is not None
        assert np.array_equal(one.training_length, other.training_length)
        assert [row.successes for row in one.checkpoints] == [row.successes for row in other.checkpoints]
        before, after = (final_arrays(tmp_path / way / f"seed_{seed}") for way in ("alone", "abreast"))
        for name, array in before.items():
            np.testing.assert_allclose(after[name], array, rtol=1e-3, atol=1e-4, err_msg=name)
    assert measured(abreast[0]) != measured(abreast[1]), "seeds must differ, or agreement shows nothing"


def test_one_that_dies_abreast_and_goes_on_alone_ends_as_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent, real, saves = "imagination_uncertainty", runner.save_snapshot, []

    def killing(folder: Path, snapshot: Any) -> Path:
        if folder.parent.name == "seed_1":
            saves.append(snapshot)
            if len(saves) == 8:
                raise KilledError
        return real(folder, snapshot)

    alone = do(tmp_path / "alone", agent, 1)
    monkeypatch.setattr(runner, "save_snapshot", killing)
    first, second = side_by_side([partial(do, tmp_path / "abreast", agent, seed, 0.0) for seed in (0, 1)])
    assert isinstance(first, RunResult) and isinstance(second, KilledError)
    resumed = do(tmp_path / "abreast", agent, 1, 0.0)
    assert alone is not None and resumed is not None
    assert [row.successes for row in alone.checkpoints] == [row.successes for row in resumed.checkpoints]
    before, after = (final_arrays(tmp_path / way / "seed_1") for way in ("alone", "abreast"))
    for name, array in before.items():
        np.testing.assert_allclose(after[name], array, rtol=1e-3, atol=1e-4, err_msg=name)


def test_what_a_run_costs_abreast_is_its_own(tmp_path: Path) -> None:
    """Three side by side are told no more CPU time, all together, than they took, and each a share of it."""
    begin_s = time.process_time()
    results = side_by_side([partial(do, tmp_path, "dqn", seed) for seed in SEEDS])
    took_s = time.process_time() - begin_s
    told_s = [result.checkpoints[-1].train_cpu_s for result in results if isinstance(result, RunResult)]
    assert len(told_s) == len(SEEDS)
    assert 0.0 < sum(told_s) <= took_s
    assert max(told_s) < 0.7 * sum(told_s)


def test_jobs_are_grouped_by_agent_and_come_seed_by_seed(tmp_path: Path) -> None:
    table, failing = (
        [job(tmp_path, agent, seed) for seed in range(count)] for agent, count in (("table", 3), ("failing", 2))
    )
    jobs = [table[0], failing[0], table[1], failing[1], table[2]]  # as a bench gives them
    assert cohorts(jobs, 1) == [tuple(table), tuple(failing)]
    assert cohorts(jobs, 2) == [tuple(table[:2]), (failing[0],), (failing[1],), (table[2],)]
    assert cohorts(jobs, 1, 2) == [tuple(table[:2]), tuple(failing), (table[2],)]
    assert cohorts(jobs, 16) == cohorts(jobs, 1, 1) == [(each,) for each in jobs]


def test_a_run_that_fails_stops_no_other_beside_it(tmp_path: Path) -> None:
    jobs = [job(tmp_path, "failing", seed) for seed in (1, 0)]
    told: list[Progress] = []
    (failure,) = LocalPool(1, abreast=2).launch(jobs, told.append)
    assert failure.job is jobs[0] and failure.reason == "RuntimeError: this agent breaks on purpose"
    assert "Traceback" in jobs[0].log.read_text() and "Traceback" not in jobs[1].log.read_text()
    assert run_folder.is_done(jobs[1].folder) and not run_folder.is_done(jobs[0].folder)


@pytest.mark.parametrize("make", [partial(launcher, "local"), LocalPool])
def test_none_abreast_is_refused(make: Callable[[int, int], object]) -> None:
    with pytest.raises(InvalidValueError, match="0 runs abreast are none; give at least 1"):
        make(1, 0)
