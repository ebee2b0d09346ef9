"""Benches as tables: unfinished ones, kept ones, and several as one."""

from __future__ import annotations

import csv
import dataclasses
import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_results import bench_result, rewritten
from small_runs import made_bench, small

from imagine_bench import statistics
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.exact.certificate import certificate
from imagine_bench.protocols.control import Protocol
from imagine_bench.report.bench import bench_page
from imagine_bench.report.page import write_page
from imagine_bench.running.bench import load_bench
from imagine_bench.running.evaluation import EvaluationCounts
from imagine_bench.store.loading import archive_files, cut, load_so_far, merge
from imagine_bench.store.results import BenchResult, KeptEpisodes


def load_merged(folders: list[Path], root: Path) -> BenchResult:
    return merge([load_so_far(each) for each in folders], root)


_MADE = tempfile.TemporaryDirectory()
"""Every bench of this module, made once."""


@functools.cache
def _made(protocol: Protocol) -> Path:
    return made_bench(protocol, Path(_MADE.name)).folder


def do(root: Path, *agents: str, **changes: Any) -> Path:
    made = _made(small(agents=agents, evaluation_episodes=3, **changes))
    folder = root / made.relative_to(_MADE.name)
    shutil.copytree(made, folder)
    return folder


def kept_from(folder: Path, kept: Path, joined: BenchResult | None = None) -> Path:
    """The part of a bench, or of joined ones, that is kept for good."""
    if joined is None:
        assert main(["report", str(folder)]) == 0
    else:
        write_page(joined.folder / "report", bench_page(joined))
    kept.mkdir()
    for name in ("bench.json", "results.csv"):
        (kept / name).write_bytes((folder / "report" / name).read_bytes())
    return kept


def test_benches_without_a_common_seed_are_refused_with_the_seeds_of_each_agent(tmp_path: Path) -> None:
    first = do(tmp_path, "oracle", seeds=(0, 1), budgets=(4, 9))
    second = do(tmp_path, "random", seeds=(2,), budgets=(4, 9))
    with pytest.raises(ArtefactError, match=r"No seed of the benches .* to 4 .*: oracle has 0 1; random has 2\. Run"):
        load_merged([first, second], tmp_path)


def test_every_run_of_both_is_there_unchanged(tmp_path: Path) -> None:
    first = do(tmp_path, "oracle", seeds=(0, 1), budgets=(4, 9))
    second = do(tmp_path, "random", seeds=(1, 2), budgets=(2, 4, 9))
    joined = load_merged([first, second], tmp_path)
    shown = joined.protocol
    assert (shown.agents, shown.seeds, shown.budgets) == (("oracle", "random"), (1,), (4, 9))
    own = load_bench(second)
    assert np.array_equal(joined.success_rates("random")[0], own.success_rates("random")[0, 1:])
    commands = [load_bench(each).environment["command"] for each in (first, second)]
    assert joined.environment["bench 2"]["command"] == commands[1]
    assert joined.environment["command"] == "; ".join(commands)
    assert joined.folder.name.startswith("merged-") and joined.missing == ()
    assert joined.left_out == ("oracle seed 0", "random seed 2")
    left_out = "Left out, for some agent has not been run with that seed or one before: oracle seed 0"
    assert left_out in bench_page(joined).summary


