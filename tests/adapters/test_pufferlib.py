"""PufferLib's own emulation takes an environment of this suite as it is; no adapter is needed."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

pytest.importorskip("pufferlib", reason="PufferLib cannot be installed beside this project's torch for a CPU")

ACTIONS = np.array([0, 3, 5])


def test_lanes_of_pufferlib_equal_single_environments():
    import pufferlib.emulation
    import pufferlib.vector

    def make():
        return gymnasium.make("imagine_bench:imagine_bench/ArrowPuzzle-v0", execution="kinematic")

    def lane(buf=None, seed=0):
        return pufferlib.emulation.GymnasiumPufferEnv(env_creator=make, buf=buf, seed=seed)

    lanes = pufferlib.vector.make(lane, num_envs=len(ACTIONS), backend=pufferlib.vector.Serial)
    observed, _ = lanes.reset(seed=7)
    singles = [make() for _ in ACTIONS]
    frames = [env.reset(seed=7 + k)[0] for k, env in enumerate(singles)]
    assert np.array_equal(observed, np.stack(frames))
    running = np.ones(len(ACTIONS), dtype=bool)
    for _ in range(4):
        observed, rewards, ended, _, _ = lanes.step(ACTIONS)
        for k in np.flatnonzero(running):
            frame, reward, terminated, _, _ = singles[k].step(ACTIONS[k])
            assert np.array_equal(observed[k], frame) and (rewards[k], ended[k]) == (reward, terminated)
        running &= ~ended  # PufferLib resets an ended lane at the next step
    assert not running.all()
    lanes.close()
