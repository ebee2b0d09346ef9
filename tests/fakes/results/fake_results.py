"""Synthetic BenchResults: numbers drawn from a seed, in every shape a report must cope with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from imagine_bench.interfaces.capabilities import ImaginedRollout
from imagine_bench.protocols.control import Protocol
from imagine_bench.store.results import BenchResult, Checkpoint, ComparedRollout, OpenLoop, RunResult

LEVELS = {
    "random": (0.045, 0.045),
    "oracle": (1.0, 1.0),
    "dqn": (0.1, 0.6),
    "dqn_more_updates": (0.1, 0.5),
    "imagination": (0.1, 0.55),
    "imagination_uncertainty": (0.15, 0.85),
    "imagination_only": (0.1, 0.8),
    "factored:given": (0.9, 1.0),
}
DEPTH = 10
WIDE = Protocol(task="arrow_puzzle", preset="thesis", budgets=(250, 2000, 6000), seeds=(0, 1, 7))
"""A protocol of which the thesis has some budgets, and others that this has not."""


def bench_result(folder: Path, *, protocol: Protocol | None = None) -> BenchResult:
    """Complete results of a protocol, the quick preset's by default."""
    protocol = protocol or Protocol(task="arrow_puzzle", preset="quick")
    runs = [run_result(protocol, agent, seed, folder) for agent, seed in protocol.runs]
    environment = {
        "command": "imagine-bench bench --task arrow_puzzle",
        "commit": "0123456789ab",
        "versions": {"python": "3.11", "mujoco": "3.17.0"},
        "machine": {"cpu": "a <processor> & more", "cores": 2},
    }
    return BenchResult(protocol=protocol, runs=tuple(runs), environment=environment, folder=folder, wall_s=812.5)


def rewritten(result: BenchResult, change: Callable[[RunResult, Checkpoint], Checkpoint]) -> BenchResult:
    """The result with every checkpoint changed."""
    runs = []
    for run in result.runs:
        rows = tuple(change(run, row) for row in run.checkpoints)
        runs.append(dataclasses.replace(run, checkpoints=rows))
    return dataclasses.replace(result, runs=tuple(runs))


def run_result(protocol: Protocol, agent: str, seed: int, folder: Path) -> RunResult:
    """One run whose success grows from its agent's first level to the second."""
    rng = np.random.default_rng([seed, sum(agent.encode())])
    imagines = agent.startswith("imagination")
    low, high = LEVELS[agent]
    share = np.clip(np.linspace(low, high, len(protocol.budgets)) + rng.normal(0, 0.04, len(protocol.budgets)), 0, 1)
    if agent == "oracle":
        share[:] = 1.0
    checkpoints = []
    for index, budget in enumerate(protocol.budgets):
        diagnostics = {"loss/bellman": float(rng.uniform()), "time/controller_s": 0.002} if low != high else {}
        if imagines:
            rate = 1.0 if agent == "imagination" else float(rng.uniform(0.3, 0.6))
            diagnostics |= {"imagination/acceptance_rate": rate, "time/model_s": 0.02}
        checkpoints.append(
            Checkpoint(
                episodes=budget,
                env_steps=budget * 3,
                test_episodes=protocol.evaluation_episodes,
                successes=int(rng.binomial(protocol.evaluation_episodes, share[index])),
                mean_return=float(rng.normal(20, 3)),
                mean_length=float(rng.uniform(1.3, 3.2)),
                faults=int(rng.integers(0, 2)),
                train_cpu_s=budget * 0.06,
                eval_cpu_s=1.7,
                diagnostics=diagnostics,
                open_loop=open_loop(rng, filters=agent == "imagination_uncertainty") if imagines else None,
            )
        )
    return RunResult(
        agent=agent,
        seed=seed,
        checkpoints=tuple(checkpoints),
        settings={"gamma": 0.9},
        training_success=rng.uniform(size=protocol.budgets[-1]) < 0.4,
        training_length=rng.integers(1, 6, protocol.budgets[-1]),
        imagined=tuple(compared_rollout(rng) for _ in range(5)) if imagines else (),
        folder=folder / agent / f"seed_{seed}",
        recording=folder / agent / f"seed_{seed}" / "recording.rrd",
    )


def open_loop(rng: np.random.Generator, *, filters: bool) -> OpenLoop:
    """Quality that falls with depth; the filter keeps nothing at the last one."""
    depth = np.arange(DEPTH)
    accepted = np.clip(1 - 0.11 * depth, 0, 1) if filters else np.ones(DEPTH)
    accepted[-1] = 0.0 if filters else 1.0
    correct = 0.95 * 0.9**depth
    kept = np.where(accepted > 0, np.minimum(correct * 1.05, 1), np.nan)
    return OpenLoop(
        count=np.full(DEPTH, 100),
        correct=correct + rng.uniform(0, 0.02, DEPTH),
        correct_accepted=kept,
        accepted=accepted,
        reward_mae=0.3 + 0.2 * depth,
        termination_error=0.02 + 0.02 * depth,
        epistemic=0.05 * 1.3**depth,
        aleatoric=0.08 * 1.1**depth,
        modal=0.01 * 1.1**depth,
        judged=np.full(DEPTH, 80.0),
        auroc_epistemic=0.8 - 0.01 * depth,
        auroc_aleatoric=0.6 + 0.0 * depth,
        auroc_modal=np.where(depth == 0, np.nan, 0.5),
    )


def compared_rollout(rng: np.random.Generator, depth: int = 5, cut: int | None = 3) -> ComparedRollout:
    """A rollout of noise: its third macrostate is wrong, the episode ends at the fourth, the filter cuts at ``cut``."""
    macrostates = rng.integers(0, 3, (depth, 4))
    imagined = macrostates.copy()
    imagined[min(2, depth - 1)] += 1
    accepted = np.ones(depth, dtype=bool)
    if cut is not None:
        accepted[cut:] = False
    rollout = ImaginedRollout(
        actions=rng.integers(0, 4, depth),
        frames=rng.uniform(size=(depth, 64, 64)).astype(np.float32),
        start_frame=rng.uniform(size=(64, 64)).astype(np.float32),
        rewards=rng.normal(size=depth).astype(np.float32),
        p_terminated=rng.uniform(size=depth).astype(np.float32),
        q_values=rng.normal(size=(depth, 6)).astype(np.float32),
        epistemic=rng.uniform(size=depth).astype(np.float32),
        aleatoric=rng.uniform(size=depth).astype(np.float32),
        modal=rng.uniform(size=depth).astype(np.float32),
        accepted=accepted,
        macrostates=imagined,
    )
    return ComparedRollout(
        start_frame=rng.integers(0, 255, (64, 64, 3), dtype=np.uint8),
        start_macrostate=np.array([0, 1, 2, 0]),
        rollout=rollout,
        real_frames=rng.integers(0, 255, (depth, 64, 64, 3), dtype=np.uint8),
        real_macrostates=macrostates,
        real_rewards=np.full(depth, -1.0),
        real_terminated=np.arange(depth) >= 3,
    )
