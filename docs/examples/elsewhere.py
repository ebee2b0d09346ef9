"""``factored`` in Gymnasium environments that nobody here wrote: 64 x 64 pixels, and nothing beforehand.

pip install "gymnasium[toy-text,other]" minigrid
python elsewhere.py FrozenLake-v1 MiniGrid-Empty-Random-5x5-v0 --seeds 0 1 2 3 4 --out elsewhere.json
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import AddRenderObservation, ResizeObservation, TransformReward
from imagine_bench_factored.learned import LearnedPerceptionAgent, make

from imagine_bench.interfaces import AgentContext, Observation, Transition
from imagine_bench.registry.machine import describe_environment
from imagine_bench.seeding import SeedTree

BUDGETS = (5, 10, 20, 40, 80)
OPTIONS: dict[str, dict[str, Any]] = {"FrozenLake-v1": {"is_slippery": False}, "MiniGrid": {"highlight": False}}


def environment(name: str) -> gymnasium.Env[Any, Any]:
    """Its picture as the observation, and as reward whether there is any: MiniGrid's falls with every step."""
    if name.startswith("MiniGrid") and importlib.util.find_spec("minigrid"):
        importlib.import_module("minigrid")
    env = gymnasium.make(name, render_mode="rgb_array", **OPTIONS.get(name.partition("-")[0], OPTIONS.get(name, {})))
    pictures = ResizeObservation(AddRenderObservation(env), (64, 64))
    return TransformReward(pictures, lambda reward: float(reward > 0.0))


def live(agent: LearnedPerceptionAgent | None, env: gymnasium.Env[Any, Any], seeds: range, *, explore: bool) -> float:
    """One episode a seed, which an agent learns from if it explores; the share that is rewarded. None acts blindly."""
    solved, blind = 0.0, np.random.default_rng(seeds.start)
    for episode, seed in enumerate(seeds):
        if agent:
            agent.begin_episode()
        frame, _ = env.reset(seed=seed)
        reward, ended = 0.0, False
        while not ended:
            seen = Observation(frame=frame)
            action = agent.act(seen, explore=explore) if agent else int(blind.integers(env.action_space.n))
            frame, reward, terminated, truncated, _ = env.step(action)
            ended = terminated or truncated
            if agent and explore:
                agent.observe(
                    Transition(
                        observation=seen, action=action, reward=float(reward),
                        next_observation=Observation(frame=frame), terminated=terminated, truncated=truncated,
                    ),
                    episode=episode,
                )  # fmt: skip
        solved += float(reward)
    return solved / len(seeds)


def learn(name: str, seed: int, tests: int, budgets: Sequence[int] = BUDGETS) -> dict[str, Any]:
    """Train on episodes of their own seeds; after each budget, the share of test episodes that are rewarded."""
    with closing(environment(name)) as env:
        return _learn(env, seed, tests, budgets)


def _learn(env: gymnasium.Env[Any, Any], seed: int, tests: int, budgets: Sequence[int]) -> dict[str, Any]:
    agent = make(
        AgentContext(n_actions=int(env.action_space.n), preprocessing="gray", encoder=None, seeds=SeedTree(seed))
    )
    first, done, cpu_s, success = 1_000_000 * (seed + 1), 0, 0.0, {}
    for budget in budgets:
        began = time.process_time()
        live(agent, env, range(first + done, first + budget), explore=True)
        done, cpu_s = budget, cpu_s + time.process_time() - began
        success[budget] = live(agent, env, range(tests), explore=False)
    seen = {
        key.removeprefix("perception/"): value for key, value in agent.diagnostics().items() if "perception/" in key
    }
    return {"seed": seed, "success": success, "real_steps": len(agent.replay), "train_cpu_s": cpu_s, **seen}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environments", nargs="+")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--tests", type=int, default=100)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    found: dict[str, Any] = {**describe_environment(), "tests": options.tests, "environments": {}}
    for name in options.environments:
        with closing(environment(name)) as env:
            blind = live(None, env, range(1000, 2000), explore=False)
        runs = [learn(name, seed, options.tests) for seed in options.seeds]
        found["environments"][name] = {"blind": blind, "runs": runs}
        means = {budget: np.mean([run["success"][budget] for run in runs]) for budget in BUDGETS}
        print(f"{name}: blind {blind:.1%};", ", ".join(f"{n} episodes {mean:.1%}" for n, mean in means.items()))
    if options.out:
        options.out.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
