"""A row of continuous control for the leaderboard: optimal macro-actions, carried out by the bundled clone.

python docs/examples/clone_row.py --tests 20 --seed 482 --out build/rows
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench_board.motions import MotionTests
from imagine_bench_motion.cloned_env import BUNDLED
from imagine_bench_motion.cloning import Clone
from imagine_bench_motion.instruction import GO_BACK
from imagine_bench_motion.skills import CONTROL, HOME_COMMAND, PLACEMENT_M, Command
from imagine_bench_motion.trials import MOST_PERIODS

BACK_PERIODS = 12
"""Control periods in which the skill lifts the hand."""
HOME_PERIODS = 25
"""The most control periods of the way home along the joints."""
AT_HOME_RAD = 2e-3
"""An arm nearer to its observation pose, at each joint, is there."""


class Player:
    """Plays one test."""

    def __init__(self, env: MotionTests, clone: Clone) -> None:
        self.env = env
        self.clone = clone
        self.seen, _ = env.reset()
        self.over = False

    def period(self, command: Command) -> bool:
        """One control period, unless the test is over. Returns whether an event happened."""
        if self.over:
            return False
        self.seen, _, terminated, truncated, info = self.env.step(command)
        self.over = terminated or truncated
        return bool(info["event"])

    def macro_action(self, instruction: str) -> None:
        """Let the clone carry out a macro-action, lift the hand, and bring the arm home."""
        self.clone.begin(instruction)
        for _ in range(MOST_PERIODS):
            if self.over or self.period(self.clone.act(self.seen)):
                break
        self.clone.begin(GO_BACK)
        for _ in range(BACK_PERIODS):
            self.period(self.clone.act(self.seen))
        for _ in range(HOME_PERIODS):
            self.period(HOME_COMMAND)
            off_rad = np.abs(self.seen["proprio"][: len(HOME_COMMAND) - 1] - HOME_COMMAND[:-1])
            if self.over or off_rad.max() < AT_HOME_RAD:
                break


def clone_tests(tests: int, seed: int) -> MotionTests:
    """The tests as the clone plays them, with cubes up to 3 cm off their slots."""
    clone = Clone.load(BUNDLED)
    observation = clone.observation
    env = MotionTests(
        "arrow_puzzle", control=CONTROL, observation=observation, placement=PLACEMENT_M, tests=tests, seed=seed
    )
    motion = env.unwrapped
    assert isinstance(motion, MotionEnv)
    for _ in range(tests):
        player = Player(env, clone)
        while not player.over:
            action = motion.task.rules.optimal_action(motion.episode.macrostate)
            player.macro_action(motion.task.action_names[action])
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
