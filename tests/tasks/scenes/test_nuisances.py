"""Nuisances change frames and rewards alone, and are a part of states, lanes and datasets."""

from __future__ import annotations

import copy
import pickle

import gymnasium
import numpy as np

import imagine_bench  # noqa: F401  (registers the environments)
from imagine_bench import registry
from imagine_bench.data.folder import read_dataset, write_dataset
from imagine_bench.running.collect import collect, policy_of

START = (0, 1, 2, 1)


def make(given, task="ArrowPuzzle", **options):
    return gymnasium.make(
        f"imagine_bench/{task}-v0", execution="kinematic", appearance=given, disable_env_checker=True, **options
    )


def test_truth_stays_as_it_is():
    """Macrostates, ends and legal states are those without nuisances; so chance and optimum are, too."""
    walks = []
    for given in ("clean", "harsh"):
        with make(given) as env:
            env.reset(seed=5, options={"macrostate": START})
            steps = [env.step(action)[2:] for action in (0, 1)]
            walks.append([(*step[:2], *step[2]["macrostate"].tolist(), bool(step[2]["legal"])) for step in steps])
    assert walks[0] == walks[1]


def test_states_copies_and_pickles_go_on_to_the_bit():
    with make("harsh") as env:
        env.reset(seed=1, options={"macrostate": START})
        env.step(0)
        state = pickle.loads(pickle.dumps(env.unwrapped.get_state()))
        twin = copy.deepcopy(env)
        walks = [[each.step(action)[:2] for action in (1, 0)] for each in (env, twin)]
        env.unwrapped.set_state(state)
        walks.append([env.step(action)[:2] for action in (1, 0)])
    for walk in walks:
        np.testing.assert_equal(walk, walks[0])
        assert walk[-1][1] != round(walk[-1][1])


def test_lanes_equal_single_environments():
    lanes = gymnasium.make_vec(
        "imagine_bench/ArrowPuzzle-vector-v0", num_envs=2, execution="kinematic", appearance="harsh"
    )
    seen, _ = lanes.reset(seed=4)
    after = lanes.step(np.array([0, 3]))
    for lane, action in enumerate((0, 3)):
        with make("harsh") as env:
            assert np.array_equal(env.reset(seed=4 + lane)[0], seen[lane])
            assert env.step(action)[1] == after[1][lane]
    lanes.close()


def test_a_dataset_holds_noisy_rewards_and_frames(tmp_path):
    spec = registry.task("arrow_puzzle")
    policy = policy_of("random", spec, 1)
    episodes, apart, card = collect(spec, policy, episodes=3, seed=1, execution="kinematic", appearance="harsh")
    dataset = read_dataset(write_dataset(tmp_path / "data", episodes, apart, card, "npz").folder)
    assert np.array_equal(dataset.episodes.frames, episodes.frames)
    assert all(reward != round(reward) for reward in dataset.episodes.rewards.tolist())
