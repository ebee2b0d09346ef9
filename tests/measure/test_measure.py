"""The measurements of ``make speed`` and of the intervals: they measure."""

from __future__ import annotations

import json
from pathlib import Path

import coverage
import numpy as np
import pytest
import speed

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError

DRAWS = 150


def test_intervals_hold_on_kept_scores() -> None:
    found = list(coverage.measure(coverage.populations(coverage.RESULTS)[:40], DRAWS, np.random.default_rng(0)))
    assert len(found) == len(coverage.STUCK) * len(coverage.SEEDS)
    assert np.mean([kept["coverage"] for kept in found]) > 0.93, "of 1,200 intervals"
    assert np.mean([kept["false_table"] for kept in found]) < 0.05, "of 1,200 tables"


def test_rates_are_kept_and_nothing_to_draw_from_is_said(tmp_path: Path) -> None:
    coverage.main(2, out=tmp_path / "new" / "coverage.json")
    kept = json.loads((tmp_path / "new" / "coverage.json").read_text())
    assert len(kept["rows"]) == len(coverage.SEEDS) * len(coverage.STUCK) and kept["draws"] == 2
    with pytest.raises(InvalidValueError, match="no learner has five seeds; give a folder of kept results"):
        coverage.populations(tmp_path)


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
