"""Two rows of continuous control for the leaderboard: the scripted expert, and hand commands by chance.

python docs/examples/motion_rows.py arrow_puzzle pick_place --tests 20 --seed 470 --out docs/board/rows
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench_board.motions import MotionTests

HELD = 10
"""Control periods for which a command by chance is held."""


def expert(task: str, tests: int, seed: int) -> MotionTests:
    """The tests as the scripted expert plays them, which sees the true scene and carries out optimal macro-actions."""
    env = MotionTests(task, control="joint", observation="proprio", tests=tests, seed=seed)
    motion: Any = env.unwrapped
    player = Expert(motion)
    for _ in range(tests):
        env.reset()
        over = False
        while not over:
            if player.is_done:
                player.begin(motion.task.rules.optimal_action(motion.episode.macrostate))
            _, _, terminated, truncated, _ = env.step(player.act())
            over = terminated or truncated
    return env


def random_twists(task: str, tests: int, seed: int) -> MotionTests:
    """The tests as hand velocities by chance play them."""
    env = MotionTests(task, control="twist", observation="proprio", tests=tests, seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(tests):
        env.reset()
        over = False
        while not over:
            action = rng.uniform(-1.0, 1.0, 7).astype(np.float32)
            for _ in range(HELD):
                _, _, terminated, truncated, _ = env.step(action)
                over = terminated or truncated
                if over:
                    break
    return env


def main() -> None:
    """Write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--tests", type=int, default=20)
    parser.add_argument("--seed", type=int, default=470)
    parser.add_argument("--out", type=Path, default=Path("rows"))
    given = parser.parse_args()
    for task in given.tasks:
        for name, play, seen in (
            ("expert", expert, "privileged: the true scene, and the rules"),
            ("random", random_twists, "nothing"),
        ):
            tests = play(task, given.tests, given.seed)
            row = f"{name}-motion-{task}".lower().replace(":", "-")
            print(tests.write(given.out, row, agent=name, author="imagine_bench", seen_beforehand=seen))


if __name__ == "__main__":
    main()
