"""Benches of different agents, or of different seeds of the same agents, shown as one."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_results import bench_result
from small_runs import Inline, small

from imagine_bench.cli import main
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.report import summary_table, write_report
from imagine_bench.running.bench import bench
from imagine_bench.running.task_types import load_bench
from imagine_bench.store.archive import load_archive
from imagine_bench.store.bench_folder import is_archive
from imagine_bench.store.merge import cut, load_so_far, merge
from imagine_bench.store.results import BenchResult


def load_merged(folders: list[Path], root: Path) -> BenchResult:
    return merge([load_archive(each) if is_archive(each) else load_so_far(each) for each in folders], root)


_MADE = tempfile.TemporaryDirectory()
"""Every bench of this module, made once."""


@functools.cache
def _made(protocol: Protocol) -> Path:
    return bench(protocol, {}, root=Path(_MADE.name), launcher=Inline()).folder


def do(root: Path, *agents: str, **changes: Any) -> Path:
    made = _made(small(agents=agents, evaluation_episodes=3, **changes))
    folder = root / made.relative_to(_MADE.name)
    shutil.copytree(made, folder)
    return folder


def kept_from(folder: Path, kept: Path) -> Path:
    """What is kept of a bench for good."""
    assert main(["report", str(folder)]) == 0
    kept.mkdir()
    for name in ("bench.json", "results.csv"):
        (kept / name).write_bytes((folder / "report" / name).read_bytes())
    return kept


def test_every_run_of_both_is_there_unchanged(tmp_path: Path) -> None:
    first = do(tmp_path, "oracle", seeds=(0, 1), budgets=(4, 9))
    second = do(tmp_path, "random", seeds=(1, 2), budgets=(2, 4, 9))
    joined = load_merged([first, second], tmp_path)
    assert (joined.protocol.agents, joined.protocol.seeds, joined.protocol.budgets) == (
        ("oracle", "random"),
        (1,),
        (4, 9),
    )
    own = load_bench(second)
    assert np.array_equal(joined.success_rates("random")[0], own.success_rates("random")[0, 1:])
    assert joined.environment["bench 2"]["command"] == own.environment["command"]
    assert joined.folder not in (first, second) and joined.folder.name.startswith("merged-")
    assert dataclasses.asdict(joined.protocol)["evaluation_episodes"] == 3


def test_diagnostics_of_a_test_not_shown_count_for_the_next(tmp_path: Path) -> None:
    """Interval means, over 10, 20 and 70 steps, of which the first two end in one test that is shown."""
    whole = Protocol(task="arrow_puzzle", preset="quick", budgets=(10, 30, 100))
    run = bench_result(tmp_path, protocol=whole).of("imagination")[0]
    rows = tuple(
        dataclasses.replace(
            row, env_steps=row.episodes, diagnostics={"time/model_s": time_s, "loss/x": 1.0, "epsilon": e}
        )
        for row, time_s, e in zip(run.checkpoints, (0.1, 0.4, 0.2), (0.9, 0.5, 0.1), strict=True)
    )
    cut_run = cut(dataclasses.replace(run, checkpoints=rows), dataclasses.replace(whole, budgets=(30, 100)))
    first, second = cut_run.checkpoints
    assert first.diagnostics == {"time/model_s": pytest.approx((10 * 0.1 + 20 * 0.4) / 30), "epsilon": 0.5}
    assert second == rows[2]


@pytest.mark.parametrize(
    ("agents", "changes", "words"),
    [
        (("oracle",), {}, "a seed in common"),
        (("oracle", "random"), {}, "an agent in common"),
        (("random",), {"appearance": "mild"}, "has appearance 'mild' where .* has 'clean'"),
        (("random",), {"seeds": (5,)}, "have no seeds in common"),
        (("random",), {"budgets": (3,)}, "have no budgets in common"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    tmp_path: Path, agents: tuple[str, ...], changes: dict[str, Any], words: str
) -> None:
    first = do(tmp_path, "oracle")
    other = do(tmp_path / "other", *agents, **changes)
    with pytest.raises(InvalidValueError, match=words):
        load_merged([first, other], tmp_path)


def test_seeds_of_two_benches_are_those_of_one(tmp_path: Path) -> None:
    whole = load_bench(do(tmp_path / "whole", "oracle", "random", seeds=(0, 1, 2)))
    late = do(tmp_path / "there", "oracle", "random", seeds=(2,))
    early = do(tmp_path / "here", "oracle", "random", seeds=(0, 1))
    joined = load_merged([late, early], tmp_path)
    assert joined.protocol == whole.protocol
    for agent in ("oracle", "random"):
        assert np.array_equal(joined.success_rates(agent), whole.success_rates(agent))


def test_the_order_of_agents_is_nothing(tmp_path: Path) -> None:
    here, there = do(tmp_path, "oracle", "random", seeds=(0,)), do(tmp_path, "random", "oracle", seeds=(1,))
    joined = load_merged([here, there], tmp_path)
    assert (joined.protocol.agents, joined.protocol.seeds) == (("oracle", "random"), (0, 1))


def test_what_one_of_them_lacks_is_said(tmp_path: Path) -> None:
    here, there = do(tmp_path, "oracle", seeds=(0, 1)), do(tmp_path, "oracle", seeds=(2,))
    shutil.rmtree(here / "oracle" / "seed_1")
    joined = load_merged([here, there], tmp_path)
    assert joined.protocol.seeds == (0, 2)
    assert joined.missing == ("oracle seed 1: 0 of 9 real episodes",)
    assert "One of these benches is not finished: shown are 2 seeds up to 9 real" in summary_table(joined)
    assert "Missing are oracle seed 1" in write_report(joined).read_text()


def test_seeds_whose_machines_chose_other_settings_are_refused(tmp_path: Path) -> None:
    """As ``model.precision`` is chosen by processor: protocols, with their digests, are one."""
    result: BenchResult = load_bench(do(tmp_path, "oracle", seeds=(0, 1)))
    runs = [
        dataclasses.replace(run, settings={"model": {"members": 1, "precision": precision}})
        for run, precision in zip(result.runs, ("bfloat16", "float32"), strict=True)
    ]
    with pytest.raises(ArtefactError, match=r"ran with model\.precision 'bfloat16' and .*seed_1 with 'float32'"):
        dataclasses.replace(result, runs=tuple(runs))
    assert dataclasses.replace(result, runs=(runs[0], dataclasses.replace(runs[1], settings={}))), "kept ones have none"


@pytest.mark.parametrize("digest", ["another", ""])
def test_seeds_of_other_settings_are_refused(tmp_path: Path, digest: str) -> None:
    here = do(tmp_path, "random", seeds=(0,), settings_digest="one")
    there = do(tmp_path, "random", seeds=(1,), settings_digest=digest)
    with pytest.raises(InvalidValueError, match=rf"of different settings \(.*{digest or 'unknown'}"):
        load_merged([here, there], tmp_path)


def test_the_command_writes_one_report_of_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = do(tmp_path, "oracle"), do(tmp_path, "random")
    assert main(["report", str(first), "--merge", str(second), "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "oracle" in shown and "random" in shown
    (page,) = tmp_path.glob("*/merged-*/report/index.html")
    assert str(page) in shown
    assert not (second / "report").exists()


def test_kept_results_say_what_their_run_folders_said(tmp_path: Path) -> None:
    first, second = do(tmp_path, "oracle"), do(tmp_path, "random")
    kept = kept_from(second, tmp_path / "kept")
    with_runs, without = (load_merged([first, other], tmp_path / "joined") for other in (second, kept))
    assert with_runs.protocol == without.protocol and with_runs.folder == without.folder
    for mine, theirs in zip(with_runs.of("random"), without.of("random"), strict=True):
        assert mine.checkpoints == theirs.checkpoints
    assert write_report(without).is_file()


def test_kept_results_have_a_report_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(kept_from(do(tmp_path, "oracle", "random"), tmp_path / "kept"))]) == 0
    assert "oracle" in capsys.readouterr().out
    assert (tmp_path / "kept/report/index.html").is_file()


def test_an_unfinished_bench_keeps_its_largest_table(tmp_path: Path) -> None:
    folder = do(tmp_path, "oracle", "random", seeds=(0, 1), budgets=(4, 9))
    kept = kept_from(folder, tmp_path / "kept")
    rows = (kept / "results.csv").read_text().splitlines(keepends=True)
    (kept / "results.csv").write_text("".join(row for row in rows if not row.startswith("random,1,9,")))
    part = load_archive(kept)
    assert (part.protocol.seeds, part.protocol.budgets) == ((0,), (4, 9))
    assert part.whole == load_bench(folder).protocol
    assert part.missing == ("random seed 1: 4 of 9 real episodes",)


def test_kept_regression_results_have_no_report_and_say_so(capsys: pytest.CaptureFixture[str]) -> None:
    kept = Path(__file__).parents[2] / "docs/results/toy_regression-thesis"
    assert main(["report", str(kept)]) == 2
    assert "keeps a bench of toy_regression, whose tables are its .csv files" in capsys.readouterr().err


def test_a_damaged_table_is_named(tmp_path: Path) -> None:
    first, second = do(tmp_path, "oracle"), do(tmp_path, "random")
    kept = kept_from(second, tmp_path / "kept")
    (kept / "results.csv").write_text("agent,seed,episodes\nrandom,0,many\n")
    with pytest.raises(ArtefactError, match=r"results\.csv is not the table of a bench of agents"):
        load_merged([first, kept], tmp_path)


def test_kept_results_are_read_back_and_keep_their_hash(tmp_path: Path) -> None:
    folder = do(tmp_path, "oracle", "random", seeds=(0, 1))
    kept, whole = load_archive(kept_from(folder, tmp_path / "kept")), load_bench(folder)
    assert (kept.protocol, kept.protocol_hash) == (whole.protocol, whole.protocol_hash)
    for agent in whole.protocol.agents:
        assert kept.success_rates(agent).tolist() == whole.success_rates(agent).tolist()
    facts = json.loads((tmp_path / "kept" / "bench.json").read_text())
    facts["protocol_hash"] = "0123456789ab"
    (tmp_path / "kept" / "bench.json").write_text(json.dumps(facts))
    assert load_archive(tmp_path / "kept").protocol_hash == "0123456789ab"


def test_a_table_cut_short_leaves_later_imagination_out(tmp_path: Path) -> None:
    result = bench_result(tmp_path)
    run = next(run for run in result.runs if run.agent == "imagination")
    assert run.imagined, "there is something to leave out"
    whole, budgets = result.protocol, result.protocol.budgets
    assert cut(run, whole).imagined == run.imagined
    short = cut(run, dataclasses.replace(whole, budgets=budgets[:-1]))
    assert [row.episodes for row in short.checkpoints] == list(budgets[:-1])
    assert short.imagined == () and short.sampled_rollouts == ()
    assert len(short.training_success) == len(short.training_length) == budgets[-2]
