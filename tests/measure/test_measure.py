"""The measurements of ``make speed`` and of the intervals: they measure, and a broken interval falls."""

from __future__ import annotations

import json
from pathlib import Path

import coverage
import numpy as np
import pytest
import speed

from imagine_bench import registry, statistics
from imagine_bench.errors import InvalidValueError

DRAWS = 150


@pytest.fixture(scope="module")
def populations() -> list[np.ndarray]:
    return coverage.populations(coverage.RESULTS)[:40]


def test_intervals_hold_on_kept_scores(populations: list[np.ndarray]) -> None:
    found = list(coverage.measure(populations, DRAWS, np.random.default_rng(0)))
    assert len(found) == len(coverage.STUCK) * len(coverage.SEEDS)
    assert np.mean([kept["coverage"] for kept in found]) > 0.93, "of 1,200 intervals"
    assert np.mean([kept["false_table"] for kept in found]) < 0.05, "of 1,200 tables"


def test_a_bootstrap_of_few_seeds_would_fall(monkeypatch: pytest.MonkeyPatch, populations: list[np.ndarray]) -> None:
    def percentiles(scores: np.ndarray, *, trials: int) -> tuple[float, float]:
        draw = np.random.default_rng(1)
        means = scores[draw.integers(len(scores), size=(200, len(scores)))].mean(axis=1)
        return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))

    monkeypatch.setattr(statistics, "interval", percentiles)
    monkeypatch.setattr(coverage, "SEEDS", (3,))
    found = list(coverage.measure(populations, DRAWS, np.random.default_rng(0)))
    assert max(kept["coverage"] for kept in found) < 0.85


def test_rates_are_kept_and_nothing_to_draw_from_is_said(tmp_path: Path) -> None:
    coverage.main(2, out=tmp_path / "new" / "coverage.json")
    kept = json.loads((tmp_path / "new" / "coverage.json").read_text())
    assert len(kept["rows"]) == len(coverage.SEEDS) * len(coverage.STUCK) and kept["draws"] == 2
    with pytest.raises(InvalidValueError, match="no learner has five seeds; give a folder of kept results"):
        coverage.populations(tmp_path)


def test_lanes_are_timed_beside_one_environment_and_threads() -> None:
    gain, threads = speed.lanes_gain(registry.task("arrow_puzzle"), "kinematic", 3, 12, blocks=1)
    assert 0.05 < gain < 20 and 0.3 < threads < 3


def test_a_frame_costs_little_more_than_mujocos_drawing_alone() -> None:
    frame, step = speed.drawing(registry.task("arrow_puzzle"))
    assert frame.met and step.met
    assert " against " in frame.measured and frame.measured.endswith("CPU ms)")


@pytest.mark.slow
def test_every_ratio_is_measured_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "OUT", tmp_path / "deep" / "speed.json")
    failed = speed.main()
    kept = json.loads(speed.OUT.read_text())
    assert kept["environment"]["versions"]["mujoco"]
    assert failed == (not all(figure["met"] for figure in kept["figures"]))
    assert sum("gain of 16 lanes" in figure["what"] for figure in kept["figures"]) == 4
