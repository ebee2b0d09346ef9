"""Rollouts by TorchRL are those of the environments themselves; no adapter is needed."""

from __future__ import annotations

import gymnasium
import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import GymEnv, GymWrapper, check_env_specs, default_info_dict_reader

from imagine_bench import registry

ARROWS = "imagine_bench/ArrowPuzzle-v0"
KINEMATIC = {"execution": "kinematic"}


def test_a_rollout_with_infos_is_our_episodes():
    specs = {"macrostate": Unbounded(4, dtype=torch.int64), "is_success": Unbounded((), dtype=torch.bool)}
    env = GymWrapper(gymnasium.make(ARROWS, **KINEMATIC))
    env.set_info_dict_reader(default_info_dict_reader(list(specs), specs))
    check_env_specs(env)
    env.set_seed(0)
    walked = env.rollout(60, break_when_any_done=False)
    rules = registry.task("arrow_puzzle").rules
    ended = 0
    assert walked.batch_size == (60,)
    for step in range(60):
        state = walked[step]["macrostate"]
        reached = walked[step]["next", "macrostate"]
        action = int(walked[step]["action"].argmax())
        possible = {outcome.macrostate: outcome for outcome in rules.outcomes(tuple(state.tolist()), action)}
        outcome = possible[tuple(reached.tolist())]
        assert walked[step]["next", "reward"].item() == pytest.approx(outcome.reward)
        assert walked[step]["next", "terminated"].item() == outcome.terminated
        ended += outcome.terminated
    assert ended > 5
    env.close()


def test_an_id_alone_makes_the_environment():
    """TorchRL first asks for a keyword that we do not know, and takes a TypeError alone for an answer."""
    env = GymEnv(ARROWS, **KINEMATIC)
    assert env.rollout(3, break_when_any_done=False).batch_size == (3,)
    env.close()
