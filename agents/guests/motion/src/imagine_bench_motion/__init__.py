"""Continuous control as a plug-in: cloned skills at 25 Hz, macro-actions that they execute, a flat baseline, goals, and
the judge of models of motions.

Importing the package registers an environment with goals for every task that has continuous control:
``imagine_bench_motion/ArrowPuzzleGoals-v0`` and so on.
"""

from __future__ import annotations

import gymnasium

from imagine_bench.registry import TASKS


def _register_goals() -> None:
    for task, entry in TASKS.items():
        env_id = entry.env_id.replace("imagine_bench/", "imagine_bench_motion/").replace("-v", "Goals-v")
        if entry.motion and env_id not in gymnasium.registry:
            gymnasium.register(env_id, "imagine_bench_motion.control.goals:make", kwargs={"task": task})


_register_goals()
