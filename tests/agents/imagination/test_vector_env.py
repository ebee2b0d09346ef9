"""The learned world as an environment: with the true rules it is the task, and the filter cuts it."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from counting_model import RuledModel, ruled
from fake_latents import CODES, context, frame, live
from gymnasium.utils.performance import benchmark_vector_step
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination.vector_env import ImaginedVectorEnv, imagined_env

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import State

TASK = registry.task("arrow_puzzle")
ENDS = (False, True)


def puzzle(
    num_envs: int = 4, horizon: int = 10, uncertain: tuple[tuple[State, int], ...] = (), filtered: bool = True
) -> ImaginedVectorEnv:
    """The arrow puzzle as imagined by a model that is right."""
    imagination = ruled(TASK, filtered=filtered, uncertain=uncertain)
    return ImaginedVectorEnv(imagination, pool(), num_envs=num_envs, horizon=horizon)


def pool() -> np.ndarray:
    return RuledModel(TASK).encode(TASK.rules.start_states).numpy()


def read(observations: Any) -> list[State]:
    return RuledModel(TASK).decode(torch.as_tensor(np.stack(observations)))


def test_with_the_true_rules_every_transition_is_theirs() -> None:
    env, rng = puzzle(num_envs=500, horizon=4), np.random.default_rng(0)
    before, _ = env.reset(seed=0)
    seen, ends, age = set(), set(), np.zeros(500, dtype=int)
    for _ in range(8):
        actions = rng.integers(TASK.n_actions, size=500)
        after, rewards, terminated, truncated, info = env.step(actions)
        reached = [info["final_obs"][i] if terminated[i] | truncated[i] else after[i] for i in range(500)]
        age += 1
        for i, (state, action, following) in enumerate(zip(read(before), actions.tolist(), read(reached), strict=True)):
            (ruled_so,) = TASK.rules.outcomes(state, action)
            assert (following, rewards[i], terminated[i]) == (ruled_so.macrostate, ruled_so.reward, ruled_so.terminated)
            assert truncated[i] == (age[i] == 4 and not terminated[i])
            seen.add((state, action))
        ended = terminated | truncated
        ends |= set(zip(terminated.tolist(), truncated.tolist(), strict=True))
        assert info["accepted"].all() and not info["epistemic"].any()
        assert set(read(after[ended])) <= set(TASK.rules.start_states)
        age[ended] = 0
        before = after
    assert seen == {(state, action) for state in TASK.rules.start_states for action in range(TASK.n_actions)}
    assert ends == {(False, False), (True, False), (False, True)}


@pytest.mark.parametrize("filtered", [True, False])
def test_what_the_filter_discards_cuts_and_is_not_shown(filtered: bool) -> None:
    """Of each start, one action that ends nothing is uncertain."""
    lasting = [
        (state, action)
        for state in TASK.rules.start_states
        for action in range(TASK.n_actions)
        if not TASK.rules.outcomes(state, action)[0].terminated
    ][::2]
    env, rng = puzzle(num_envs=400, uncertain=tuple(lasting), filtered=filtered), np.random.default_rng(1)
    before, _ = env.reset(seed=1)
    actions = rng.integers(TASK.n_actions, size=400)
    after, rewards, terminated, truncated, info = env.step(actions)
    torn = np.array([pair in lasting for pair in zip(read(before), actions.tolist(), strict=True)])
    assert 0 < torn.sum() < 400
    assert (info["epistemic"][torn] > 0.3).all() and not info["epistemic"][~torn].any()
    assert not terminated[torn].any() and terminated[~torn].any()
    if not filtered:
        assert info["accepted"].all() and not truncated.any()
        return
    assert (info["accepted"] == ~torn).all() and (truncated == torn).all()
    assert (rewards[torn] == 0.0).all() and (rewards[~torn] != 0.0).all()
    assert all(np.array_equal(info["final_obs"][i], before[i]) for i in np.flatnonzero(torn))
    assert (info["final_info"]["accepted"][torn] == False).all()  # noqa: E712
    assert info["_final_info"].tolist() == (terminated | truncated).tolist()
    assert set(read(after[torn])) <= set(TASK.rules.start_states)


def walk(env: ImaginedVectorEnv, seed: int | None) -> list[Any]:
    rng = np.random.default_rng(7)
    found: list[Any] = [env.reset(seed=seed)[0]]
    for _ in range(8):
        step = env.step(rng.integers(env.imagination.model.n_actions, size=env.num_envs))
        found += [*step[:4], step[4]["epistemic"]]
    return found


def test_a_learned_world_is_the_same_by_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    env = imagined_env(trained(monkeypatch), num_envs=5, horizon=3)
    first, onward, again, other = walk(env, 3), walk(env, None), walk(env, 3), walk(env, 4)
    assert all(np.array_equal(one, two) for one, two in zip(first, again, strict=True))
    for another in (onward, other):
        assert not all(np.array_equal(one, two) for one, two in zip(first, another, strict=True))


def trained(monkeypatch: pytest.MonkeyPatch) -> imagination_agents.ImaginingAgent:
    agent = imagination_agents.make_uncertainty(context(monkeypatch))
    live(agent, range(20), np.random.default_rng(0))
    return agent


def test_a_trained_agent_gives_its_world_and_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = trained(monkeypatch)
    remembered = imagined_env(agent, num_envs=300)
    known, _ = remembered.reset(seed=0)
    assert {tuple(row) for row in known} == {tuple(row) for row in CODES[:6].tolist()}, "the walk's six states"
    given = imagined_env(agent, frames=np.stack([frame(9), frame(9)]), num_envs=3)
    assert np.array_equal(given.reset(seed=0)[0], CODES[[9, 9, 9]].numpy())
    *_, info = remembered.step(np.zeros(300, dtype=np.int64))
    agent.imagination.filter.threshold = threshold = float(np.median(info["epistemic"]))
    _, _, _, truncated, info = remembered.step(np.zeros(300, dtype=np.int64))
    assert ((info["epistemic"] <= threshold) == info["accepted"]).all() and truncated[~info["accepted"]].all()
    assert 0 < info["accepted"].sum() < 300
    assert (info["aleatoric"] > 0).all() and (info["modal"] >= 0).all()


def test_gymnasium_knows_it_as_a_vector_environment() -> None:
    env = puzzle()
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    observations, _ = env.reset(seed=0)
    assert env.observation_space.contains(observations) and env.observation_space.shape == (4, 15)
    kept = observations.copy()
    after, rewards, *ends, _ = env.step(np.zeros(4, dtype=np.int64))
    assert np.array_equal(observations, kept), "an observation given is not written over"
    assert env.observation_space.contains(after) and rewards.dtype == np.float64
    assert [end.dtype for end in ends] == [np.bool_, np.bool_]
    assert benchmark_vector_step(env, target_duration=0, seed=0) > 0
    counted = gymnasium.wrappers.vector.RecordEpisodeStatistics(puzzle(horizon=2))
    counted.reset(seed=0)
    rng, lengths = np.random.default_rng(0), set()
    for _ in range(20):
        *_, info = counted.step(rng.integers(6, size=4))
        lengths |= set(info["episode"]["l"][info["_episode"]].tolist()) if "episode" in info else set()
    assert lengths == {1, 2}


@pytest.mark.parametrize(
    ("do", "words"),
    [
        (lambda: puzzle(num_envs=0), "num_envs is 0 and horizon 10; each must be at least 1"),
        (lambda: puzzle(horizon=0), "num_envs is 4 and horizon 0; each"),
        (
            lambda: ImaginedVectorEnv(ruled(TASK), np.zeros((0, 15), np.float32)),
            r"shape \(0, 15\); give at least one of shape",
        ),
        (lambda: ImaginedVectorEnv(ruled(TASK), np.zeros((3, 4), np.float32)), r"shape \(P, 15\)"),
        (lambda: puzzle().step(np.zeros(4, np.int64)), "call reset before step"),
        (lambda: begun().step(np.array([0, 0, 0, 6])), r"Actions \[0 0 0 6\] must be 4 in \[0, 6\)"),
        (lambda: begun().step(np.zeros(3, np.int64)), "must be 4 in"),
    ],
)
def test_bad_input_is_refused(do: Any, words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        do()


def begun() -> ImaginedVectorEnv:
    env = puzzle()
    env.reset(seed=0)
    return env
