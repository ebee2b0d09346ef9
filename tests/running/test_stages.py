"""Long benches go stage by stage, and what is there of an unfinished one can be read."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_runs import Inline, small

from imagine_bench.errors import ArtefactError, RunFailedError
from imagine_bench.protocols import control as protocols
from imagine_bench.protocols.control import protocol
from imagine_bench.report import summary_table, write_report
from imagine_bench.running import bench as benches
from imagine_bench.store import run_folder
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult


@pytest.fixture(autouse=True)
def early_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocols, "_FIRST_STAGE", 4)


def bench(root: Path, launcher: Inline, **changes: object) -> BenchResult:
    wanted = small(**{"budgets": (2, 4, 6, 9), "agents": ("table", "imaginer"), "seeds": (0, 1), **changes})
    return benches.bench(wanted, {}, root=root, launcher=launcher)


def test_all_runs_come_to_a_stage_before_any_goes_on(tmp_path: Path) -> None:
    launcher = Inline()
    result = bench(tmp_path, launcher)
    runs = [(agent, seed) for seed in (0, 1) for agent in ("imaginer", "table")]
    assert launcher.order == [(*run, until) for until in (4, 6, None) for run in runs]
    assert result.missing == () and result.whole is None
    bench(tmp_path, launcher)
    assert len(launcher.order) == 12, "a finished bench is only read"


def test_short_benches_have_one_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert protocol("arrow_puzzle", "quick").stages == (None,)
    assert protocol("arrow_puzzle", "thesis").stages == (2000, 3000, 4000, 5000, None)


def test_a_failed_run_goes_no_further_and_the_others_do(tmp_path: Path) -> None:
    launcher = Inline()
    with pytest.raises(RunFailedError, match="1 of 2 runs failed"):
        bench(tmp_path, launcher, agents=("failing",))
    assert launcher.order == [(("failing"), seed, until) for seed, until in ((0, 4), (1, 4), (0, 6), (0, None))]


@pytest.mark.parametrize(
    ("jobs", "seeds", "budgets"),
    [(2, (0,), (2, 4)), (7, (0, 1), (2, 4)), (11, (0, 1), (2, 4, 6))],
)
def test_an_unfinished_bench_shows_its_largest_complete_table(
    tmp_path: Path, jobs: int, seeds: tuple[int, ...], budgets: tuple[int, ...]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, Inline(patience=jobs))
    (folder,) = tmp_path.glob("arrow_puzzle/*")
    result = load_so_far(folder)
    assert result.protocol.seeds == seeds
    assert result.protocol.budgets == budgets
    assert folder.name == f"smoke-{result.protocol_hash}"
    elsewhere = shutil.copytree(folder, tmp_path / "carried elsewhere")
    assert load_so_far(elsewhere).protocol == result.protocol
    assert len(result.runs) == 2 * len(seeds)
    assert all(len(run.training_length) == budgets[-1] for run in result.runs)
    done = sum(
        run_folder.is_done(folder / agent / f"seed_{seed}") for agent in ("table", "imaginer") for seed in (0, 1)
    )
    assert len(result.missing) == 4 - done
    text = summary_table(result)
    assert f"{len(seeds)} of 2 seeds up to {budgets[-1]} of 9 real episodes" in text
    assert "table seed 1" in text, "of a seed it comes last"
    assert "This bench is not finished" in write_report(result).read_text()


def test_a_bench_that_lacks_recordings_alone_is_not_finished(tmp_path: Path) -> None:
    result = bench(tmp_path, Inline())
    assert load_so_far(result.folder).whole is None
    (result.folder / "table" / "seed_0" / "DONE").unlink()
    part = load_so_far(result.folder)
    assert part.protocol == result.protocol == part.whole
    assert part.missing == ("table seed 0: its recording",)


def test_nothing_to_compare_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, Inline(patience=1))
    (folder,) = tmp_path.glob("arrow_puzzle/*")
    with pytest.raises(ArtefactError, match="No seed of this bench has brought every agent to 2 real episodes yet"):
        load_so_far(folder)
