"""Random network distillation: an observation that was seen often pays little; nothing else changes."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from imagine_bench.seeding import SeedTree

pytest.importorskip("stable_baselines3")
from imagine_bench_peers.novelty import NoveltyBonus
from imagine_bench_peers.sb3_settings import NoveltySettings


class Rooms(gymnasium.Env[Any, Any]):
    """An action leads to the corner of that number, and pays 1 in the first corner."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = gymnasium.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(4, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.eye(4, dtype=np.float32)[action], float(action == 0), False, False, {"corner": action}


def bonuses(actions: list[int], seed: int = 3, **settings: Any) -> list[float]:
    env = NoveltyBonus(Rooms(), NoveltySettings(**settings), SeedTree(seed))
    env.reset()
    return [env.step(action)[4]["novelty"] for action in actions]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_bonus_falls_with_visits_and_a_new_corner_pays_more(seed: int) -> None:
    found = bonuses([0, 1] * 400 + [2, 0], seed)
    early = np.mean(found[20:60])
    assert found[-1] < 0.1 * early
    assert found[-2] > 10.0 * found[-1]
    untaught = bonuses([0, 1] * 400, seed, learning_rate=1e-12)
    assert np.mean(untaught[-40:]) > 0.3 * np.mean(untaught[20:60]), "it falls because the predictor learns"


def test_the_reward_is_the_environments_and_the_weighted_bonus() -> None:
    env = NoveltyBonus(Rooms(), NoveltySettings(weight=0.25), SeedTree(0))
    env.reset()
    for action in (0, 1, 0, 3):
        _, reward, over, cut, info = env.step(action)
        assert reward == pytest.approx((action == 0) + 0.25 * info["novelty"], abs=1e-12)
        assert (over, cut, info["corner"]) == (False, False, action)


def test_the_same_seed_pays_the_same_and_another_seed_does_not() -> None:
    actions = [0, 1, 2, 3] * 10
    assert bonuses(actions) == bonuses(actions) != bonuses(actions, seed=4)


def test_bonuses_are_of_unit_scale_whatever_the_scale_of_errors() -> None:
    """Errors are divided by the deviation of their discounted sum, so a wider network pays no more."""
    narrow = np.mean(bonuses([0, 1, 2, 3] * 40, width=8, learning_rate=1e-12)[80:])
    wide = np.mean(bonuses([0, 1, 2, 3] * 40, width=128, learning_rate=1e-12)[80:])
    assert 0.2 < narrow / wide < 5.0
