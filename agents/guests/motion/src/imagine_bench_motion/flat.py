"""A flat baseline: Stable-Baselines3's SAC (Haarnoja et al. 2018) on hand twists, without macro-actions."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.tasks.continuous.spec import make_arrows
from stable_baselines3 import SAC

OBSERVATION = "proprio,objects,state"
"""It sees more than any other agent here: the true poses and the macrostate."""
_SEEDS = 2**31


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of a learning curve."""

    steps: int  #: control periods of training
    robot_s: float  #: simulated seconds of training
    successes: int
    tests: int
    touched: int  #: tests in which any event happened
    mean_return: float
    cpu_s: float  #: of training and tests so far


def flat_env(cubes: int = 1, **options: Any) -> gymnasium.Env[Any, Any]:
    """The arrow world by hand twists, its observation as one vector."""
    return gymnasium.wrappers.FlattenObservation(make_arrows(cubes=cubes, observation=OBSERVATION, **options))


def learn(
    steps: int, *, seed: int, every: int = 2_500, tests: int = 20, told: Callable[[Point], None], **options: Any
) -> list[Point]:
    """Train SAC with the library's own settings, and test its deterministic policy now and then.

    Args:
        steps: Control periods of training.
        seed: Of the library and the environments, below 2**31.
        every: Steps between tests.
        tests: Episodes of a test, from seeds that training never sees.
        told: Called with each point of the curve.
        **options: Of the environment.
    """
    prepare_torch("cpu")
    env, test_env = flat_env(**options), flat_env(**options)
    model = SAC("MlpPolicy", env, seed=seed % _SEEDS, device="cpu", train_freq=4, gradient_steps=4)
    began_s = time.process_time()
    curve = []
    for done in range(every, steps + 1, every):
        model.learn(every, reset_num_timesteps=False)
        point = _tested(model, test_env, done, tests, time.process_time() - began_s)
        told(point)
        curve.append(point)
    return curve


def _tested(model: SAC, env: gymnasium.Env[Any, Any], steps: int, tests: int, cpu_s: float) -> Point:
    successes = touched = 0
    total = 0.0
    for episode in range(tests):
        seen, info = env.reset(seed=10**9 + episode)
        event = ended = False
        while not ended:
            action, _ = model.predict(seen, deterministic=True)
            seen, reward, terminated, truncated, info = env.step(action)
            total += float(reward)
            event |= bool(info["event"])
            ended = terminated or truncated
        successes += int(info["is_success"])
        touched += event
    return Point(
        steps=steps,
        robot_s=steps * env.unwrapped.period_s,  # type: ignore[attr-defined]
        successes=successes,
        tests=tests,
        touched=touched,
        mean_return=total / tests,
        cpu_s=round(cpu_s, 1),
    )
