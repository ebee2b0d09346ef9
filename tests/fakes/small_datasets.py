"""Small datasets, collected once a process, and written anew wherever a test wants one."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.data.collect import collect, policy_of
from imagine_bench.data.episodes import Episodes
from imagine_bench.data.folder import Apart, Dataset, write_dataset

FORMATS = ("npz", "lerobot", "minari")


@functools.cache
def collected(policy: str = "mixed", episodes: int = 6, seed: int = 0) -> tuple[Episodes, Apart, dict[str, Any]]:
    spec = registry.task("arrow_puzzle")
    chosen = policy_of(policy, spec, seed)
    return collect(spec, chosen, episodes=episodes, seed=seed, execution="kinematic", appearance="mild")


def written(folder: Path, format: str = "npz", **which: Any) -> Dataset:
    return write_dataset(folder, *collected(**which), format)
