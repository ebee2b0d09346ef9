"""Factors that ``factored`` finds in frames of worlds that are hard to see."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from imagine_bench_factored.seeing import appearance


@pytest.mark.parametrize(
    ("world", "sizes"),
    [
        ({"cubes": 6}, [4, 4, 4, 4, 4, 4, 6]),  # fingertips touch the arrows of the first row
        ({"distractors": 4}, [3, 4, 4, 4]),  # the hand stands in front of screens of noise
    ],
)
def test_every_cube_and_the_hand_are_factors_and_nothing_else(world: dict[str, int], sizes: list[int]) -> None:
    rng, frames, begins, actions = np.random.default_rng(2), [], [], []
    with gymnasium.make("imagine_bench/Arrows-v0", execution="kinematic", **world) as env:
        for episode in range(28):
            frames.append(env.reset(seed=2000 + episode)[0])
            begins.append(True)
            ended = False
            while not ended:
                actions.append(int(rng.integers(env.action_space.n)))
                frame, _, terminated, truncated, _ = env.step(actions[-1])
                frames.append(frame)
                begins.append(False)
                ended = terminated or truncated
            actions.append(-1)
    found = appearance.find(np.array(frames), np.array(begins), np.array(actions))
    assert sorted(len(factor.joint) for factor in found) == sizes
