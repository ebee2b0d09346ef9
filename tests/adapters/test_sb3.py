"""The vector environment as Stable-Baselines3's ``VecEnv``, beside its own ``DummyVecEnv`` of single environments."""

from __future__ import annotations

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import NormalizeObservation
from same_values import assert_same
from stable_baselines3.common.vec_env import DummyVecEnv

from imagine_bench import registry
from imagine_bench.adapters.cleanrl import as_cleanrl
from imagine_bench.adapters.sb3 import as_sb3
from imagine_bench.errors import InvalidValueError

ARROWS = "imagine_bench/ArrowPuzzle-vector-v0"
KINEMATIC = {"execution": "kinematic"}


def both(task="arrow_puzzle", n=3, **options):
    env_id = registry.TASKS[task].env_id
    ours = as_sb3(registry.vector_id(env_id), num_envs=n, **options)
    return ours, DummyVecEnv([lambda: gymnasium.make(env_id, **options)] * n)


@pytest.mark.parametrize(
    ("task", "steps", "options"),
    [
        ("arrow_puzzle", 40, KINEMATIC),
        ("pick_place", 20, KINEMATIC),
        ("arrow_puzzle", 8, {"execution": "physics"}),
        ("arrow_puzzle", 20, {**KINEMATIC, "observation": "frame,state"}),
        ("arrow_puzzle", 9, {**KINEMATIC, "max_episode_steps": 1}),  # some end by rule in the very last macro-action
    ],
)
def test_equals_their_own_step_for_step(task, steps, options):
    ours, theirs = both(task, **options)
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    assert ours.seed(7) == theirs.seed(7)
    assert_same(ours.reset(), dict(theirs.reset()) if "observation" in options else theirs.reset())
    assert_same(ours.reset_infos, theirs.reset_infos)
    rng, ended, cut = np.random.default_rng(0), 0, 0
    for step in range(steps):
        actions = np.full(3, step % 2) if step >= steps // 2 else rng.integers(ours.action_space.n, size=3)
        own, its = ours.step(actions), theirs.step(actions)
        for one, other in zip(own, its, strict=True):
            assert_same(one, dict(other) if isinstance(other, dict) else other)
        assert_same(ours.reset_infos, theirs.reset_infos)
        cut += sum(info["TimeLimit.truncated"] for info in own[3])
        ended += sum("terminal_observation" in info for info in own[3])
    assert ended > cut and (cut > 0 or options != KINEMATIC or task != "arrow_puzzle"), "non-vacuous"
    ours.close()
    theirs.close()


def test_options_attributes_methods_and_images_are_the_lanes():
    ours, theirs = both(render_mode="rgb_array", width=32, height=24, **KINEMATIC)
    starts = [{"macrostate": state} for state in registry.task("arrow_puzzle").rules.start_states[:3]]
    for options in (starts, starts[0], None, starts):
        for env in (ours, theirs):
            env.seed(3)
            env.set_options(options)
            env.set_attr("capture_motion_hz", 5.0, 1)
        assert_same(ours.reset(), theirs.reset())
        assert_same(ours.reset_infos, theirs.reset_infos)
    assert_same(ours.reset(), theirs.reset())  # seeds and options are taken once
    assert ours.get_attr("capture_motion_hz") == [0.0, 5.0, 0.0]
    assert_same(ours.env_method("action_masks"), theirs.env_method("action_masks"))
    assert_same(ours.render(), theirs.render())
    ours.close()
    theirs.close()


@pytest.mark.parametrize("adapted", [as_sb3, as_cleanrl])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_of_adapted_lanes_play_on(copied, adapted):
    env = adapted(ARROWS, num_envs=2, **KINEMATIC)
    env.reset()
    twin = copied(env)
    for action in (0, 0, 0, 0):
        *expected, _ = env.step(np.full(2, action))
        *found, _ = twin.step(np.full(2, action))
        assert_same(found, expected)
    env.close()
    twin.close()


def test_gymnasium_normalises_lanes_that_reset_at_the_next_step():
    env = NormalizeObservation(gymnasium.make_vec(ARROWS, num_envs=2, autoreset_mode="NextStep", **KINEMATIC))
    assert env.reset(seed=0)[0].shape == (2, 64, 64, 3)
    env.close()


def test_what_cannot_be_is_one_clear_error():
    with pytest.raises(InvalidValueError, match=r"give an environment with AutoresetMode\.SAME_STEP"):
        as_sb3(ARROWS, num_envs=1, autoreset_mode=AutoresetMode.NEXT_STEP)
    env = gymnasium.make_vec(ARROWS, num_envs=1, **KINEMATIC)
    with pytest.raises(InvalidValueError, match="belong to gymnasium"):
        as_sb3(env, execution="physics")
    env.close()
