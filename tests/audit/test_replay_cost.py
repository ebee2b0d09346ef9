"""Playing episodes again costs little more than their simulation."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import mujoco.rollout
import numpy as np
import pytest

from imagine_bench import registry
from imagine_bench.judge.verify import Replays
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import episode_seed

MOST_RATIO = 2.0
"""CPU seconds of a check, by those of MuJoCo's steps in it."""


def cost(episodes: int, monkeypatch: pytest.MonkeyPatch) -> tuple[float, float]:
    """CPU seconds of different episodes in contact physics, and of MuJoCo's steps in them.

    The player takes an optimal macro-action with probability 0.8, else any.
    """
    spent_s = [0.0]
    steps: Callable[..., Any] = mujoco.rollout.rollout

    def timed(*values: Any, **named: Any) -> Any:
        begun_s = time.thread_time()
        found = steps(*values, **named)
        spent_s[0] += time.thread_time() - begun_s
        return found

    rules = registry.task("arrow_puzzle").rules
    rng = np.random.default_rng(0)
    with environments(Protocol(task="arrow_puzzle", preset="quick"), observation="state") as (env, _):
        env.reset(seed=0)
        env.step(0)
        played = []
        for number in range(episodes):
            seed = episode_seed("evaluation", 5, number)
            state = tuple(env.reset(seed=seed)[1]["macrostate"].tolist())
            actions = list[int]()
            over = False
            while not over and len(actions) < 10:
                best = rules.optimal_action(state)
                actions.append(best if rng.random() < 0.8 else int(rng.integers(rules.n_actions)))
                (outcome,) = rules.outcomes(state, actions[-1])
                state = outcome.macrostate
                over = outcome.terminated
            played.append((seed, actions))
        monkeypatch.setattr(mujoco.rollout, "rollout", timed)
        begun_s = time.process_time()
        replays = Replays(env, env)
        assert all(replays.test(*each)[1] for each in played)
        return time.process_time() - begun_s, spent_s[0]


def test_a_replay_costs_at_most_twice_its_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    whole_s, steps_s = cost(40, monkeypatch)
    assert steps_s > 0.0 and whole_s <= MOST_RATIO * steps_s


@pytest.mark.slow
def test_two_thousand_episodes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Printed: CPU seconds of 2,000 different episodes, and the ratio to MuJoCo's steps in them."""
    whole_s, steps_s = cost(2_000, monkeypatch)
    with capsys.disabled():
        print(f"\n2,000 episodes: {whole_s:.1f} CPU s, {whole_s / steps_s:.2f} times MuJoCo's own {steps_s:.1f} s")
    assert whole_s <= MOST_RATIO * steps_s
