"""Our tasks in stable-worldmodel's ``World``: a policy gets its exact score, and episodes are ours to the bit.

The tests of the real library are skipped without it (``pip install stable-worldmodel imageio opencv-python-headless``).
"""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.arrows.spec import make_limited_env

from imagine_bench import registry
from imagine_bench.adapters.stable_worldmodel import SuccessTerminates
from imagine_bench.errors import InvalidValueError

KINEMATIC = {"execution": "kinematic"}
TASKS = ("arrow_puzzle", "pick_place")
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore::UserWarning")  # of the library's own


@pytest.mark.parametrize("task", TASKS)
def test_only_success_terminates_and_all_else_is_as_before(task):
    plain, inner = (gymnasium.make(registry.TASKS[task].env_id, **KINEMATIC) for _ in range(2))
    wrapped = SuccessTerminates(inner)
    rng = np.random.default_rng(0)
    ends = set()
    for seed in range(40):
        one, other = plain.reset(seed=seed), wrapped.reset(seed=seed)
        over = False
        while not over:
            assert np.array_equal(one[0], other[0]) and one[-1].keys() == other[-1].keys()
            wrapped.unwrapped.np_random.integers(9)  # as the library does
            action = rng.integers(plain.action_space.n)
            one, other = plain.step(action), wrapped.step(action)
            _, reward, terminated, truncated, info = one
            over = terminated or truncated
            assert other[1:4] == (reward, bool(info["success"]), over and not info["success"])
            assert all(not isinstance(value, np.bool_) for value in (*other[2:4], *other[-1].values()))
        ends.add((terminated, other[2]))
    assert ends >= {(True, True), (True, False)}, "non-vacuous"
    plain.close()
    wrapped.close()


def test_a_recorded_macrostate_is_where_an_episode_begins():
    env = SuccessTerminates(gymnasium.make(registry.TASKS["arrow_puzzle"].env_id, render_mode="rgb_array", **KINEMATIC))
    for state in registry.task("arrow_puzzle").rules.start_states[:5]:
        env.reset(seed=0)
        env.unwrapped.start_at(np.array([state]))
        np.testing.assert_array_equal(env.env.unwrapped.world.read().macrostate, state)
        seen, *_ = env.step(0)
        assert np.array_equal(env.render(), seen)
    env.close()


def test_another_environment_is_one_clear_error():
    with pytest.raises(InvalidValueError, match="no task of imagine_bench"):
        SuccessTerminates(gymnasium.make("CartPole-v1"))
    for late in (
        gymnasium.make("imagine_bench/Arrows-v0", lag=1),
        gymnasium.make(registry.task("arrows:lag=1").env_id),
        make_limited_env(lag=1),  # which Gymnasium did not make
    ):
        with pytest.raises(InvalidValueError, match="give a world without lag"):
            SuccessTerminates(late)
        late.close()


@pytest.mark.parametrize("task", TASKS)
def test_a_random_policy_scores_chance_with_the_wrapper(task):
    swm = pytest.importorskip("stable_worldmodel")
    entry, n, level = registry.TASKS[task], 1000, registry.task(task).facts().chance_level
    options = {"num_envs": 4, "image_shape": (64, 64), "max_episode_steps": entry.horizon, **KINEMATIC}
    rates = []
    for wrappers, episodes in ([SuccessTerminates], n), (None, 100):
        world = swm.World(entry.env_id, pre_wrappers=wrappers, **options)
        world.set_policy(swm.policy.RandomPolicy(seed=0))
        rates.append(world.evaluate(episodes=episodes, seed=0)["success_rate"] / 100)
        world.close()
    assert rates[0] == pytest.approx(level, abs=3 * np.sqrt(level * (1 - level) / n))
    assert task != "arrow_puzzle" or rates[1] > 0.95
