"""The measurements of ``make speed`` and of the intervals: they measure."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import control_speed
import decisions
import interval_coverage
import numpy as np
import other_mujoco
import pytest
import scipy
import speed
from fake_results import bench_result, rewritten

from imagine_bench import statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Floats
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.control import protocol as default_protocol
from imagine_bench.store.loading import archive_files
from imagine_bench.store.results import Checkpoint, RunResult

DRAWS = 60
CHANCE = 3.0 * (0.05 * 0.95 / DRAWS) ** 0.5  # three standard errors of a rate of 5 %


@pytest.fixture(scope="module")
def scores() -> list[Floats]:
    return interval_coverage.populations(interval_coverage.RESULTS)[:40]


def test_intervals_hold_and_tables_do_not_err_under_any_law(scores: list[Floats]) -> None:
    found = list(interval_coverage.measure(scores, DRAWS, np.random.default_rng(0), seeds=(3, 5, 7)))
    assert len(found) == 3 * (len(interval_coverage.LAWS) + 2)
    for row in found:
        few = [np.isnan(row[name]) for name in ("difference", "false_table")]
        assert few == [row["seeds"] == 3] * 2 and (row["seeds"] == 7 or np.isnan(row["coverage"]))
        assert not row["coverage"] < 0.93 - CHANCE and not row["difference"] < 0.95 - CHANCE, row
        assert not row["false_table"] > 0.05 + CHANCE, row


def test_a_true_gap_of_40_points_is_shown() -> None:
    five, ten, *_ = interval_coverage.power(DRAWS, np.random.default_rng(0), seeds=(5, 10))
    assert five["alone"] > 0.8 and ten["alone"] > 0.95 and ten["table"] > 0.95


def test_looking_again_and_again_claims_no_more() -> None:
    """Headlines of agents of one law; without the allowance two modes would claim too many."""
    for name, runs in decisions.drawn(300, np.random.default_rng(0)).items():
        for bench, looks in decisions.BENCHES.items():
            assert decisions.false_claims(runs, looks) <= 0.05 + CHANCE, (name, bench)
    modes = interval_coverage.LAWS[interval_coverage.WORST](np.random.default_rng(0), (1000, 3, 40))
    looks = range(6, 41, 4)
    assert decisions.false_claims(modes, [dict.fromkeys(decisions.AGENTS, count) for count in looks]) < 0.05
    careless = [statistics.differences(*modes[:, :2, :count].swapaxes(0, 1))[3] < 0.05 for count in looks]
    assert np.any(careless, axis=0).mean() > 0.08


@pytest.mark.parametrize(("gap", "look"), [(80, 0), (12, 1), (0, None)])
def test_a_repetition_is_decided_at_the_look_where_it_shows(tmp_path: Path, gap: int, look: int | None) -> None:
    """Of 21 seeds, two disjoint groups of ten. Agents differ at the last budget of the default bench alone."""
    agents = ("dqn", "dqn_more_updates", "imagination")
    protocol = Protocol(task="arrow_puzzle", preset="quick", agents=agents, seeds=tuple(range(21)), budgets=(400, 500))
    result = bench_result(tmp_path, protocol=protocol)

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        ahead = gap * (run.agent == "imagination") * (row.episodes == 400)
        return dataclasses.replace(row, successes=100 + ahead + run.seed % 7)

    for name, text in archive_files(rewritten(result, change)).items():
        (tmp_path / name).write_text(text)
    looks = [dict.fromkeys(agents, count) for count in (5, 10)]
    found = decisions.repetitions(looks, [tmp_path], 10, np.random.default_rng(0))
    assert [len(found[name]) for name in ("disjoint", "drawn")] == [2, 10]
    assert found["disjoint"] == [look] * 2
    (usual,) = decisions.BENCHES["the default bench"]
    default = default_protocol("arrow_puzzle")
    assert usual == {agent: len(default.seeds_of(agent)) for agent in agents}
    assert len(decisions.BENCHES["--until-decided"]) == 4


def test_a_mistake_of_these_tests_would_be_seen() -> None:
    """Of two groups Yuen's test alone claims a false difference in every third table of six."""
    rng = np.random.default_rng(0)
    a, b = interval_coverage.LAWS[interval_coverage.WORST](rng, (2, 1000, 5))
    yuen = scipy.stats.ttest_ind(a, b, axis=1, equal_var=False, trim=0.25).pvalue
    assert np.mean(yuen < 0.05 / 6) > 0.04
    assert np.mean(statistics.differences(a, b)[3] < 0.05 / 6) < 0.01


def test_exact_tests_of_two_modes_cannot_find_four_in_five() -> None:
    """The most powerful unbiased one, Fisher's with a coin for ties, of fifteen runs each, a quarter against three."""
    runs, found = np.arange(16), 0.0
    low, high = (scipy.stats.binom.pmf(runs, 15, share) for share in (0.25, 0.75))
    for total in range(31):
        first = np.arange(max(0, total - 15), min(15, total) + 1)
        null = scipy.stats.hypergeom.pmf(first, 30, 15, total)
        apart = abs(2 * first - total)
        before = np.array([null[apart > each].sum() for each in apart])
        same = np.array([null[apart == each].sum() for each in apart])
        claimed = ((0.05 - before) / same).clip(0.0, 1.0)
        found += (claimed * low[first] * high[total - first]).sum()
    assert found == pytest.approx(0.796, abs=5e-4)


