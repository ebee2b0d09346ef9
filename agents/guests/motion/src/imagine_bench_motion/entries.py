"""The registry line of the task whose macro-actions a clone carries out."""

from __future__ import annotations

from imagine_bench.registry import TaskEntry

ARROW_PUZZLE_CLONED = TaskEntry(
    spec="imagine_bench_motion.cloned_task:SPEC",
    env_id="imagine_bench_motion/ArrowPuzzleCloned-v0",
    env="imagine_bench_motion.cloned_env:CloneExecutedEnv",
    horizon=10,
)
