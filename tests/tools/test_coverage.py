"""The simulation that judges intervals and tests: it draws from what was kept, and a broken interval falls."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from imagine_bench import statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.tools.coverage import SEEDS, STUCK, coverage_report, measure, populations

RESULTS = Path(__file__).parents[2] / "docs" / "results"
DRAWS = 150


def test_intervals_hold_on_kept_scores() -> None:
    found = list(measure(populations(RESULTS)[:40], DRAWS, np.random.default_rng(0)))
    assert [(kept.stuck, kept.seeds) for kept in found] == [(stuck, seeds) for stuck in STUCK for seeds in SEEDS]
    assert np.mean([kept.coverage for kept in found]) > 0.93, "of 1,200 intervals"
    assert np.mean([kept.false_table for kept in found]) < 0.05, "of 1,200 tables"


def test_a_bootstrap_of_few_seeds_would_fall(monkeypatch: pytest.MonkeyPatch) -> None:
    def percentiles(scores: np.ndarray, *, trials: int) -> tuple[float, float]:
        draw = np.random.default_rng(1)
        means = scores[draw.integers(len(scores), size=(200, len(scores)))].mean(axis=1)
        return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))

    monkeypatch.setattr(statistics, "interval", percentiles)
    monkeypatch.setattr("imagine_bench.tools.coverage.SEEDS", (3,))
    found = list(measure(populations(RESULTS)[:40], DRAWS, np.random.default_rng(0)))
    assert max(kept.coverage for kept in found) < 0.85


def test_rates_are_shown_and_kept(tmp_path: Path) -> None:
    lines: list[str] = []
    coverage_report(RESULTS, tmp_path / "new" / "coverage.json", 2, lines.append)
    kept = json.loads((tmp_path / "new" / "coverage.json").read_text())
    assert len(kept["rows"]) == len(SEEDS) * len(STUCK) == len(lines) - 2
    assert kept["environment"]["command"] and kept["draws"] == 2


def test_nothing_to_draw_from_is_said(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="no learner has five seeds; give a folder of kept results"):
        coverage_report(tmp_path, tmp_path / "coverage.json", 2)
    with pytest.raises(InvalidValueError, match="draws is 0; give at least 1"):
        coverage_report(RESULTS, tmp_path / "coverage.json", 0)