@pytest.mark.slow
def test_rates_are_kept_and_nothing_to_draw_from_is_said(tmp_path: Path) -> None:
    interval_coverage.main(2, out=tmp_path / "new" / "coverage.json")
    kept = json.loads((tmp_path / "new" / "coverage.json").read_text())
    assert len(kept["rows"]) == len(interval_coverage.SEEDS) * (len(interval_coverage.LAWS) + 2) and kept["draws"] == 2
    assert len(kept["power"]) == len(interval_coverage.SEEDS) * len(interval_coverage.PAIRS)
    with pytest.raises(InvalidValueError, match="no learner has five seeds; give a folder of kept results"):
        interval_coverage.populations(tmp_path)


def test_a_busy_machine_changes_no_ratio_between_suites() -> None:
    """Rounds in which everything takes longer, each by its own factor, give the same figures."""
    rng = np.random.default_rng(0)
    quiet = [{key: measured(suite, rng) for key, suite in control_speed.SUITES.items()}] * 3
    busy = [
        {key: {what: load * value for what, value in row.items()} for key, row in each.items()}
        for each, load in zip(quiet, (1.0, 2.5, 7.0), strict=True)
    ]
    ratios = [[each.measured.split(" (")[0] for each in control_speed.figures(rounds)] for rounds in (quiet, busy)]
    assert ratios[0] == ratios[1] and len(ratios[0]) == 14


def test_ours_is_compared_with_the_fastest_peer_as_it_draws_fastest() -> None:
    rng = np.random.default_rng(0)
    round_ = {key: measured(suite, rng) for key, suite in control_speed.SUITES.items()}
    for peer in control_speed.PEERS:
        one = control_speed.SUITES[peer].one_image
        for kind in (one, one.removesuffix("-plain")):
            faster = {**round_[peer], f"step_s {kind}": 0.02 * round_["ours"][f"step_s {one}"]}
            _, figure, _ = control_speed.beside_peers([{**round_, peer: faster}], "ours")
            assert figure.measured == f"0.0 ({control_speed.SUITES[peer].name})" and not figure.met


def measured(suite: control_speed.Suite, rng: np.random.Generator) -> dict[str, float]:
    """Seconds of steps of a suite, drawn."""
    parts = ("step_s", "own step_s", "own mj_step_s", "own mjr_s")
    return {f"{part} {images}": rng.uniform(1, 2) for part in parts for images in suite.images()}


@pytest.mark.slow
def test_a_control_step_costs_little_more_than_mujoco_alone(tmp_path: Path) -> None:
    kept = tmp_path / "speed.json"
    control_speed.main([str(tmp_path), "--rounds", "1", "--seconds", "0.5", "--only", "ours", "--out", str(kept)])
    found = json.loads(kept.read_text())
    (first,) = found["rounds"]
    for images in control_speed.SUITES["ours"].images():
        step_s, *alone_s = (first["ours"][f"own {part} {images}"] for part in ("step_s", "mj_step_s", "mjr_s"))
        assert step_s < 5.0 * sum(alone_s)
    assert found["memory"]["ours"]["more_mib"] < 20.0


@pytest.mark.slow
def test_every_ratio_is_measured_and_kept(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "speed.json"
    failed = speed.main(out)
    kept = json.loads(out.read_text())
    assert kept["environment"]["versions"]["mujoco"]
    assert failed == (not all(figure["met"] for figure in kept["figures"]))
    assert sum("gain of 16 lanes" in figure["what"] for figure in kept["figures"]) == 4


def test_scores_get_the_noise_of_another_number_of_tests() -> None:
    """The law: variance between agents plus p (1 - p) / tests. Agents between 50 and 70 %, measured with 20 tests."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 0.7, 100_000)
    scores = rng.binomial(20, truth) / 20
    for tests in (20, 400):
        changed = decisions.with_noise_of(tests, scores, 20, rng, 100_000)
        expected = truth.var() + np.mean(truth * (1.0 - truth)) / tests
        assert changed.mean() == pytest.approx(truth.mean(), abs=0.005)
        assert changed.var() == pytest.approx(expected, rel=0.1), tests


def test_two_versions_part_where_more_than_rounding_is_between_them() -> None:
    here = np.zeros((5, 2))
    there = here.copy()
    there[1:, 0] = 1e-16
    assert other_mujoco.parted_by(here, there) is None
    there[2:, 1] = [1e-6, 1e-3, 1.0]
    assert other_mujoco.parted_by(here, there) == 1e-6
    assert other_mujoco.parted_by(here[:2], there) is None, "the shorter path ends before"
