"""The score: 0 at chance, 1 at the optimum, linear between, and intervals that know of seeds and of tests."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from imagine_bench import statistics
from imagine_bench.store.results import OpenLoop
from imagine_bench.sweep.score import Scale, auroc, score

SCALES = (Scale(chance=0.1, optimum=0.9), Scale(chance=0.5, optimum=1.0))


def _row(share):
    """The results of an agent that is so far on its way in every level."""
    return [scale.chance + share * (scale.optimum - scale.chance) for scale in SCALES]


def test_the_interval_over_seeds_is_that_of_their_means():
    shares = [0.2, 0.4, 0.9, 0.5, 0.5, 0.5, 0.5]
    found = score(np.array([_row(share) for share in shares]), SCALES)
    assert found.value == pytest.approx(0.5)
    assert (found.low, found.high) == pytest.approx(statistics.interval(shares, trim=0.0))
    few = score(np.array([_row(share) for share in shares[1:]]), SCALES, trials=100)
    assert math.isnan(few.low) and math.isnan(few.high), "the tests alone would not know of the seeds"


def test_tests_alone_make_an_interval_that_covers():
    """Of one seed: 95 % of intervals hold the true score, within four standard errors."""
    rng, trials, share, runs = np.random.default_rng(0), 50, 0.6, 2_000
    p = np.array(_row(share))
    covered = 0
    for _ in range(runs):
        found = score(rng.binomial(trials, p)[None] / trials, SCALES, trials=trials)
        covered += found.low <= share <= found.high
    assert abs(covered / runs - 0.95) < 4 * math.sqrt(0.95 * 0.05 / runs) + 0.01


def test_tests_of_all_seeds_widen_an_interval():
    """Of 7 seeds of 10 tests each, which agree; shares are those of Agresti and Coull, with two more of each kind."""
    found = score(np.tile([0.5, 0.8], (7, 1)), SCALES, trials=10)
    first, second = ((70 * share + 2) / 74 for share in (0.5, 0.8))
    variance = (first * (1 - first) / 70 / 0.8**2 + second * (1 - second) / 70 / 0.5**2) / 2**2
    assert found.value == pytest.approx((0.4 / 0.8 + 0.3 / 0.5) / 2)
    assert (found.high - found.value, found.value - found.low) == pytest.approx((1.959964 * math.sqrt(variance),) * 2)


def test_a_level_without_values_is_left_out():
    rows = np.array([_row(0.3), _row(0.5)])
    rows[:, 1] = math.nan
    assert score(rows, SCALES).value == pytest.approx(0.4)
    assert math.isnan(score(np.full((2, 2), math.nan), SCALES).value)


def _open_loop(auroc_by_depth, judged):
    ones = np.ones(len(judged))
    fields = dict.fromkeys(OpenLoop.__dataclass_fields__, ones)
    return OpenLoop(**{**fields, "auroc_epistemic": np.array(auroc_by_depth), "judged": np.array(judged)})


def test_depths_count_by_what_could_be_wrong_there():
    assert auroc(_open_loop([0.9, 0.6, math.nan], [30.0, 10.0, 5.0])) == pytest.approx((0.9 * 30 + 0.6 * 10) / 40)
    assert math.isnan(auroc(_open_loop([math.nan], [9.0])))
    assert auroc(None) == 0.5


def test_the_kept_scores_follow_from_the_kept_levels():
    folder = Path(__file__).parents[2] / "docs" / "results" / "suite"
    levels, scores = (
        list(csv.DictReader((folder / name).read_text().splitlines())) for name in ("levels.csv", "scores.csv")
    )
    trials = json.loads((folder / "suite.json").read_text())["suite"]["evaluation_episodes"]
    for kept in scores:
        rows = [row for row in levels if (row["experiment"], row["agent"]) == (kept["experiment"], kept["agent"])]
        names = list(dict.fromkeys(row["level"] for row in rows))
        values = np.array([[float(row["value"] or "nan") for row in rows if row["level"] == name] for name in names]).T
        ends = {row["level"]: Scale(chance=float(row["chance"]), optimum=float(row["optimum"])) for row in rows}
        found = score(values, list(ends.values()), trials=None if kept["experiment"] == "uncertainty" else trials)
        assert found[:3] == pytest.approx(
            [float(kept[name] or "nan") for name in ("score", "low_95", "high_95")], nan_ok=True
        )
