"""Stable-Baselines3 in imagined worlds: it learns the task there, and meets real and imagined episodes in turn."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from counting_model import RuledModel, ruled
from fake_latents import ACTIONS, CODES, built, frame
from gymnasium.utils.env_checker import check_env
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination.vector_env import ImaginedEnv, ImaginedVectorEnv

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import State

sb3 = pytest.importorskip("stable_baselines3")
TASK = registry.task("arrow_puzzle")


def puzzle(horizon: int = 10, uncertain: tuple[tuple[State, int], ...] = ()) -> ImaginedEnv:
    """The arrow puzzle as imagined by a model that is right, except where it is uncertain."""
    starts = RuledModel(TASK).encode(TASK.rules.start_states).numpy()
    return ImaginedEnv(ImaginedVectorEnv(ruled(TASK, uncertain=uncertain), starts, horizon=horizon))


def test_one_imagined_episode_ends_as_in_the_vector() -> None:
    check_env(puzzle(), skip_render_check=True)
    uncertain = tuple((state, 0) for state in TASK.rules.start_states)
    env = puzzle(2, uncertain)
    world = puzzle(2, uncertain).world
    assert np.array_equal(env.reset(seed=3)[0], world.reset(seed=3)[0][0])
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(60):
        action = rng.integers(TASK.n_actions)
        seen, reward, terminated, truncated, info = env.step(action)
        after, rewards, ends, cuts, told = world.step(np.array([action]))
        ended = terminated or truncated
        assert np.array_equal(seen, told["final_obs"][0] if ended else after[0])
        assert (reward, terminated, truncated, info["accepted"]) == (rewards[0], ends[0], cuts[0], told["accepted"][0])
        kinds.add((terminated, truncated, info["accepted"]))
        if ended:
            assert np.array_equal(env.reset()[0], world.reset()[0][0])
    assert kinds == {(False, False, True), (True, False, True), (False, True, True), (False, True, False)}
    with pytest.raises(InvalidValueError, match="has 2 episodes side by side; give one of num_envs 1"):
        ImaginedEnv(ImaginedVectorEnv(ruled(TASK), RuledModel(TASK).encode(TASK.rules.states).numpy(), num_envs=2))


def success_rate(model: Any) -> float:
    """Of the greedy policy, from every start, by the rules."""
    code = RuledModel(TASK)
    solved = 0
    for start in TASK.rules.start_states:
        state: State = start
        for _ in range(TASK.horizon):
            action, _ = model.predict(code.encode([state])[0].numpy(), deterministic=True)
            (outcome,) = TASK.rules.outcomes(state, int(action))
            state = outcome.macrostate
            if outcome.terminated:
                solved += outcome.success
                break
    return solved / len(TASK.rules.start_states)


@pytest.mark.slow
def test_dqn_that_only_imagines_the_true_rules_solves_the_task() -> None:
    model = sb3.DQN(
        "MlpPolicy", puzzle(), learning_rate=1e-3, gamma=0.95, learning_starts=200, train_freq=1, gradient_steps=1,
        target_update_interval=500, exploration_fraction=0.5, buffer_size=20_000, seed=0, device="cpu",
    )  # fmt: skip
    untrained = success_rate(model)
    model.learn(12_000)
    assert untrained < 0.2 and success_rate(model) > 10 * TASK.facts().chance_level


class Ring(gymnasium.Env[Any, Any]):
    """Two steps around a ring of six states, as in :func:`fake_latents.live`."""

    observation_space = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(ACTIONS)
    state = steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = int(self.np_random.integers(6))
        self.steps = 0
        return frame(self.state), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.state = (self.state + int(action)) % 6
        self.steps = self.steps + 1
        over = self.steps == 2
        found = self.state == 0
        return frame(self.state), float(found), over and found, over and not found, {"is_success": found}


def test_imagined_episodes_follow_real_ones_once_they_may() -> None:
    from imagine_bench_peers.mixed_experience import MixedExperience

    overrides = {"imagination.start_episode": 2, "imagination.depth": 3}
    learner = built(imagination_agents.make_uncertainty, overrides)
    env = MixedExperience(Ring(), learner, count=3, seed=1)
    rng = np.random.default_rng(0)
    kinds = ""
    real = 0
    ends = set[tuple[bool, bool]]()
    states = {tuple(row) for row in CODES[:6].tolist()}
    for episode in range(14):
        before, _ = env.reset(seed=None if episode else 0)
        assert tuple(before.tolist()) in states, "imagined ones too begin where it acted"
        over = False
        length = 0
        while not over:
            action = int(rng.integers(ACTIONS))
            seen, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            length = length + 1
            if not info["imagined"]:
                real += 1
                rows = learner.real.arrays()
                assert tuple(seen.tolist()) in states and np.array_equal(rows["next_mu"][-1], seen)
                assert np.array_equal(rows["mu"][-1], before)
                assert (rows["action"][-1], rows["reward"][-1], rows["terminated"][-1]) == (action, reward, terminated)
                ends |= {(terminated, truncated)}
            before = seen
        kinds += "i" if info["imagined"] else "r"
        assert length == 2 if kinds[-1] == "r" else length <= 3
    assert kinds == "r" + "riii" * 3 + "r" and ends == {(False, False), (True, False), (False, True)}
    assert learner.real.added == real == 10 and learner.updates == 10 * 2, "imagined ones teach the model nothing"
    assert 0.0 <= learner.meters.read()["imagination/acceptance_rate"] <= 1.0


@pytest.mark.parametrize(("quantile", "least", "most"), [(None, 1.0, 1.0), (0.5, 0.2, 0.8), (0.0, 0.0, 0.2)])
def test_the_filter_follows_a_quantile_of_real_transitions(quantile: float | None, least: float, most: float) -> None:
    from imagine_bench_peers.mixed_experience import MixedExperience

    moving = {"imagination.threshold": 99.0, "imagination.threshold_quantile": quantile}
    learner = built(imagination_agents.make_uncertainty, {"imagination.depth": 1, **moving})
    env = MixedExperience(Ring(), learner, count=20, seed=1)
    rng = np.random.default_rng(0)
    accepted = []
    for episode in range(100):
        env.reset(seed=None if episode else 0)
        over = False
        while not over:
            _, _, terminated, truncated, info = env.step(int(rng.integers(ACTIONS)))
            over = terminated or truncated
        if info["imagined"]:
            accepted.append(info["accepted"])
    assert len(accepted) > 80 and least <= np.mean(accepted) <= most
