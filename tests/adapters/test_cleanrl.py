"""A loop like CleanRL's on our vector environment: it reads the end of an episode as it was."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from imagine_bench import registry
from imagine_bench.adapters.cleanrl import as_cleanrl

ARROWS = "imagine_bench/ArrowPuzzle-v0"
LANES = 3


def collected(envs, total_timesteps, seed=1):
    """The acting half of ``cleanrl/dqn.py``: the contents of its buffer, by column, and the episodes it would print.

    With each of these what its last info says of where it ended.
    """
    rng = np.random.default_rng(seed)
    stored = []
    printed = []
    obs, _ = envs.reset(seed=seed)
    for global_step in range(total_timesteps):
        explores = rng.random() < 0.8
        actions = rng.integers(6, size=envs.num_envs) if explores else np.full(envs.num_envs, global_step % 2)
        next_obs, rewards, terminations, truncations, infos = envs.step(actions)
        over = terminations | truncations
        ended = infos.get("final_info", [None] * envs.num_envs)
        assert [info is not None for info in ended] == over.tolist()
        assert np.array_equal(infos.get("_final_observation", np.zeros(envs.num_envs)), over)
        assert not {"final_obs", "_final_obs", "episode", "_episode"} & set(infos)
        episodes = [(info["episode"], info.get("macrostate", info.get("at"))) for info in ended if info]
        printed += [(global_step, each["r"].item(), each["l"].item(), at.tolist()) for each, at in episodes]
        real_next_obs = next_obs.copy()
        for idx in np.flatnonzero(truncations):
            real_next_obs[idx] = infos["final_observation"][idx]
        stored.append((obs, real_next_obs, actions, rewards, terminations))
        obs = next_obs
    envs.close()
    return [np.stack(column) for column in zip(*stored, strict=True)], printed


class _Numbered(gym.Wrapper):
    """Cut after three steps; every observation says how many steps the episode has had."""

    def reset(self, **kwargs):
        self.at = 0
        return self.seen(self.env.reset(**kwargs)[0]), {"at": np.int64(0)}

    def step(self, action):
        self.at += 1
        return self.seen(self.env.step(action)[0]), 1.0, False, self.at == 3, {"at": np.int64(self.at)}

    def seen(self, frame):
        return np.full_like(frame, self.at)


def test_equals_single_environments_with_gymnasiums_statistics():
    def thunk():
        return gym.wrappers.RecordEpisodeStatistics(gym.make(ARROWS, execution="kinematic"))

    sync = gym.vector.SyncVectorEnv([thunk] * LANES, autoreset_mode=AutoresetMode.SAME_STEP)
    own = as_cleanrl(registry.vector_id(ARROWS), num_envs=LANES, execution="kinematic")
    ours, printed = collected(own, 40)
    theirs, said = collected(as_cleanrl(sync), 40)
    assert printed == said and all(np.array_equal(*columns) for columns in zip(ours, theirs, strict=True))
    lanes = [env.length_queue for env in sync.envs]
    assert len(printed) > 10 and sum(length for *_, length, _ in printed) == sum(map(sum, lanes)) > 100


def test_the_last_frame_of_a_truncated_episode_is_stored():
    lanes = [lambda: _Numbered(gym.make(ARROWS, execution="kinematic"))] * 2
    sync = gym.vector.SyncVectorEnv(lanes, autoreset_mode=AutoresetMode.SAME_STEP)
    (seen, seen_next, *_), printed = collected(as_cleanrl(sync), 6)
    assert seen[:, 0].max(axis=(1, 2, 3)).tolist() == [0, 1, 2, 0, 1, 2]
    assert seen_next[:, 1].max(axis=(1, 2, 3)).tolist() == [1, 2, 3, 1, 2, 3]
    assert printed == [(2, 3.0, 3, 3), (2, 3.0, 3, 3), (5, 3.0, 3, 3), (5, 3.0, 3, 3)]
