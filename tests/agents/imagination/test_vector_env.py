"""The learned world as an environment: with the true rules it is the task, and the filter cuts it."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from counting_model import RuledModel, ruled
from fake_latents import CODES, built, frame, live
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination.agent import ImaginingAgent
from imagine_bench.agents.imagination.vector_env import ImaginedEnv, ImaginedVectorEnv, imagined_env
from same_values import assert_same

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import State

TASK = registry.task("arrow_puzzle")
RULES = TASK.rules
PAIRS = [(state, action) for state in RULES.start_states for action in range(TASK.n_actions)]


def puzzle(
    num_envs: int = 4, horizon: int = 10, uncertain: tuple[tuple[State, int], ...] = (), filtered: bool = True
) -> ImaginedVectorEnv:
    """The arrow puzzle as imagined by a model that is right."""
    imagination = ruled(TASK, filtered=filtered, uncertain=uncertain)
    starts = RuledModel(TASK).encode(RULES.start_states).numpy()
    return ImaginedVectorEnv(imagination, starts, num_envs=num_envs, horizon=horizon)


def read(observations: Any) -> list[State]:
    return RuledModel(TASK).decode(torch.as_tensor(np.stack(observations)))


def test_with_the_true_rules_every_transition_is_theirs() -> None:
    env = puzzle(num_envs=500, horizon=4)
    rng = np.random.default_rng(0)
    before, _ = env.reset(seed=0)
    seen = set()
    ends = set()
    age = np.zeros(500, dtype=int)
    for _ in range(8):
        actions = rng.integers(TASK.n_actions, size=500)
        after, rewards, terminated, truncated, info = env.step(actions)
        ended = terminated | truncated
        age += 1
        reached = read([info["final_obs"][i] if ended[i] else after[i] for i in range(500)])
        for pair, *found in zip(
            zip(read(before), actions.tolist(), strict=True), reached, rewards, terminated, strict=True
        ):
            (rule,) = RULES.outcomes(*pair)
            assert found == [rule.macrostate, rule.reward, rule.terminated]
            seen.add(pair)
        assert (truncated == ((age == 4) & ~terminated)).all()
        ends |= set(zip(terminated.tolist(), truncated.tolist(), strict=True))
        assert info["accepted"].all() and not info["epistemic"].any()
        assert set(read(after[ended])) <= set(RULES.start_states)
        age[ended] = 0
        before = after
    assert seen == set(PAIRS)
    assert ends == {(False, False), (True, False), (False, True)}


@pytest.mark.parametrize("filtered", [True, False])
def test_a_discarded_transition_is_cut_and_not_shown(filtered: bool) -> None:
    """Half of the transitions that end nothing are uncertain."""
    uncertain = tuple(pair for pair in PAIRS if not RULES.outcomes(*pair)[0].terminated)[::2]
    env = puzzle(num_envs=400, uncertain=uncertain, filtered=filtered)
    before, _ = env.reset(seed=1)
    shown = before.copy()
    actions = np.random.default_rng(1).integers(TASK.n_actions, size=400)
    after, rewards, terminated, truncated, info = env.step(actions)
    assert np.array_equal(before, shown), "an observation given is not written over"
    torn = np.array([pair in uncertain for pair in zip(read(before), actions.tolist(), strict=True)])
    assert ((info["epistemic"] > 0.3) == torn).all()
    assert not terminated[torn].any() and terminated[~torn].any()
    cut = torn & filtered
    for marked in (~info["accepted"], truncated, rewards == 0.0):
        assert (marked == cut).all()
    assert info["_final_info"].tolist() == (terminated | truncated).tolist()
    for index in np.flatnonzero(cut):
        assert np.array_equal(info["final_obs"][index], before[index])
        assert not info["final_info"]["accepted"][index]
    assert set(read([*after[cut], before[0]])) <= set(RULES.start_states)


@pytest.fixture(scope="module")
def trained() -> ImaginingAgent:
    agent = built(imagination_agents.make_uncertainty)
    live(agent, range(8), np.random.default_rng(0))
    return agent


def test_a_trained_agent_gives_its_world_and_starts(trained: ImaginingAgent) -> None:
    known, _ = imagined_env(trained, num_envs=300).reset(seed=0)
    acted_in = {tuple(row) for row in trained.real.arrays()["mu"].tolist()}
    assert {tuple(row) for row in known.tolist()} == acted_in
    given = imagined_env(trained, frames=np.stack([frame(9), frame(9)]), num_envs=3)
    assert np.array_equal(given.reset(seed=0)[0], CODES[[9, 9, 9]].numpy())


def test_a_learned_world_is_the_same_by_seed_and_a_copy_goes_on_alike(trained: ImaginingAgent) -> None:
    env = imagined_env(trained, num_envs=5, horizon=3)

    def walk(of: ImaginedVectorEnv) -> list[Any]:
        return [list(of.step(np.array([0, 1, 2, 0, 1]))) for _ in range(8)]

    env.reset(seed=3)
    first, twins = walk(env), [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    onward = walk(env)
    for twin in twins:
        assert_same(onward, walk(twin))
    twin.reset(seed=3)
    assert_same(first, walk(twin))
    assert not np.array_equal(first[0][0], onward[0][0])


def test_bad_input_is_refused() -> None:
    still = np.zeros(4, np.int64)
    env = puzzle()
    one = ImaginedEnv(puzzle(num_envs=1))
    one.reset(seed=0)
    wrong: dict[str, Callable[[], object]] = {
        r"shape \(P, 15\)": lambda: ImaginedVectorEnv(ruled(TASK), np.zeros((3, 4), np.float32)),
        "num_envs is 0; give an integer from 1 on": lambda: puzzle(num_envs=0),
        "horizon is 'x'; give an integer from 1 on": lambda: puzzle(horizon="x"),  # type: ignore[arg-type]
        "seed is -1; give an integer from 0 on": lambda: env.reset(seed=-1),
        "imagined episodes take none": lambda: env.reset(options={"macrostate": (0, 1, 2, 0)}),
        "call reset before step": lambda: env.step(still),
        r"6\]\): give one integer in \[0, 6\) for each of 4": lambda: (env.reset(seed=0), env.step(still + 6)),
        r"\[0, 1.7, 0, 0\]: give one integer": lambda: env.step([0, 1.7, 0, 0]),  # type: ignore[arg-type]
        "nan.*: give one integer": lambda: env.step(np.full(4, np.nan)),  # type: ignore[arg-type]
        "True.*: give one integer": lambda: one.step(True),  # type: ignore[arg-type]
    }
    for words, do in wrong.items():
        with pytest.raises(InvalidValueError, match=words):
            do()
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
