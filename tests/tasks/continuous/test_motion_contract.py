"""The contract of every environment of continuous control: checkers and learners of libraries, limits that are told."""

from __future__ import annotations

import re
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from imagine_bench.tasks.continuous.controls import CONTROL_NAMES, WORKSPACE_HIGH_M
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.segments import random_episode
from imagine_bench.tasks.continuous.spec import make_arrows, make_pick_place

from imagine_bench.arrays import Floats

IDS = sorted(each for each in gymnasium.registry if re.fullmatch(r"imagine_bench/\w+Motion-v0", each))


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_of_gymnasium_and_stable_baselines_are_content(env_id: str) -> None:
    """As it is made by default, with images; any warning fails."""
    library = pytest.importorskip("stable_baselines3.common.env_checker")
    env = gymnasium.make(env_id, render_mode="rgb_array", width=64, height=48)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        library.check_env(env, warn=True)
    env.close()


@pytest.mark.parametrize("control", CONTROL_NAMES)
def test_names_of_an_action_are_one_for_each_number(control: str) -> None:
    env = gymnasium.make("imagine_bench/ArrowPuzzleMotion-v0", control=control, observation="proprio")
    names = env.get_wrapper_attr("control_names")
    assert env.action_space.shape == (len(names),)
    assert len(set(names)) == len(names)
    assert names[-1] == "grip"
    env.close()


@pytest.mark.parametrize("learner", ["SAC", "PPO"])
@pytest.mark.parametrize("name", ["ArrowPuzzle", "PickPlace"])
def test_learners_of_stable_baselines_train_unchanged(name: str, learner: str) -> None:
    """From vectors, beyond the end of an episode."""
    library: Any = pytest.importorskip("stable_baselines3")
    env = gymnasium.make(f"imagine_bench/{name}Motion-v0", observation="proprio,objects", time_limit_s=0.8)
    settings: dict[str, Any] = {"learning_starts": 20} if learner == "SAC" else {"n_steps": 24, "batch_size": 12}
    model = getattr(library, learner)("MultiInputPolicy", env, seed=0, device="cpu", **settings)
    before = [each.clone() for each in model.policy.parameters()]
    model.learn(48)
    assert model.num_timesteps >= 48
    assert len(model.ep_info_buffer) >= 2
    assert any(not now.equal(then) for now, then in zip(model.policy.parameters(), before, strict=True))
    env.close()


def asked(env: MotionEnv, action: Any, periods: int) -> tuple[list[str], Floats]:
    """The limits that an action met in each period from the start of an episode, and the place of the hand's target."""
    env.reset(seed=0)
    limits = [str(env.step(np.array(action, dtype=np.float32))[-1]["limited"]) for _ in range(periods)]
    return limits, env.hand_target_m()


def test_a_command_that_meets_no_limit_names_none() -> None:
    limits, _ = asked(make_arrows(observation="proprio"), np.zeros(7), 5)
    assert limits == [""] * 5
    limits, _ = asked(make_arrows(observation="proprio", control="joint_delta"), [*[0.5] * 7, 1.0], 2)
    assert limits == [""] * 2


def test_a_hand_that_would_leave_the_workspace_stays_and_says_so() -> None:
    limits, target_m = asked(make_arrows(observation="proprio"), [0, 0, 1, 0, 0, 0, 1], 12)
    assert limits[0] == ""
    assert limits[-1] == "workspace"
    assert target_m[2] == pytest.approx(WORKSPACE_HIGH_M[2], abs=2e-3)


@pytest.mark.parametrize(
    ("control", "action", "periods"),
    [
        ("twist", [0, 0, 0, 1, 0, 0, 1], 25),  # the hand tips over until a joint is at the end of its range
        ("pose", [0.90, 0.45, 0.45, 0, 1, 0, 0, 1], 60),  # the arm is too short for a hand that points down there
        ("pose", [0.90, 0.45, -0.08, 0, 1, 0, 0, 1], 1),  # further than the joints go in a period
        ("joint", [3, 0, 0, 0, 0, 0, 0, 1], 1),
        ("joint_delta", [1, 0, 0, 0, 0, 0, 0, 1], 60),
    ],
)
def test_a_target_out_of_reach_is_clipped_and_named(control: str, action: list[float], periods: int) -> None:
    env = make_arrows(control=control, observation="proprio")
    limits, _ = asked(env, action, periods)
    assert limits[-1] == "reach"
    joints_rad = env.servo_targets()[:7]
    assert (joints_rad >= env.model.jnt_range[:7, 0]).all()
    assert (joints_rad <= env.model.jnt_range[:7, 1]).all()


@pytest.mark.parametrize("make", [make_arrows, make_pick_place])
def test_a_random_episode_is_of_actions_one_by_one(make: Any) -> None:
    """Its actions are drawn and carried out several at once, which changes nothing: both ways end at one moment."""
    env = make(observation="proprio")
    for seed in range(2):
        solved = random_episode(env, seed)
        at_once = (env.episode.periods, env.episode.macrostate, env.data.qpos.tobytes())
        rng = np.random.default_rng([seed, 1])
        env.restart(seed=seed)
        over = False
        while not over:
            _, terminated, truncated, info = env.act(rng.uniform(env.action_space.low, env.action_space.high))
            over = terminated or truncated
        assert (env.episode.periods, env.episode.macrostate, env.data.qpos.tobytes()) == at_once
        assert solved == bool(info["is_success"])
        assert env.episode.periods > 25
