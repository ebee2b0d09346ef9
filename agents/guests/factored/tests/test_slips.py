"""Actions that fail by chance: all that do teach how often, and only where that is so."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from imagine_bench_factored.dynamics import Dynamics
from imagine_bench_factored.factors import CodeTransition
from imagine_bench_factored.model import FactoredModel
from imagine_bench_factored.planner import Planner
from imagine_bench_factored.settings import DynamicsSettings, FactoredSettings

WHEELS, SIZES, ACTIONS = 3, (4, 4, 4), 6


def turned(code: tuple[int, ...], action: int) -> tuple[int, ...]:
    """Each wheel is turned on by one action, and back by another."""
    wheel, back = divmod(action, 2)
    following = list(code)
    following[wheel] = (following[wheel] + (-1 if back else 1)) % 4
    return tuple(following)


def away(settings: DynamicsSettings, slip: float, seed: int, transitions: int) -> tuple[float, float]:
    """Mean total variation between learned and true chances after so many transitions; how often any slipped."""
    dynamics, rng = Dynamics(SIZES, ACTIONS, settings), np.random.default_rng(seed)
    slips = 0
    for index in range(transitions):
        code, action = tuple(rng.integers(4, size=WHEELS).tolist()), index % ACTIONS
        following = code if rng.random() < slip else turned(code, action)
        dynamics.add(np.array(code), action, np.array(following))
        slips += following == code
    codes = list(itertools.product(range(4), repeat=WHEELS))
    parts = [part.expected for part in dynamics.predict(np.array(codes))]
    found = []
    for (row, code), action in itertools.product(enumerate(codes), range(ACTIONS)):
        held = np.einsum("i,j,k->ijk", *(part[row, action] for part in parts))
        exact = np.zeros(SIZES)
        exact[turned(code, action)], exact[code] = 1.0 - slip, slip
        found.append(0.5 * np.abs(held - exact).sum())
    return float(np.mean(found)), slips / transitions


@pytest.mark.parametrize(("slip", "transitions"), [(0.0, 200), (0.1, 120), (0.2, 200)])
def test_how_often_actions_slip_is_learned_from_all_of_them(slip: float, transitions: int) -> None:
    apart = dataclasses.replace(DynamicsSettings(), alike=1e-9)
    pooled, alone = ([away(each, slip, seed, transitions) for seed in range(5)] for each in (DynamicsSettings(), apart))
    luck = np.mean([abs(slipped - slip) for _, slipped in pooled])
    assert np.mean([tv for tv, _ in pooled]) < luck + 0.03, "little more than the luck of the draw"
    assert np.mean([tv for tv, _ in alone]) > 0.09 or slip == 0.0, "rows that are learned apart need more"


def test_an_action_that_fails_at_a_wall_alone_is_not_thought_to_slip() -> None:
    """Steps to the right in a corridor of five places, whose last is its end."""
    dynamics, rng = Dynamics((5, 2), 1, DynamicsSettings()), np.random.default_rng(0)
    for _ in range(40):
        place, lamp = int(rng.integers(5)), int(rng.integers(2))
        dynamics.add(np.array([place, lamp]), 0, np.array([min(place + 1, 4), lamp]))
    expected = dynamics.predict(np.array([[place, 0] for place in range(5)]))[0].expected[:, 0]
    assert expected[4, 4] > 0.97 and min(expected[place, place + 1] for place in range(4)) > 0.97
    weight = dynamics.factors[0].weights()[0]
    assert weight[2 + len(dynamics.factors[0].parents) :].sum() < 0.01


def novelty(least_unknown: float, times: int) -> float:
    """Of a lamp that is drawn anew at every step, after each action was tried so often in each code."""
    settings = FactoredSettings(dynamics=DynamicsSettings(least_unknown=least_unknown))
    model, rng = FactoredModel((3, 2), 2, settings), np.random.default_rng(0)
    codes = list(itertools.product(range(3), range(2)))
    for _, (lamp, place), action in itertools.product(range(times), codes, range(2)):
        won = (lamp, place, action) == (2, 1, 0)
        drawn = (int(rng.integers(3)), place ^ action)
        model.add(CodeTransition((lamp, place), action, drawn, float(won), won))
    model.outcomes.fit()
    planner = Planner(model, settings.planning)
    return max(planner.values(code, "novelty").max() for code in codes)


def test_exploration_rests_once_only_chance_is_left() -> None:
    default, threshold = DynamicsSettings().least_unknown, FactoredSettings().planning.exploration_threshold
    assert novelty(default, 2) > threshold, "two draws of a lamp say little"
    assert novelty(default, 5) < threshold < novelty(0.0, 5), "of chance there is always more to learn"
