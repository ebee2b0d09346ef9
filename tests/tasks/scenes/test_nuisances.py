"""Nuisances change frames and rewards alone, and are a part of datasets."""

from __future__ import annotations

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


def test_a_dataset_holds_noisy_rewards_and_frames(tmp_path):
    spec = registry.task("arrow_puzzle")
    policy = policy_of("random", spec, 1)
    episodes, apart, card = collect(spec, policy, episodes=3, seed=1, execution="kinematic", appearance="harsh")
    dataset = read_dataset(write_dataset(tmp_path / "data", episodes, apart, card, "npz").folder)
    assert np.array_equal(dataset.episodes.frames, episodes.frames)
    assert all(reward != round(reward) for reward in dataset.episodes.rewards.tolist())
