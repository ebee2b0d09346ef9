"""A bench that the tests of verification forge copies of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from small_runs import Inline

from imagine_bench.running.bench import bench, plan


def planned(root: Path, **changes: Any) -> Path:
    """A bench of two seeds of a learner as a command plans it, without a report."""
    few: dict[str, Any] = {"agents": ("table",), "seeds": (0, 1), "budgets": (4, 9), "evaluation_episodes": 8}
    how: dict[str, Any] = {"execution": "kinematic", "open_loop_starts": 0, "recorded_episodes": 0}
    wanted, paths = plan("arrow_puzzle", "smoke", **{**few, **how, **changes})
    return bench(wanted, paths, root=root, launcher=Inline()).folder


@pytest.fixture(scope="session")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return planned(tmp_path_factory.mktemp("pair"))
