"""Distances of imagined from exact outcomes, and how the truth advances: by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from imagine_bench.interfaces import Outcome, State
from imagine_bench.judge.truth import (
    expected_reward,
    hallucinated_modes,
    missed_modes,
    sampling_noise_floor,
    squared_distance,
    total_variation,
)
from imagine_bench.rules import advance

HALVES = {(1,): 0.5, (2,): 0.5}
THREE = {(1,): 0.5, (2,): 0.3, (3,): 0.2}


@pytest.mark.parametrize(
    ("exact", "imagined", "away", "missed", "hallucinated"),
    [
        (HALVES, HALVES, 0.0, 0, 0),
        (HALVES, {(1,): 0.5, (3,): 0.25, (4,): 0.25}, 0.5, 1, 2),
        (HALVES, {(9,): 1.0}, 1.0, 2, 1),
        (HALVES, {(-1,): 1.0}, 1.0, 2, 0),  # an image of nothing is no macrostate
        (HALVES, {(1,): 0.89, (2,): 0.11}, 0.39, 0, 0),  # 0.11 is just above a fifth of 0.5
        (HALVES, {(1,): 0.91, (2,): 0.09}, 0.41, 1, 0),
        (HALVES, {(1,): 0.48, (2,): 0.48, (3,): 0.04}, 0.04, 0, 0),  # below the least of a mode
        (THREE, {(1,): 1.0}, 0.5, 2, 0),
        ({(1,): 0.95, (2,): 0.05}, {(1,): 0.95, (3,): 0.05}, 0.05, 1, 1),  # just a mode
        (HALVES, {(1,): 0.9, (2,): 0.1}, 0.4, 0, 0),  # just a fifth of 0.5
    ],
)
def test_distances_are_those_computed_by_hand(
    exact: dict[State, float], imagined: dict[State, float], away: float, missed: int, hallucinated: int
) -> None:
    assert total_variation(exact, imagined) == pytest.approx(away)
    assert (missed_modes(exact, imagined), hallucinated_modes(exact, imagined)) == (missed, hallucinated)


def test_the_sampling_floor_is_what_samples_of_the_truth_show() -> None:
    shares = np.random.default_rng(0).multinomial(50, list(THREE.values()), size=20_000) / 50
    distance = 0.5 * np.abs(shares - np.array(list(THREE.values()))).sum(axis=1)
    assert sampling_noise_floor(THREE, 50) == pytest.approx(distance.mean(), rel=0.01)
    assert sampling_noise_floor({(1,): 1.0}, 50) == 0.0
    assert sampling_noise_floor(THREE, 0) == 0.0, "a model that gives probabilities draws nothing"


@pytest.mark.parametrize("drawn", [2, 3, 5])
@pytest.mark.parametrize("model", [THREE, HALVES, {(1,): 0.1, (4,): 0.9}])
def test_the_squared_distance_of_samples_is_unbiased(model: dict[State, float], drawn: int) -> None:
    """Every sequence of futures, with its probability: unbiased for any model and number of futures."""
    exact = squared_distance(THREE, model)
    assert exact == pytest.approx(sum((THREE.get(key, 0.0) - model.get(key, 0.0)) ** 2 for key in THREE | model))
    mean = 0.0
    for futures in itertools.product(model, repeat=drawn):
        held = {key: futures.count(key) / drawn for key in futures}
        mean += math.prod(model[key] for key in futures) * squared_distance(THREE, held, drawn)
    assert mean == pytest.approx(exact, abs=1e-12)
    assert math.isnan(squared_distance(THREE, {(1,): 1.0}, drawn=1)), "one future says nothing of the others"


class Toss:
    """From state 0, one in four wins and ends; a won state stays, and would pay again."""

    def outcomes(self, state: State, action: int) -> tuple[Outcome, ...]:
        if state == (1,):
            return (Outcome(1.0, (1,), 5.0, terminated=True, success=True),)
        win = Outcome(0.25, (1,), 2.0, terminated=True, success=True)
        return win, Outcome(0.75, (2,), -1.0, terminated=False, success=False)


def test_the_truth_advances_by_hand() -> None:
    """Dynamics go on after the end, and rewards stop."""
    before = {((0,), False): (0.5, 0.0), ((1,), True): (0.5, 0.0)}
    after = advance(Toss(), before, 0)  # type: ignore[arg-type]
    assert set(after) == {((1,), True), ((2,), False)}
    assert after[(1,), True] == pytest.approx((0.625, 0.125 * 2.0 / 0.625))
    assert after[(2,), False] == pytest.approx((0.375, -1.0))
    assert expected_reward(after) == pytest.approx(0.125 * 2.0 - 0.375)
    over = advance(Toss(), {((0,), True): (1.0, 7.0)}, 0)  # type: ignore[arg-type]
    assert over == {((1,), True): (0.25, 0.0), ((2,), True): (0.75, 0.0)}, "also where the dynamics lead back"
