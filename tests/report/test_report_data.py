"""The numbers of a report before anybody words or draws them, each once more in plain numpy."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result

from imagine_bench import reference, registry, statistics
from imagine_bench.protocols.control import Protocol
from imagine_bench.report.bench import cost
from imagine_bench.report.data import _nan_mean, agent_title, collect, open_loop_csv, summary_csv
from imagine_bench.report.tables import seconds
from imagine_bench.store import encoders
from imagine_bench.store.results import BenchResult, Checkpoint


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    """Three seeds that differ in all they cost."""
    protocol = Protocol(task="arrow_puzzle", preset="thesis", budgets=(250, 2000, 6000), seeds=(0, 1, 7))
    plain = bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol)
    rng, runs = np.random.default_rng(0), []
    for run in plain.runs:
        rows, steps = [], 0
        for row in run.checkpoints:
            steps += int(rng.integers(500, 900))
            said = {name: float(rng.uniform()) for name in (*row.diagnostics, "gradient_updates") if row.diagnostics}
            cost = {"train_cpu_s": rng.uniform(5, 9), "eval_cpu_s": rng.uniform(1, 2), "faults": int(rng.integers(9))}
            rows.append(dataclasses.replace(row, env_steps=steps, diagnostics=said, **cost))
        runs.append(dataclasses.replace(run, checkpoints=tuple(rows)))
    return dataclasses.replace(plain, runs=tuple(runs))


@pytest.mark.parametrize("agent", ["random", "dqn", "imagination"])
def test_costs_are_means_over_seeds(result: BenchResult, agent: str) -> None:
    data, runs = collect(result), result.of(agent)
    learns, columns = agent != "random", zip(*(run.checkpoints for run in runs), strict=True)
    prices = data.prices(agent)
    for budget, rows in zip(data.budgets, columns, strict=True):
        assert prices[budget].env_steps == pytest.approx(np.mean([row.env_steps for row in rows]))
        assert prices[budget].train_cpu_s == pytest.approx(np.mean([row.train_cpu_s for row in rows]))
        updates = np.mean([row.diagnostics["gradient_updates"] for row in rows]) if learns else math.nan
        assert prices[budget].updates == pytest.approx(updates, nan_ok=True)
    tests = [row for run in runs for row in run.checkpoints[: 3 if learns else 1]]
    steps = round(sum(row.test_episodes * row.mean_length for row in tests))
    learning = math.nan
    if learns:  # by seed and budget
        a_step_s = np.array([[sum(_times(row)) for row in run.checkpoints] for run in runs])
        taken = np.diff([[0, *(row.env_steps for row in run.checkpoints)] for run in runs])
        learning = (a_step_s * taken).sum(axis=1).mean()
    training = prices[6000].train_cpu_s
    times = (training, learning, training - learning, sum(row.eval_cpu_s for row in tests) / 3)
    shown = {row[0]: row[1:] for row in cost(data).tables[0].rows}[agent_title(agent)]
    faults = f"{sum(row.faults for row in tests)} of {steps:,}"
    assert shown == [f"{prices[6000].env_steps:,.0f}", *map(seconds, times), faults]


def _times(row: Checkpoint) -> list[float]:
    return [value for name, value in row.diagnostics.items() if name.startswith("time/")]


def test_open_loop_quality_is_the_mean_at_the_last_budget(result: BenchResult) -> None:
    found = collect(result).open_loop
    assert set(found) == {agent for agent in result.protocol.agents if agent.startswith("imagination")}
    last = [run.checkpoints[-1].open_loop for run in result.of("imagination")]
    assert found["imagination"].count.tolist() == [300] * 10
    for name in ("correct", "reward_mae", "auroc_epistemic"):
        assert getattr(found["imagination"], name) == pytest.approx(np.mean([getattr(loop, name) for loop in last], 0))
    assert np.isnan(found["imagination"].auroc_modal[0]), "unknown in every run"


def test_gains_are_of_learners_over_dqn(result: BenchResult) -> None:
    data, agents = collect(result), result.protocol.agents
    learners = {agent for agent in agents if registry.agent_entry(agent).learns}
    assert set(data.comparisons) == learners - {"dqn"} and set(data.areas) == set(data.reached) == learners
    shares, base = (result.success_rates(agent)[:, 1] for agent in ("imagination", "dqn"))
    row = data.comparisons["imagination"][2000]
    assert row.difference == statistics.difference(shares, base, trials=result.protocol.evaluation_episodes)
    assert row.gain.value == pytest.approx((shares.mean() - base.mean()) / base.mean())
    assert row.thesis_gain == reference.gain("arrow_puzzle", "imagination")[2000]
    score, thesis = data.scores["dqn"][2000]
    assert thesis == reference.success("arrow_puzzle", "dqn")[2000] and score.value == statistics.iqm(base)
    assert (score.low, score.high) == statistics.interval(base, trials=result.protocol.evaluation_episodes)


def test_every_row_of_a_table_is_as_wide_as_its_head(result: BenchResult) -> None:
    for table, count in (
        (summary_csv(collect(result)), 3 * len(result.protocol.agents)),
        (open_loop_csv(result), None),
    ):
        head, *body = csv.reader(io.StringIO(table))
        assert {len(row) for row in body} == {len(head)}
        assert count in (None, len(body))


def test_frames_seen_beforehand_are_those_of_the_card(result: BenchResult) -> None:
    path, agents = encoders.bundled()["arrow_puzzle-clean"], ("random", "imagination")
    seen = json.loads(path.with_suffix(".json").read_text())["recipe"]["frames"]
    for identity, frames in ((encoders.identity(path), seen), ("foreign@0123456789ab", None)):
        protocol = dataclasses.replace(result.protocol, agents=agents, encoder=identity)
        runs = tuple(run for run in result.runs if run.agent in agents)
        found = collect(dataclasses.replace(result, protocol=protocol, runs=runs)).frames_before
        assert found == {"random": 0, "imagination": frames}


def test_infinite_uncertainty_stays_and_unknown_is_left_out() -> None:
    table = np.array([[1.0, np.inf, np.nan, np.nan], [3.0, 2.0, 4.0, np.nan]])
    np.testing.assert_array_equal(_nan_mean(table), [2.0, np.inf, 4.0, np.nan])


def with_said(result: BenchResult, agent: str, shares: list[float], diagnostics: list[dict[str, float]]) -> BenchResult:
    """The result, in which each seed of an agent always succeeds in a given share of tests and says something."""
    values = iter(zip(shares, diagnostics, strict=True))
    runs = []
    for run in result.runs:
        if run.agent == agent:
            share, said = next(values)
            rows = [
                dataclasses.replace(row, successes=round(share * row.test_episodes), diagnostics=said)
                for row in run.checkpoints
            ]
            run = dataclasses.replace(run, checkpoints=tuple(rows))  # noqa: PLW2901
        runs.append(run)
    return dataclasses.replace(result, runs=tuple(runs))


def test_acceptance_is_the_mean_over_seeds(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle", preset="quick", seeds=(0, 1, 2))
    said = [{"imagination/acceptance_rate": rate} for rate in (0.2, 0.9, 0.4)]
    data = collect(with_said(bench_result(tmp_path, protocol=protocol), "imagination_uncertainty", [0.5] * 3, said))
    assert data.acceptance["imagination_uncertainty"] == pytest.approx(dict.fromkeys(protocol.budgets, 0.5))


def test_the_area_begins_at_the_chance_level(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle", preset="quick", seeds=(0, 1))
    data = collect(with_said(bench_result(tmp_path, protocol=protocol), "dqn", [1.0, 1.0], [{}, {}]))
    chance, first = data.facts.chance_level, protocol.budgets[0]
    assert 0.0 < chance < 0.2
    assert data.areas["dqn"][first].value == pytest.approx((chance + 1.0) / 2.0)
    last = protocol.budgets[-1]
    assert data.areas["dqn"][last].value == pytest.approx(1.0 - (1.0 - chance) / 2.0 * first / last)
