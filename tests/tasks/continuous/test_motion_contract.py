"""The contract of every environment of continuous control: checkers of libraries, and limits that are told."""

from __future__ import annotations

import re
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from imagine_bench.tasks.continuous.controls import WORKSPACE_HIGH_M, WORKSPACE_LOW_M
from imagine_bench.tasks.continuous.spec import make_arrows, make_pick_place
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD

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


@pytest.mark.parametrize(("rate_hz", "images"), [(25, 25), (125, 125), (62.5, 62), (12.5, 12), (5, 5)])
def test_videos_have_as_many_images_a_second_as_commands(rate_hz: float, images: int) -> None:
    """Of single environments and of lanes, for what records or plays images in simulated time."""
    options = {"rate_hz": rate_hz, "observation": "proprio", "render_mode": "rgb_array"}
    one = gymnasium.make("imagine_bench/ArrowPuzzleEasyMotion-v0", **options)
    many = gymnasium.make_vec("imagine_bench/ArrowPuzzleEasyMotion-vector-v0", num_envs=1, **options)
    assert [env.metadata["render_fps"] for env in (one, many)] == [images] * 2


@pytest.mark.parametrize(
    ("control", "action", "periods", "limit"),
    [
        ("twist", [0.0] * 7, 5, ""),
        ("joint_delta", [*[0.5] * 7, 1], 2, ""),
        ("joint", [*OBSERVATION_QPOS_RAD, 1], 5, ""),
        ("pose", [0.62, 0, 0.2, 0, 1, 0, 0, 1], 5, ""),
        *(("twist", [*side, 0, 0, 0, 1], 28, "workspace") for side in 0.5 * np.array([*np.eye(3)[1:], *-np.eye(3)])),
        ("twist", [0, 0, 0, 1, 0, 0, 1], 25, "reach"),  # the hand tips over until a joint is at the end of its range
        ("pose", [0.90, 0.45, 0.45, 0, 1, 0, 0, 1], 60, "reach"),  # too far for a hand that points down there
        ("pose", [0.90, 0.45, -0.08, 0, 1, 0, 0, 1], 1, "reach"),  # further than the joints go in a period
        ("joint", [3, 0, 0, 0, 0, 0, 0, 1], 1, "reach"),
        ("joint_delta", [1, 0, 0, 0, 0, 0, 0, 1], 60, "reach"),
    ],
)
def test_a_command_that_meets_a_limit_is_clipped_and_names_it(
    control: str, action: list[float], periods: int, limit: str
) -> None:
    env = make_arrows(control=control, observation="proprio")
    env.reset(seed=0)
    limits = [str(env.step(np.array(action, dtype=np.float32))[-1]["limited"]) for _ in range(periods)]
    assert limits[-1] == limit
    assert set(limits) <= {"", limit}
    joints_rad = env.servo_targets()[:7]
    assert (joints_rad == joints_rad.clip(*env.model.jnt_range[:7].T)).all()
    if limit == "workspace":
        axis = int(np.flatnonzero(action[:3])[0])
        side_m = (WORKSPACE_HIGH_M if action[axis] > 0 else WORKSPACE_LOW_M)[axis]
        assert limits[0] == ""
        assert env.hand_target_m()[axis] == pytest.approx(side_m, abs=2e-3)


def test_an_episode_lasts_three_seconds_for_each_macro_action() -> None:
    usual = {"observation": "proprio", "physics": {"plan_error_mm": 0.0, "sense": "true"}}
    envs = make_arrows(horizon=4, **usual), make_pick_place(**usual)
    assert [env.time_limit_s for env in envs] == [12.0, 150.0]
