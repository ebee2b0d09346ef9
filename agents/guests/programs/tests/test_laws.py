"""Laws: the shortest that explain transitions, and their writer's experience beside the cautious learner's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from imagine_bench_programs.__main__ import written
from imagine_bench_programs.laws import Laws, Row, ends_of, simplest
from imagine_bench_programs.writer import Writer

from imagine_bench import registry
from imagine_bench.exact.certificate import certificate
from imagine_bench.sweep.grid import LADDER

KEPT = Path(__file__).parents[4] / "docs" / "results" / "programs" / "written.json"


@pytest.mark.parametrize(
    ("came", "failed", "chance"),
    [(0, 0, 1.0), (5, 0, 1.0), (0, 5, 0.0), (80, 20, 0.8), (83, 17, 0.8), (9_500, 500, 0.95)],
)
def test_a_probability_has_as_few_decimals_as_counts_allow(came: int, failed: int, chance: float) -> None:
    assert simplest(came, failed)[0] == pytest.approx(chance)


def row(now: tuple[int, ...], then: tuple[int, ...], action: int = 0, reward: float = 0.0, ended: bool = False) -> Row:
    return Row(now, action, then, reward, ended)


def test_a_step_round_the_circle_is_shorter_than_a_table() -> None:
    laws = Laws((4,), 1, [row((value,), (value + 1,)) for value in range(3)])
    assert laws.turned((3,), 0) == (0,), "a value that was never seen turns as the others do"


def test_a_precondition_is_found_where_nothing_shorter_explains() -> None:
    rows = [
        row((a, b, c), ((a + 1) % 3 if b == 1 and c == 0 else a, b, c))
        for a in range(3)
        for b in (0, 1)
        for c in (0, 1)
    ]
    laws = Laws((3, 2, 2), 1, rows)
    assert all(laws.turned(each.now, 0) == each.then for each in rows)
    (law,) = laws.effects[0]
    assert {(test.place, test.value) for test in law.tests} == {(1, 1), (2, 0)}


def test_a_factor_that_changes_whatever_is_done_drifts() -> None:
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(300):
        now = int(rng.integers(3))
        then = (now + int(rng.integers(1, 3))) % 3 if rng.random() < 0.2 else now
        rows.append(row((now,), (then,), action=int(rng.integers(4))))
    laws = Laws((3,), 4, rows)
    assert laws.drifts == {0: pytest.approx(0.2)} and not any(laws.effects)
    assert sum(each.probability for each in laws.outcomes((0,), 1)) == pytest.approx(1.0)


def test_ends_say_two_equal_values_in_one_condition() -> None:
    rows = [row((a, b), (a, b), reward=-float(a == b), ended=a == b) for a in range(4) for b in range(4)]
    alike, usual = ends_of(rows, (4, 4), 1)
    assert (len(alike.tests), alike.tests[0].alike, alike.reward, alike.ended) == (1, True, -1.0, True)
    assert usual.tests == () and not usual.ended


def test_unseen_values_teach_nothing() -> None:
    writer = Writer((2, 2), 2, np.random.default_rng(0))
    writer.learn(row((0, -1), (1, -1)))
    writer.write()
    assert writer.laws.count == 0


@pytest.mark.parametrize(
    "name",
    [
        "arrow_puzzle",
        pytest.param("arrows:slip=0.2", marks=pytest.mark.slow),
        pytest.param("arrows:horizon=5,gesture=first", marks=pytest.mark.slow),
    ],
)
def test_the_writer_is_exact_after_twice_the_cautious_learners_experience(name: str) -> None:
    spec = registry.task(name)
    cost = certificate(spec).floor
    assert cost is not None
    assert written(spec, int(2 * cost.transitions), seed=7)["total_variation"] < 0.005


def test_kept_programs_are_exact_in_at_least_nine_of_the_twelve_experiments() -> None:
    rows = json.loads(KEPT.read_text())["rows"]
    assert all(each["macro_actions"] <= 2 * each["learner"] for each in rows)
    exact = {}
    for experiment in LADDER.experiments:
        of_levels = [each for level in experiment.levels for each in rows if each["task"] == level.task]
        exact[experiment.name] = bool(of_levels) and np.mean([each["total_variation"] for each in of_levels]) < 0.005
    assert sum(exact.values()) >= 9 and not exact["delay"], "frames that are late show no law"
