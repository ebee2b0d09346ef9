"""A bench that the tests of verification forge copies of."""

from __future__ import annotations

from pathlib import Path

import pytest
from forging import honest_bench
from small_runs import Inline


@pytest.fixture(scope="session")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of a learner, planned as by a command, without a report."""
    few = {"agents": ("table",), "seeds": (0, 1), "budgets": (4, 9), "evaluation_episodes": 8}
    return honest_bench(tmp_path_factory.mktemp("pair"), Inline(), **few)
