"""A row of continuous control for the leaderboard: optimal macro-actions, carried out by the bundled clone.

python docs/examples/clone_row.py --tests 20 --seed 482 --out build/rows
"""

from __future__ import annotations

import argparse
from pathlib import Path

from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench_board.motions import MotionTests
from imagine_bench_motion.cloned_env import BUNDLED, ControlPeriod, carry_out
from imagine_bench_motion.cloning import Clone
from imagine_bench_motion.skills import CONTROL, PLACEMENT_M, Command


def clone_tests(tests: int, seed: int) -> MotionTests:
    """The tests as the clone plays them, with cubes up to 3 cm off their slots."""
    clone = Clone.load(BUNDLED)
    observation = clone.observation
    env = MotionTests(
        "arrow_puzzle", control=CONTROL, observation=observation, placement=PLACEMENT_M, tests=tests, seed=seed
    )
    motion = env.unwrapped
    assert isinstance(motion, MotionEnv)

    def period(command: Command) -> ControlPeriod:
        seen, _, terminated, truncated, info = env.step(command)
        return ControlPeriod(seen, event=bool(info["event"]), over=terminated or truncated)

    for _ in range(tests):
        seen, _ = env.reset()
        latest = ControlPeriod(seen, event=False, over=False)
        while not latest.over:
            action = motion.task.rules.optimal_action(motion.episode.macrostate)
            latest = carry_out(clone, motion.task.action_names[action], latest.seen, period)
    return env


def main() -> None:
    """Write the row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=20)
    parser.add_argument("--seed", type=int, default=482)
    parser.add_argument("--out", type=Path, default=Path("rows"))
    given = parser.parse_args()
    tests = clone_tests(given.tests, given.seed)
    seen = "300 demonstrations"
    print(
        tests.write(given.out, "clone-motion-arrow_puzzle", agent="clone", author="imagine_bench", seen_beforehand=seen)
    )


if __name__ == "__main__":
    main()
