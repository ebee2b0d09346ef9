"""A flat baseline: Stable-Baselines3's SAC (Haarnoja et al. 2018) on hand twists, without macro-actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.tasks.continuous.spec import make_arrows
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from imagine_bench.arrays import Info
from imagine_bench.errors import InvalidValueError

OBSERVATION = "proprio,objects,state"
"""It sees more than any other agent here: the true poses and the macrostate."""
SETTINGS = {
    "library": partial(SAC, train_freq=4, gradient_steps=4),
    "tuned": partial(
        SAC,
        ent_coef="auto_0.05",  # from 1, the start of the library, the entropy outweighs this small reward for long
        learning_rate=1e-3,
        gamma=0.97,
        tau=0.01,
        batch_size=128,
        policy_kwargs={"net_arch": [128, 128]},
        learning_starts=2_000,
        train_freq=8,
        gradient_steps=4,
    ),
}
"""The library's own settings; and others, with observations and rewards that are divided by their spread so far."""
_TEST_SEED = 10**9
"""Of the first test; seeds of training are below."""


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
    train_faults: int  #: training episodes so far that ended in a fault
    train_successes: int


def flat_env(cubes: int = 1, **options: Any) -> gymnasium.Env[Any, Any]:
    """The arrow world by hand twists, its observation as one vector."""
    return gymnasium.wrappers.FlattenObservation(make_arrows(cubes=cubes, observation=OBSERVATION, **options))


def learn(
    steps: int,
    *,
    seed: int,
    settings: str = "library",
    every: int = 2_500,
    tests: int = 20,
    told: Callable[[Point], None],
    **options: Any,
) -> list[Point]:
    """Train SAC, and test its deterministic policy now and then.

    Args:
        steps: Control periods of training. The library makes four or eight at once, so before a test there may be up
            to seven more than were asked for.
        seed: Of the library and the environments, below 10**9, where the seeds of tests begin.
        settings: A name of :data:`SETTINGS`.
        every: Steps between tests.
        tests: Episodes of a test, from seeds that training never sees.
        told: Called with each point of the curve.
        **options: Of the environment.

    Raises:
        InvalidValueError: No test would follow, or one before the last step; or a seed that is one of the tests'.
    """
    if every < 1 or steps < every or steps % every:
        raise InvalidValueError(f"steps is {steps} and every {every}; give a multiple of every, which is at least 1.")
    if not 0 <= seed < _TEST_SEED:
        raise InvalidValueError(f"seed is {seed}; give 0 to {_TEST_SEED - 1:,}.")
    prepare_torch("cpu")
    scales = settings == "tuned"
    env = VecNormalize(DummyVecEnv([partial(flat_env, **options)]), norm_obs=scales, norm_reward=scales, gamma=0.97)
    test_env = flat_env(**options)
    model = SETTINGS[settings]("MlpPolicy", env, seed=seed, device="cpu")
    counts = EndCounts()
    began_s = time.process_time()
    curve = []
    for wanted in range(every, steps + 1, every):
        model.learn(wanted - model.num_timesteps, reset_num_timesteps=False, callback=counts)
        point = _tested(model, env, test_env, tests, counts, time.process_time() - began_s)
        told(point)
        curve.append(point)
    return curve


class EndCounts(BaseCallback):
    """Counts ends of training episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.faults = 0
        self.successes = 0

    def add(self, infos: Sequence[Info]) -> None:
        """Count the ends in the ``info`` of a period of each environment."""
        for info in infos:
            self.faults += bool(info["fault"])
            self.successes += bool(info["is_success"])

    def _on_step(self) -> bool:
        self.add(self.locals["infos"])
        return True


def _tested(
    model: SAC,
    scaled: VecNormalize,
    env: gymnasium.Env[Any, Any],
    tests: int,
    counts: EndCounts,
    cpu_s: float,
) -> Point:
    successes = touched = 0
    total = 0.0
    for episode in range(tests):
        seen, info = env.reset(seed=_TEST_SEED + episode)
        event = ended = False
        while not ended:
            action, _ = model.predict(scaled.normalize_obs(seen), deterministic=True)
            seen, reward, terminated, truncated, info = env.step(action)
            total += float(reward)
            event |= bool(info["event"])
            ended = terminated or truncated
        successes += int(info["is_success"])
        touched += event
    return Point(
        steps=model.num_timesteps,
        robot_s=model.num_timesteps * env.unwrapped.period_s,  # type: ignore[attr-defined]
        successes=successes,
        tests=tests,
        touched=touched,
        mean_return=total / tests,
        cpu_s=round(cpu_s, 1),
        train_faults=counts.faults,
        train_successes=counts.successes,
    )
