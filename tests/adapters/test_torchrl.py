"""Rollouts by TorchRL are those of the environments themselves."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torchrl import envs

from imagine_bench import registry
from imagine_bench.adapters.torchrl import NumericInfo

ARROWS = "imagine_bench/ArrowPuzzle-v0"
KINEMATIC = {"execution": "kinematic"}


def test_infos_are_numbers_and_all_else_is_as_before():
    plain = gymnasium.make(ARROWS, **KINEMATIC)
    numeric = NumericInfo(gymnasium.make(ARROWS, **KINEMATIC))
    for one, other in ((plain.reset(seed=0), numeric.reset(seed=0)), (plain.step(1), numeric.step(1))):
        assert np.array_equal(one[0], other[0]) and one[1:-1] == other[1:-1]
        assert set(one[-1]) - set(other[-1]) == {"fault_reason"}
    plain.close()
    numeric.close()


def test_a_rollout_with_infos_is_our_episodes():
    env = envs.GymWrapper(NumericInfo(gymnasium.make(ARROWS, **KINEMATIC))).auto_register_info_dict()
    envs.check_env_specs(env)
    env.set_seed(0)
    walked = env.rollout(60, break_when_any_done=False)
    rules, ended = registry.task("arrow_puzzle").rules, 0
    assert walked.batch_size == (60,)
    for step in range(60):
        state, reached = walked[step]["macrostate"], walked[step]["next", "macrostate"]
        action = int(walked[step]["action"].argmax())
        possible = {outcome.macrostate: outcome for outcome in rules.outcomes(tuple(state.tolist()), action)}
        outcome = possible[tuple(reached.tolist())]
        assert walked[step]["next", "reward"].item() == pytest.approx(outcome.reward)
        assert walked[step]["next", "terminated"].item() == outcome.terminated
        ended += outcome.terminated
    assert ended > 5
    env.close()


def test_a_vector_environment_is_rolled_out_as_single_ones():
    make = registry.vector_id(ARROWS)
    env = envs.GymWrapper(gymnasium.make_vec(make, num_envs=3, autoreset_mode="Disabled", **KINEMATIC))
    envs.check_env_specs(env)
    walked = env.rollout(40, break_when_any_done=False)
    assert walked.batch_size == (3, 40) and walked["next", "done"].sum() > 10
    goes_on = ~walked["next", "done"][:, :-1, 0]
    after, before = walked["next", "observation"][:, :-1], walked["observation"][:, 1:]
    assert torch.equal(after[goes_on], before[goes_on])
    env.close()
