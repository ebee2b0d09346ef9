"""``make data``: random, medium and optimal datasets of three control tasks in the kinematic mode."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

from imagine_bench import registry
from imagine_bench.data.folder import write_dataset
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.running.launchers.jobs import launcher
from imagine_bench.seeding import TUNING_SEEDS

MEDIUM = {"arrow_puzzle": 500, "arrow_puzzle_hard": 1000, "pick_place": 100}
"""By task: episodes after which a DQN solves some of its tests and not all (docs/results)."""
_EXECUTION = "kinematic"


def standard_sets(root: Path, format: str, episodes: int) -> Iterator[Path]:
    """Make the nine sets below ``root``, each of so many episodes; yields their folders, ``<task>-<random, ...>``.

    One that is there already is kept. The medium player is a DQN of a tuning seed, trained below ``root/runs``. Errors
    are those of :func:`.running` and :func:`.write_dataset`.
    """
    for task, name in itertools.product(MEDIUM, ("random", "medium", "optimal")):
        if not (folder := root / f"{task}-{name}").exists():
            player = {"random": "random", "optimal": "oracle"}.get(name) or _medium(task, root)
            spec = registry.task(task)
            policy = policy_of(player, spec, seed=0)
            found = collect(spec, policy, episodes=episodes, seed=0, execution=_EXECUTION, appearance="clean")
            write_dataset(folder, *found, format)
        yield folder


def _medium(task: str, root: Path) -> str:
    """The folder of a run whose DQN is half trained."""
    few = {"evaluation_episodes": 100, "recorded_episodes": 0, "open_loop_starts": 0}
    wanted, paths = plan(
        task, "quick", agents=("dqn",), seeds=(TUNING_SEEDS,), budgets=(MEDIUM[task],), execution=_EXECUTION, **few
    )
    trained = bench(wanted, paths, root=root / "runs", launcher=launcher("local", 1))
    return str(trained.folder / f"dqn/seed_{TUNING_SEEDS}")
