"""Headlines: how they are declared, corrected and decided, and seeds in stages until they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fake_results import bench_result, rewritten
from small_runs import Inline, small

from imagine_bench import statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.running.bench import bench
from imagine_bench.running.headlines import decided, headlines, stages, until_decided
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult

PAIRS = (("imagination", "dqn"), ("imagination", "dqn_more_updates"))
FIRST = Protocol(
    task="arrow_puzzle",
    preset="quick",
    agents=("random", "dqn", "dqn_more_updates", "imagination"),
    seeds=(*range(30, 36), 39),
    budgets=(100, 500),
    headlines=PAIRS,
    few_seeds=(("random", 32), ("imagination", 35), ("dqn", 34)),
)


def result_of(wanted: Protocol, root: Path, gap: int) -> BenchResult:
    """Runs whose imagination solves ``gap`` tests more than both DQNs, with a spread of twelve."""

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        return dataclasses.replace(row, successes=100 + gap * (run.agent == "imagination") + 12 * (run.seed % 3))

    return rewritten(bench_result(root / wanted.hash, protocol=wanted), change)


def test_headlines_of_a_preset_are_about_its_own_agents() -> None:
    assert protocol("arrow_puzzle", seeds=(7, 8)).headlines == protocol("arrow_puzzle").headlines == PAIRS
    others = [protocol("arrow_puzzle", agents=("dqn", "imagination")), protocol("arrow_puzzle", "smoke")]
    assert {each.headlines for each in (*others, protocol("pick_place"))} == {()}
    assert protocol("arrow_puzzle", agents=("dqn",)).few_seeds == ()
    assert protocol("arrow_puzzle", seeds=(7,)).few_seeds == (), "nobody has more seeds than there are"
    last = dict(protocol("arrow_puzzle", seeds=tuple(range(20, 40, 2))).few_seeds)
    assert (last.pop("imagination"), last.pop("dqn"), {*last.values()}) == (32, 30, {20}), "of seven, six and one"


def test_headlines_are_corrected_for_one_another_and_for_all_looks(tmp_path: Path) -> None:
    found = {}
    needed = {}
    for looks in (1, 4):
        result = result_of(dataclasses.replace(FIRST, most_looks=looks), tmp_path, 30)
        runs = [[result.success_rates(agent)[:, -1] for agent in pair] for pair in PAIRS]
        raw = [statistics.difference(*pair, trials=200).p for pair in runs]
        found[looks] = [each.found.p for each in headlines(result)]
        assert found[looks] == pytest.approx((looks * statistics.holm(raw)).clip(max=1.0).tolist())
        assert decided(result) == (max(found[looks]) < 0.05)
        close = result_of(dataclasses.replace(FIRST, most_looks=looks), tmp_path / "close", 12)
        runs = [[close.success_rates(agent)[:, -1] for agent in pair] for pair in PAIRS]
        more = [statistics.more_seeds(*pair, cells=looks * len(PAIRS), trials=200) for pair in runs]
        assert [each.more for each in headlines(close)] == more and sum(more) > 0
        needed[looks] = sum(more)
    assert found[1] < found[4] and needed[1] < needed[4]


def test_a_bench_is_decided_once_all_of_its_headlines_are(tmp_path: Path) -> None:
    for behind in (("dqn",), ("dqn_more_updates",), ("dqn", "dqn_more_updates")):

        def change(run: RunResult, row: Checkpoint, behind: tuple[str, ...] = behind) -> Checkpoint:
            return dataclasses.replace(row, successes=160 - 60 * (run.agent in behind) + 12 * (run.seed % 3))

        result = rewritten(bench_result(tmp_path / "-".join(behind), protocol=FIRST), change)
        assert [each.decided for each in headlines(result)] == [base in behind for _, base in PAIRS]
        assert decided(result) == (len(behind) == 2)


@pytest.fixture
def staged(tmp_path: Path) -> Callable[[int, list[Protocol]], Callable[..., BenchResult]]:
    """A function that stands for running benches, of imagination so many tests ahead; it notes their protocols."""

    def with_gap(gap: int, asked: list[Protocol]) -> Callable[..., BenchResult]:
        def plan(**changes: Any) -> BenchResult:
            few = tuple((agent, FIRST.seeds[most - 1]) for agent, most in changes.pop("few_seeds", {}).items())
            asked.append(dataclasses.replace(FIRST, few_seeds=few, **changes))
            return result_of(asked[-1], tmp_path, gap)

        return plan

    return with_gap


@pytest.mark.parametrize(("gap", "seeds"), [(60, 7), (27, 10), (24, 13), (0, 14)])
def test_stages_end_once_decided_or_at_the_most(staged: Any, tmp_path: Path, gap: int, seeds: int) -> None:
    """In each stage the others have one and two seeds fewer than ``dqn_more_updates``; ``random`` has its three.

    Added are those after the last one, not those that were left out.
    """
    asked: list[Protocol] = []
    *_, whole = until_decided(staged(gap, asked), FIRST, most=14, root=tmp_path)
    assert decided(whole) == (gap > 0)
    assert whole.protocol.agents == FIRST.agents and whole.protocol.seeds == (*range(30, 36), *range(39, 33 + seeds))
    counts = {agent: len(whole.success_rates(agent)) for agent in FIRST.agents}
    assert counts == {"random": 3, "dqn": seeds - 2, "dqn_more_updates": seeds, "imagination": seeds - 1}
    runs = [(agent, seed) for each in asked for agent in each.agents for seed in each.seeds_of(agent)]
    assert len(runs) == len(set(runs)) == sum(counts.values()), "each run once"
    assert {each.most_looks for each in asked} == {len(stages(7, 14))} == {4}
    again: list[Protocol] = []
    assert until_decided(staged(gap, again), FIRST, most=14, root=tmp_path)[-1].protocol == whole.protocol
    assert again == asked, "the same call asks for the same benches, which are then only read"


def test_a_setting_without_a_headline_agent_is_of_the_first_stage(staged: Any, tmp_path: Path) -> None:
    asked: list[Protocol] = []
    first = dataclasses.replace(FIRST, overrides=(("controller.discount", 0.9), ("dynamics.parents", 2)))
    *_, whole = until_decided(partial(staged(0, asked), overrides=first.overrides), first, most=9, root=tmp_path)
    assert {each.overrides for each in asked[1:]} == {first.overrides[:1]}
    assert whole.protocol.overrides == asked[0].overrides == first.overrides


def test_an_interrupted_search_ends_in_the_same_results(tmp_path: Path) -> None:
    """Real runs, six seeds and then up to eight, killed after each run: every run is made once."""
    wanted = {"agents": ("table", "random"), "seeds": (0, 1, 2, 3, 4, 5), "budgets": (4,)}
    first = small(**wanted, headlines=(("table", "random"),))

    def search(root: Path, launcher: Inline) -> BenchResult:
        def plan(**changes: Any) -> BenchResult:
            asked = small(**{**wanted, "headlines": first.headlines, **changes})
            return bench(asked, {}, root=root, launcher=launcher)

        return until_decided(plan, first, most=8, root=root)[-1]

    whole = search(tmp_path / "whole", Inline())
    assert whole.protocol.seeds == tuple(range(8)) and whole.protocol.most_looks == 2
    order: list[tuple[str, int]] = []
    for _ in range(20):
        launcher = Inline(patience=1)
        with suppress(KeyboardInterrupt):
            again = search(tmp_path / "killed", launcher)
        order += launcher.order
    assert len(order) == 16 and len(set(order)) == 16
    assert again.protocol == whole.protocol
    assert [row.solved for _, row in again.rows] == [row.solved for _, row in whole.rows]


def test_without_headlines_or_with_too_few_seeds_nothing_is_run(tmp_path: Path) -> None:
    def never(**changes: Any) -> BenchResult:
        raise AssertionError(changes)

    with pytest.raises(InvalidValueError, match="This bench has no headlines"):
        until_decided(never, dataclasses.replace(FIRST, headlines=()), most=15, root=tmp_path)
    for most in (6, 0, -1):
        with pytest.raises(InvalidValueError, match=f"--most-seeds {most} is fewer than .* give at least 7"):
            until_decided(never, FIRST, most=most, root=tmp_path)
    last_reported = dataclasses.replace(FIRST, seeds=tuple(range(993, 1000)), few_seeds=())
    with pytest.raises(InvalidValueError, match="mix tuning seeds"):
        until_decided(never, last_reported, most=8, root=tmp_path)
