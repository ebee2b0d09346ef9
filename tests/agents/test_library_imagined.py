"""Stable-Baselines3 in imagined worlds: what its loop is told, and that it learns the task there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from counting_model import RuledModel, ruled
from imagine_bench.agents.imagination.vector_env import ImaginedVectorEnv

from imagine_bench import registry
from imagine_bench.interfaces import State

sb3 = pytest.importorskip("stable_baselines3")
TASK = registry.task("arrow_puzzle")


def puzzle(num_envs: int, horizon: int = 10, uncertain: tuple[tuple[State, int], ...] = ()) -> Any:
    from imagine_bench.agents.library.vec_env import SB3VecEnv

    starts = RuledModel(TASK).encode(TASK.rules.start_states).numpy()
    return SB3VecEnv(ImaginedVectorEnv(ruled(TASK, uncertain=uncertain), starts, num_envs=num_envs, horizon=horizon))


def test_the_library_is_told_what_the_environment_says() -> None:
    uncertain = tuple((state, 0) for state in TASK.rules.start_states)
    given, plain = puzzle(50, horizon=2, uncertain=uncertain), puzzle(50, horizon=2, uncertain=uncertain).env
    given.seed(3)
    assert np.array_equal(given.reset(), plain.reset(seed=3)[0])
    assert not np.array_equal(given.reset(), plain.reset(seed=3)[0]), "a seed counts once"
    given.seed(3)
    given.reset()
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(4):
        actions = rng.integers(TASK.n_actions, size=50)
        seen, rewards, done, infos = given.step(actions)
        after, earned, terminated, truncated, info = plain.step(actions)
        assert np.array_equal(seen, after) and np.array_equal(rewards, earned.astype(np.float32))
        assert np.array_equal(done, terminated | truncated)
        for i, own in enumerate(infos):
            assert own["TimeLimit.truncated"] == truncated[i] and own["accepted"] == info["accepted"][i]
            assert ("terminal_observation" in own) == done[i]
            if done[i]:
                assert np.array_equal(own["terminal_observation"], info["final_obs"][i])
            kinds.add((bool(terminated[i]), bool(truncated[i]), bool(own["accepted"])))
    assert kinds == {(False, False, True), (True, False, True), (False, True, True), (False, True, False)}
    given.close()
    assert plain.closed is False and given.env.closed


def success_rate(model: Any) -> float:
    """Of the greedy policy, from every start, by the rules."""
    code, solved = RuledModel(TASK), 0
    for start in TASK.rules.start_states:
        state: State = start
        for _ in range(TASK.horizon):
            action, _ = model.predict(code.encode([state]).numpy(), deterministic=True)
            (outcome,) = TASK.rules.outcomes(state, int(action[0]))
            state = outcome.macrostate
            if outcome.terminated:
                solved += outcome.success
                break
    return solved / len(TASK.rules.start_states)


@pytest.mark.slow
def test_dqn_that_only_imagines_the_true_rules_solves_the_task() -> None:
    model = sb3.DQN(
        "MlpPolicy", puzzle(8), learning_rate=1e-3, gamma=0.95, learning_starts=200, train_freq=1, gradient_steps=4,
        target_update_interval=500, exploration_fraction=0.5, buffer_size=20_000, seed=0, device="cpu",
    )  # fmt: skip
    untrained = success_rate(model)
    model.learn(8_000)
    assert untrained < 0.2 and success_rate(model) > 15 * TASK.facts().chance_level


@pytest.mark.slow
def test_ppo_that_only_imagines_the_true_rules_learns_the_task() -> None:
    model = sb3.PPO(
        "MlpPolicy", puzzle(16), learning_rate=3e-3, n_steps=64, batch_size=128, gamma=0.95, ent_coef=0.5,
        vf_coef=0.05, max_grad_norm=5.0, seed=0, device="cpu",
    )  # fmt: skip
    model.learn(30_000)
    assert success_rate(model) > 10 * TASK.facts().chance_level


@pytest.mark.parametrize("algorithm", ["DQN", "PPO"])
def test_the_same_seed_learns_the_same_in_imagination(algorithm: str) -> None:
    few = {"learning_starts": 8, "buffer_size": 100} if algorithm == "DQN" else {"n_steps": 8, "batch_size": 16}

    def learned() -> dict[str, torch.Tensor]:
        model = getattr(sb3, algorithm)("MlpPolicy", puzzle(2), seed=5, device="cpu", **few)
        before = {name: value.clone() for name, value in model.policy.state_dict().items()}
        model.learn(64)
        after = model.policy.state_dict()
        assert any(not torch.equal(before[name], after[name]) for name in before), "it learned"
        return after

    first, again = learned(), learned()
    assert all(torch.equal(first[name], again[name]) for name in first)
