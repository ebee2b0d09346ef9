"""Several actions that are carried out at once do as one by one, to the bit."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from by_hand import FAMILIES
from imagine_bench.tasks.continuous.controls import CONTROL_NAMES
from imagine_bench.tasks.continuous.env import MotionEnv, Period
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.continuous.segments import random_episode
from imagine_bench.tasks.continuous.spec import make_arrows

from imagine_bench.arrays import Floats32
from imagine_bench.errors import InvalidValueError


def experts(env: MotionEnv, seed: int, count: int) -> Floats32:
    """Actions of the expert in an episode; every eleventh goes astray, so that objects are pushed."""
    rng = np.random.default_rng(seed)
    env.restart(seed=seed)
    expert = Expert(env)
    actions = []
    over = False
    while len(actions) < count and not over:
        if expert.is_done:
            expert.begin(env.task.rules.optimal_action(env.episode.macrostate))
        drawn = rng.uniform(env.action_space.low, env.action_space.high)
        actions.append(np.asarray(drawn if len(actions) % 11 == 10 else expert.act(), dtype=np.float32))
        _, terminated, truncated, _ = env.act(actions[-1])
        over = terminated or truncated
    return np.stack(actions)


def one_by_one(env: MotionEnv, actions: Floats32) -> list[Period]:
    """The periods of actions, by :meth:`MotionEnv.act`."""
    periods = []
    for action in actions:
        *ends, info = env.act(action)
        reached = tuple(info["macrostate"].tolist()) if info["event"] else None
        periods.append(Period(*ends, bool(info["success"]), reached, info["fault_reason"] or None))
    return periods


@pytest.mark.parametrize("options", [{}, {"reward": "dense", "placement": 0.02, "appearance": "strong"}])
@pytest.mark.parametrize("control", CONTROL_NAMES)
@pytest.mark.parametrize("family", FAMILIES)
def test_actions_at_once_do_as_one_by_one_to_the_bit(family: str, control: str, options: dict[str, Any]) -> None:
    env = FAMILIES[family](control=control, observation="proprio", slip=0.3, **options)
    actions = experts(env, 540, 120)
    assert env.episode.events > 0
    found = []
    for carry_out in (one_by_one, MotionEnv.carry_out):
        env.restart(seed=540)
        found.append((carry_out(env, actions), pickle.dumps(env.get_state()), env.data.xpos.tobytes()))
    assert found[0] == found[1]


def test_a_random_episode_is_of_actions_one_by_one() -> None:
    env = make_arrows(observation="proprio")
    solved = random_episode(env, 1)
    at_once = (env.episode.periods, env.data.qpos.tobytes())
    rng = np.random.default_rng([1, 1])
    env.restart(seed=1)
    over = False
    while not over:
        _, terminated, truncated, info = env.act(rng.uniform(env.action_space.low, env.action_space.high))
        over = terminated or truncated
    assert ((env.episode.periods, env.data.qpos.tobytes()), info["is_success"]) == (at_once, solved)
    assert env.episode.periods > 25


@pytest.mark.parametrize(
    ("time_limit_s", "count"), [(1.0, 25), (1.01, 25), (1.11, 28), (0.01, 1), (0.26, 7), (4.66, 117), (4.7, 118)]
)
def test_nothing_is_carried_out_after_the_end(time_limit_s: float, count: int) -> None:
    """An episode has as many periods as come nearest to its time limit."""
    env = make_arrows(control="joint", observation="proprio", time_limit_s=time_limit_s)
    env.reset(seed=541)
    computed = []
    command = env.controls.command
    env.controls.command = lambda *given: computed.append(0) or command(*given)
    still = np.append(env.servo_targets()[:-1], 1.0).astype(np.float32)
    periods = env.carry_out(np.tile(still, (10_000, 1)))
    assert len(periods) == env.episode.periods == count
    assert len(computed) - count in (0, 1), "the commands of the other 9,900 are not computed"
    assert [each.truncated for each in periods] == [False] * (count - 1) + [True]
    assert env.carry_out(np.tile(still, (3, 1))) == []


def test_actions_are_carried_out_at_once_without_a_time_limit() -> None:
    env = make_arrows(cubes=1, control="joint", observation="proprio", time_limit_s=float("inf"))
    env.reset(seed=541)
    still = np.append(env.servo_targets()[:-1], 1.0).astype(np.float32)
    assert [each.truncated for each in env.carry_out(np.tile(still, (3, 1)))] == [False] * 3


TO_A_POSE = [0.6, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("control", "actions"),
    [
        ("joint", [[0.5] * 8, [np.nan] * 8]),
        ("joint", [[0.5] * 7, [0.5] * 7]),
        ("pose", [TO_A_POSE, [*TO_A_POSE[:3], 0.0, 0.0, 0.0, 0.0, 1.0]]),
    ],
)
def test_a_wrong_action_is_refused_before_anything_moves(control: str, actions: list[list[float]]) -> None:
    env = make_arrows(control=control, observation="proprio")
    env.reset(seed=541)
    before = pickle.dumps(env.get_state())
    with pytest.raises(InvalidValueError, match=r"has another shape or a value that is not finite|quaternion"):
        env.carry_out(np.array(actions))
    assert pickle.dumps(env.get_state()) == before


@pytest.mark.usefixtures("own_folder")
def test_a_blown_up_simulation_has_no_second_event() -> None:
    """What was seen last, an event late, is seen once more."""
    env = make_arrows(control="twist", observation="proprio", lag=1)
    actions = experts(env, 541, 120)
    start, _ = env.reset(seed=541)
    env.carry_out(actions[:-1])
    assert env.step(actions[-1])[4]["event"]
    env.world.data.qpos[env.world.object_qpos[0, 0]] = 1e11
    seen, *_, truncated, info = env.step(np.zeros(7, dtype=np.float32))
    assert np.array_equal(seen, start)
    assert (truncated, bool(info["event"]), info["fault_reason"]) == (True, False, "the simulation blew up")
    with pytest.raises(InvalidValueError, match=r"call reset\(\) first"):
        env.carry_out(actions)
