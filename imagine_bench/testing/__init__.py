"""The contract's checks as tests in the test files of any package; they need pytest.

from imagine_bench.testing import agent_tests, task_tests

test_task = task_tests("my_task")
test_agent = agent_tests("my_agent", task="my_task")
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from imagine_bench import registry
from imagine_bench.tools.check import AGENT_CHECKS, TASK_CHECKS, NotOffered, checked_agent

__all__ = ["agent_tests", "task_tests"]


def task_tests(name: str) -> Callable[[str], None]:
    """A test, once for everything that must hold of a registered task."""

    @pytest.mark.parametrize("holds", TASK_CHECKS)
    def test(holds: str) -> None:
        _carry_out(lambda: TASK_CHECKS[holds](registry.task(name)))

    return test


def agent_tests(name: str, task: str = "arrow_puzzle") -> Callable[[str], None]:
    """A test, once for everything that must hold of a registered agent, in a task's kinematic execution."""

    @pytest.mark.parametrize("holds", AGENT_CHECKS)
    def test(holds: str) -> None:
        _carry_out(lambda: AGENT_CHECKS[holds](checked_agent(name, task)))

    return test


def _carry_out(check: Callable[[], None]) -> None:
    try:
        check()
    except NotOffered as why:
        pytest.skip(str(why))
