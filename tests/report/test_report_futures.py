"""What the report says of sampled futures and sampled rollouts: the result's numbers, and only where there are any."""

from __future__ import annotations

import csv
import dataclasses
import textwrap
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result, compared_rollout
from PIL import Image

from imagine_bench import registry
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.filmstrips import changes, sampled_filmstrips
from imagine_bench.protocols.control import Protocol
from imagine_bench.report import write_report
from imagine_bench.report.data import collect
from imagine_bench.store.results import BenchResult, Futures, RunResult

DEPTH, PAIRS = 5, 8


def futures(spec: TaskSpec, rng: np.random.Generator) -> Futures:
    """Made up: eight pairs, one of them with a missing outcome at depth 2, half of them over after one macro-action."""
    states = np.array(spec.rules.states[: PAIRS // spec.n_actions])
    missed = np.zeros((DEPTH, PAIRS))
    missed[1, 3] = 1.0
    survival_probability = np.ones((DEPTH, PAIRS))
    survival_probability[1:, ::2] = 0.0
    return Futures(
        macrostates=states.repeat(spec.n_actions, axis=0),
        actions=np.tile(np.arange(spec.n_actions), len(states)),
        samples=np.array(400),
        total_variation=rng.uniform(0.0, 0.2, (DEPTH, PAIRS)),
        sampling_noise_floor=np.where(np.arange(PAIRS) == 2, 0.01, 0.0) * np.ones((DEPTH, 1)),
        missed=missed,
        hallucinated=np.zeros((DEPTH, PAIRS)),
        reward_error=rng.uniform(0.0, 0.2, (DEPTH, PAIRS)),
        termination_error=rng.uniform(0.0, 0.1, (DEPTH, PAIRS)),
        survival_probability=survival_probability,
    )


def with_chance(run: RunResult, spec: TaskSpec) -> RunResult:
    rng = np.random.default_rng(run.seed)
    if run.agent == "dqn":
        return run
    compared = compared_rollout(rng, depth=2)
    states = np.array([[0, 1, 0, 2], [0, 0, 0, 2]])
    inside = dataclasses.replace(compared.rollout, macrostates=states, actions=np.array([1, 1]))
    compared = dataclasses.replace(compared, rollout=inside, start_macrostate=np.array([0, 0, 0, 1]))
    rows = tuple(dataclasses.replace(row, futures=futures(spec, rng)) for row in run.checkpoints)
    return dataclasses.replace(run, checkpoints=rows, imagined=(compared,), sampled_rollouts=(compared,) * 3)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    agents = ("dqn", "imagination_only")
    protocol = Protocol(task="pick_place", preset="quick", agents=agents, seeds=(0, 1), budgets=(500, 1000))
    plain = bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol)
    spec = registry.task("pick_place")
    return dataclasses.replace(plain, runs=tuple(with_chance(run, spec) for run in plain.runs))


@pytest.fixture(scope="module")
def folder(result: BenchResult) -> Path:
    return write_report(result).parent


def test_the_summary_is_the_mean_over_pairs_and_seeds(result: BenchResult) -> None:
    data = collect(result)
    assert list(data.futures) == ["imagination_only"]
    summary = data.futures["imagination_only"]
    last = [run.checkpoints[-1].futures for run in result.of("imagination_only")]
    tables = np.stack([each.total_variation for each in last if each is not None])  # [seeds, D, P]
    assert summary.total_variation == pytest.approx(tables.mean(axis=(0, 2)))
    assert summary.where_random == pytest.approx(tables[:, :, 2].mean(axis=0))
    assert summary.while_alive[0] == pytest.approx(summary.total_variation[0])
    assert summary.while_alive[1:] == pytest.approx(tables[:, 1:, 1::2].mean(axis=(0, 2)))
    assert summary.missed.tolist() == [0.0, 1.0, 0.0, 0.0, 0.0]
    assert (summary.pairs, summary.samples) == (PAIRS, 400)
    assert list(summary.by_budget) == [500, 1000]
    assert summary.by_budget[1000] == pytest.approx((summary.total_variation[0], summary.total_variation[-1]))


def test_every_beginning_is_in_the_table(result: BenchResult, folder: Path) -> None:
    with (folder / "futures.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * DEPTH * PAIRS  # seeds, budgets
    row = rows[-1]
    last = result.of("imagination_only")[-1].checkpoints[-1].futures
    assert last is not None
    assert (row["agent"], row["seed"], row["episodes"], row["depth"]) == ("imagination_only", "1", "1000", "5")
    assert (row["gesture"], row["action"], row["samples"]) == ("middle", "hand over", "400")
    assert float(row["total_variation"]) == pytest.approx(last.total_variation[-1, -1], rel=1e-5)


def test_page_and_markdown_show_figure_numbers_and_courses(result: BenchResult, folder: Path) -> None:
    page, markdown = (folder / "index.html").read_text(), (folder / "report.md").read_text()
    first = f"{collect(result).futures['imagination_only'].total_variation[0]:.3g}"
    assert f'data-futures="total_variation">{first}</td>' in page
    assert f"| total variation | {first} |" in markdown
    for name in ("futures.png", "sampled_rollouts_imagination_only.png"):
        with Image.open(folder / name) as picture:
            assert picture.width > 300
        assert name in markdown
    assert "One start, several futures" in page


def test_the_values_of_futures_are_not_clipped(result: BenchResult) -> None:
    """Each value that changes is written in full: where all change, the image gets more lines."""
    spec = registry.task("pick_place")
    (compared,) = result.of("imagination_only")[0].imagined
    few = sampled_filmstrips((compared,) * 2, spec)
    start = np.array([0, 0, 0, 0])
    other = np.array([len(values) - 1 for values in spec.macrostate_values])
    rollout = dataclasses.replace(compared.rollout, macrostates=np.stack([other, start]))
    many = sampled_filmstrips((dataclasses.replace(compared, start_macrostate=start, rollout=rollout),) * 2, spec)
    words = textwrap.wrap(changes(start, other, spec), width=20)
    assert len(words) > 4 and many.shape[0] > few.shape[0] and many.shape[1] == few.shape[1]
    row = (many.shape[0] - 24) // 2
    last_line = many[12 + row - 14 - 12 - 14 : 12 + row - 14, 150:]  # above the gap to the second row
    assert (last_line != 255).any()


def test_chapter_3_is_quoted_without_a_standard_deviation(folder: Path) -> None:
    page = (folder / "index.html").read_text()
    assert "<small>thesis 98.0</small>" in page
    assert "<small>thesis 78.0</small>" in page
    assert "mean of 10 runs, 100 test episodes each" in page


def test_a_bench_without_chance_says_nothing_of_it(tmp_path: Path) -> None:
    plain = write_report(bench_result(tmp_path)).parent
    assert not (plain / "futures.csv").exists()
    assert "several futures" not in (plain / "index.html").read_text()
