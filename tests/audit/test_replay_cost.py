"""Playing episodes again costs little more than their simulation."""

from __future__ import annotations

import time
from typing import Any

import mujoco.rollout
import pytest
from forging import oracle

from imagine_bench.judge.verify import Replays
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.evaluation import play_test_episode
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import episode_seed


def test_a_replay_costs_at_most_twice_its_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 40 different episodes of the oracle in contact physics: CPU seconds, by those of MuJoCo's steps in them."""
    spent_s = []
    steps = mujoco.rollout.rollout

    def timed(*values: Any, **named: Any) -> Any:
        begun_s = time.thread_time()
        found = steps(*values, **named)
        spent_s.append(time.thread_time() - begun_s)
        return found

    seeds = [episode_seed("evaluation", 5, number) for number in range(40)]
    kinematic = Protocol(task="arrow_puzzle", preset="quick", execution="kinematic")
    with environments(kinematic, observation="state") as (env, _):
        played = [play_test_episode(env, oracle(), seed=seed, privileged=True).actions for seed in seeds]
    with environments(Protocol(task="arrow_puzzle", preset="quick"), observation="state") as (env, _):
        env.reset(seed=0)
        env.step(0)
        monkeypatch.setattr(mujoco.rollout, "rollout", timed)
        begun_s = time.process_time()
        replays = Replays(env, env)
        assert all(replays.test(*each)[1] for each in zip(seeds, played, strict=True))
        whole_s = time.process_time() - begun_s
    assert 0.0 < whole_s <= 2.0 * sum(spent_s)