@pytest.mark.parametrize(
    ("agents", "changes", "error", "words"),
    [
        (("oracle",), {}, InvalidValueError, "have the same seed of the same agent"),
        (("random",), {"appearance": "mild"}, InvalidValueError, "has appearance 'mild' where .* has 'clean'"),
        (("random",), {"encoder": "x@0123456789ab"}, InvalidValueError, "has encoder 'x@.*' where .* has 'a@"),
        (("random",), {"budgets": (3,)}, InvalidValueError, "No budget is in all of the benches"),
        (("oracle",), {"seeds": (5,), "settings_digest": "one"}, InvalidValueError, "has settings_digest 'one'"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    tmp_path: Path, agents: tuple[str, ...], changes: dict[str, Any], error: type[Exception], words: str
) -> None:
    first = do(tmp_path, "oracle", encoder="a@0123456789ab")
    other = do(tmp_path / "other", *agents, **changes)
    with pytest.raises(error, match=words):
        load_merged([first, other], tmp_path)


def test_seeds_of_two_benches_are_those_of_one_in_any_order(tmp_path: Path) -> None:
    whole = load_bench(do(tmp_path / "whole", "oracle", "random", seeds=(0, 1, 2)))
    late = do(tmp_path / "there", "random", "oracle", seeds=(2,))
    early = do(tmp_path / "here", "oracle", "random", seeds=(0, 1))
    joined = load_merged([early, late], tmp_path)
    assert joined.protocol == whole.protocol
    for agent in ("oracle", "random"):
        assert np.array_equal(joined.success_rates(agent), whole.success_rates(agent))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_encoders_and_headlines_may_be_named_by_some_benches_only(tmp_path: Path, order: tuple[int, ...]) -> None:
    """And the names of agents are spelled as in the newest bench."""
    latents, codes = "a@0123456789ab", "c@ba9876543210"
    pair = (("oracle", "random"),)
    named: tuple[dict[str, Any], ...] = ({"encoder": latents}, {"codes": codes}, {"headlines": pair})
    made = [load_bench(do(tmp_path / str(seed), *pair[0], seeds=(seed,), **each)) for seed, each in enumerate(named)]
    old = dataclasses.replace(made[2].protocol, agent_names=1)
    made[2] = dataclasses.replace(made[2], protocol=old)
    joined = merge([made[each] for each in order], tmp_path).protocol
    assert (joined.encoder, joined.codes, joined.agent_names) == (latents, codes, 2)
    assert (joined.seeds, joined.headlines) == ((0, 1, 2), pair)


@pytest.mark.parametrize("lacks", [0, 1])
def test_exact_facts_are_those_of_any_and_time_is_that_of_all(tmp_path: Path, lacks: int) -> None:
    both = [load_bench(do(tmp_path / str(seed), "oracle", seeds=(seed,))) for seed in (0, 1)]
    exact = both[0].certificate
    parts = [
        dataclasses.replace(each, wall_s=2.0 + number, certificate=None if number == lacks else exact)
        for number, each in enumerate(both)
    ]
    joined = merge(parts, tmp_path)
    assert joined.wall_s == 5.0 and joined.certificate == exact is not None
    kept = load_so_far(kept_from(joined.folder, tmp_path / "kept", joined))
    assert (kept.wall_s, kept.certificate) == (5.0, exact)
    coded = [
        dataclasses.replace(each, protocol=dataclasses.replace(each.protocol, code=(("oracle", digits),)))
        for each, digits in zip(both, ("0" * 12, "1" * 12), strict=True)
    ]
    with pytest.raises(InvalidValueError, match="An agent's code was another one in each of the benches"):
        merge(coded, tmp_path)
    assert all(each.wall_s > 0.0 for each in both), "the time of a session is noted at its end, too"


def test_the_exact_facts_of_a_split_are_those_of_its_tests(tmp_path: Path) -> None:
    result = load_bench(do(tmp_path, "oracle", task="arrows:cubes=2", split="plan_length=1"))
    of_tests, of_training = (certificate(result.protocol.spec(testing=testing)) for testing in (True, False))
    assert result.certificate == of_tests != of_training


def test_what_one_of_them_lacks_is_said(tmp_path: Path) -> None:
    here, there = do(tmp_path, "oracle", seeds=(0, 1)), do(tmp_path, "oracle", seeds=(2,))
    shutil.rmtree(here / "oracle" / "seed_1")
    joined = load_merged([here, there], tmp_path)
    assert joined.protocol.seeds == (0, 2)
    assert joined.missing == ("oracle seed 1: 0 of 9 real episodes",)
    assert "This bench is not finished: shown are 2 of 3 seeds up to 9 of 9 real" in bench_page(joined).summary
    assert load_so_far(kept_from(joined.folder, tmp_path / "kept", joined)).missing == joined.missing


@pytest.mark.parametrize(
    ("seeds", "more", "shown", "left_out"),
    [
        ((0, 1), {"agents": ("oracle",), "seeds": (1,)}, {"random": (0, 1), "oracle": (0, 1)}, ()),
        ((0, 1, 2), {"agents": ("oracle",), "seeds": (2,)}, {"random": (0, 1, 2), "oracle": (0,)}, ("oracle seed 2",)),
        (
            (0, 1),
            {"seeds": (2, 3), "few_seeds": {"oracle": 1}},
            {"random": (0, 1, 2, 3), "oracle": (0,)},
            ("oracle seed 2",),
        ),
    ],
    ids=["the others of an agent of few seeds", "a gap in its seeds", "few seeds in both"],
)
def test_agents_of_few_seeds_are_joined_with_their_neighbors(
    tmp_path: Path,
    seeds: tuple[int, ...],
    more: dict[str, Any],
    shown: dict[str, tuple[int, ...]],
    left_out: tuple[str, ...],
) -> None:
    one = do(tmp_path / "one", "random", "oracle", seeds=seeds, few_seeds={"oracle": 1})
    other = do(tmp_path / "other", *more.pop("agents", ("random", "oracle")), **more)
    joined = load_merged([one, other], tmp_path)
    assert {agent: tuple(run.seed for run in joined.of(agent)) for agent in ("random", "oracle")} == shown
    assert joined.left_out == left_out


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


def test_kept_results_say_what_their_run_folders_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = do(tmp_path, "oracle"), do(tmp_path, "random")
    kept = kept_from(second, tmp_path / "kept")
    said, known = load_so_far(kept), load_bench(second)
    for name in ("protocol", "environment", "wall_s", "certificate"):
        assert getattr(said, name) == getattr(known, name) is not None
    with_runs, without = (load_merged([first, other], tmp_path) for other in (second, kept))
    assert (with_runs.protocol, with_runs.folder) == (without.protocol, without.folder)
    assert [run.checkpoints for run in with_runs.of("random")] == [run.checkpoints for run in without.of("random")]
    assert main(["report", str(first), "--merge", str(kept), "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    (page,) = tmp_path.glob("*/merged-*/report/index.html")
    assert "oracle" in shown and "random" in shown and str(page) in shown
    assert not (first / "report").exists()
    (kept / "results.csv").write_text("agent,seed,episodes\nrandom,0,many\n")
    with pytest.raises(ArtefactError, match=r"results\.csv is not the table of a bench of agents"):
        load_merged([first, kept], tmp_path)


def test_no_diagnostic_takes_the_place_of_a_column(tmp_path: Path) -> None:
    """Whatever an agent of somebody else calls its measures."""
    said = {"successes": 99.0, "episodes": 1.0, "seed": 7.5, "agent": 0.5, "diagnostics/seed": 3.0, "loss": 2.0}
    made = load_bench(do(tmp_path, "oracle", "random", seeds=(0, 1)))
    result = rewritten(made, lambda run, row: dataclasses.replace(row, diagnostics=said if run.seed else {}))
    for name, text in archive_files(result).items():
        (tmp_path / name).write_text(text)
    again = load_so_far(tmp_path)
    for line in csv.DictReader((tmp_path / "results.csv").read_text().splitlines()):
        low, high = statistics.wilson(int(line["successes"]), int(line["test_episodes"]))
        shown = [float(line[name]) for name in ("success_rate", "wilson_low", "wilson_high")]
        assert shown == [int(line["successes"]) / 3, low, high]
    assert [(run.agent, run.seed) for run in again.runs] == [(run.agent, run.seed) for run in result.runs]
    for (_, row), (_, known) in zip(again.rows, result.rows, strict=True):
        assert row == known


def test_an_unfinished_bench_keeps_its_largest_table(tmp_path: Path) -> None:
    folder = do(tmp_path, "oracle", "random", seeds=(0, 1), budgets=(4, 9))
    kept, whole = kept_from(folder, tmp_path / "kept"), load_bench(folder)
    assert (load_so_far(kept).protocol, load_so_far(kept).protocol_hash) == (whole.protocol, whole.protocol_hash)
    facts = json.loads((kept / "bench.json").read_text())
    (kept / "bench.json").write_text(json.dumps({**facts, "protocol_hash": "0123456789ab"}))
    assert load_so_far(kept).protocol_hash == "0123456789ab", "that which they were made with"
    rows = (kept / "results.csv").read_text().splitlines(keepends=True)
    (kept / "results.csv").write_text("".join(row for row in rows if not row.startswith("random,1,9,")))
    part = load_so_far(kept)
    assert (part.protocol.seeds, part.protocol.budgets) == ((0,), (4, 9))
    assert part.whole == whole.protocol
    assert part.missing == ("random seed 1: 4 of 9 real episodes",)


def test_the_largest_table_counts_the_results_of_all_agents(tmp_path: Path) -> None:
    """Two budgets of the three agents of seed 0 are six results; one budget of all seeds is five."""
    protocol = small(agents=("oracle", "table", "random"), seeds=(0, 1, 2), budgets=(4, 9), evaluation_episodes=3)
    few = (("oracle", 0), ("random", 0))
    made = made_bench(dataclasses.replace(protocol, few_seeds=few), tmp_path)
    kept = kept_from(made.folder, tmp_path / "kept")
    rows = (kept / "results.csv").read_text().splitlines(keepends=True)
    late = [row for row in rows if row.startswith(("table,1,9,", "table,2,9,"))]
    assert len(late) == 2
    (kept / "results.csv").write_text("".join(row for row in rows if row not in late))
    part = load_so_far(kept).protocol
    assert (part.budgets, part.seeds, len(part.runs)) == ((4, 9), (0,), 3)


def test_a_table_cut_short_leaves_later_imagination_out(tmp_path: Path) -> None:
    result = bench_result(tmp_path)
    run = next(run for run in result.runs if run.agent == "imagination")
    assert run.imagined, "there is something to leave out"
    shown: dict[str, Any] = dict.fromkeys(("recorded", "sampled_rollouts"), run.imagined)
    run = dataclasses.replace(run, **shown)
    whole, budgets = result.protocol, result.protocol.budgets
    assert all(getattr(cut(run, whole), name) == run.imagined for name in ("imagined", *shown))
    short = cut(run, dataclasses.replace(whole, budgets=budgets[:-1]))
    assert [row.episodes for row in short.checkpoints] == list(budgets[:-1])
    assert short.imagined == short.sampled_rollouts == short.recorded == ()
    assert len(short.training_success) == len(short.training_length) == budgets[-2]


def test_a_row_of_the_first_tests_counts_these_alone(tmp_path: Path) -> None:
    kept = KeptEpisodes(
        starts=np.arange(16).reshape(4, 4),
        lengths=np.array([1, 3, 2, 1]),
        actions=np.array([5, 0, 1, 2, 3, 4, 0]),
        returns=np.array([50.0, -7.0, 49.0, 50.0]),
        success=np.array([True, False, True, True]),
        faults=np.array([0, 2, 0, 1]),
        fingerprints=np.arange(4),
        sim_times_s=np.array([2.0, 6.0, 4.0, 2.0]),
    )
    totals: dict[str, Any] = {"test_episodes": 4, "successes": 3, "solved": "1011", "faults": 3}
    means = {"mean_return": 35.5, "mean_length": 1.75}
    row = dataclasses.replace(bench_result(tmp_path).runs[0].checkpoints[0], kept=kept, **totals, **means)
    assert row.of_first(4) == row and EvaluationCounts.of(kept).figures() == {**totals, **means}
    first = row.of_first(2)
    assert (first.test_episodes, first.successes, first.solved, first.faults) == (2, 1, "10", 2)
    assert (first.success_rate, first.mean_return, first.mean_length) == (0.5, 21.5, 2.0)
    assert first.kept is not None and first.kept.actions.tolist() == [5, 0, 1, 2]
    assert {len(array) for name, array in vars(first.kept).items() if name != "actions"} == {2}


def test_an_agent_of_fewer_seeds_is_whole_with_these(tmp_path: Path) -> None:
    few = (("random", 1),)
    protocol = dataclasses.replace(small(agents=("table", "random")), seeds=(0, 1, 2), few_seeds=few)
    made = made_bench(protocol, tmp_path / "runs")
    assert [(run.agent, run.seed) for run in made.runs if run.agent == "random"] == [("random", 0), ("random", 1)]
    assert "3 seeds (random 2)" in bench_page(made).summary
    kept = kept_from(made.folder, tmp_path / "kept")
    assert load_so_far(kept).missing == () and load_so_far(kept).protocol == protocol
