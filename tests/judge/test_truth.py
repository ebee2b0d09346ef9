"""Distances of imagined from exact outcomes, and how the truth advances: by hand."""

from __future__ import annotations

import numpy as np
import pytest

from imagine_bench.interfaces import Outcome, State
from imagine_bench.judge.truth import (
    expected_reward,
    hallucinated_modes,
    missed_modes,
    sampling_noise_floor,
    total_variation,
)
from imagine_bench.rules import advance


def test_distances_are_those_computed_by_hand() -> None:
    exact, other = {(1,): 0.5, (2,): 0.5}, {(1,): 0.5, (3,): 0.25, (4,): 0.25}
    assert total_variation(exact, exact) == 0.0
    assert total_variation(exact, other) == pytest.approx(0.5)
    assert total_variation(exact, {(9,): 1.0}) == 1.0
    assert missed_modes(exact, other) == 1
    assert hallucinated_modes(exact, other) == 2
    assert missed_modes(exact, {(1,): 0.89, (2,): 0.11}) == 0, "0.11 is just above a fifth of 0.5"
    assert missed_modes(exact, {(1,): 0.91, (2,): 0.09}) == 1
    assert hallucinated_modes(exact, {(1,): 0.48, (2,): 0.48, (3,): 0.04}) == 0, "below the least of a mode"


def test_a_collapsed_distribution_misses_modes() -> None:
    exact = {(1,): 0.5, (2,): 0.3, (3,): 0.2}
    collapsed = {(1,): 1.0}
    assert total_variation(exact, collapsed) == pytest.approx(0.5)
    assert (missed_modes(exact, collapsed), hallucinated_modes(exact, collapsed)) == (2, 0)


def test_the_sampling_floor_is_what_samples_of_the_truth_show() -> None:
    exact = {(1,): 0.5, (2,): 0.3, (3,): 0.2}
    rng = np.random.default_rng(0)
    shares = rng.multinomial(50, list(exact.values()), size=20_000) / 50
    distance = 0.5 * np.abs(shares - np.array(list(exact.values()))).sum(axis=1)
    assert sampling_noise_floor(exact, 50) == pytest.approx(distance.mean(), rel=0.01)
    assert sampling_noise_floor({(1,): 1.0}, 50) == 0.0


class Toss:
    """From state 0, one in four wins and ends; what was won stays, and would pay again."""

    n_actions = 1

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
