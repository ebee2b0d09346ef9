"""What a task is, in words and exact numbers."""

from __future__ import annotations

import pytest

from imagine_bench.cli import main
from imagine_bench.tools.describe import describe_task


def test_a_task_is_described_with_its_exact_facts() -> None:
    said = describe_task("arrow_puzzle")
    assert "6: turn the left cube clockwise; turn" in said and "192, 54 of them starts" in said
    assert "left arrow (toward the human, right, toward the agent, left)" in said
    # 12 + 24 + 36 + 48 + 30 = 150 macro-actions over 54 starts
    assert "1 (12 starts), 2 (12 starts), 3 (12 starts), 4 (12 starts), 5 (6 starts); mean 2.78" in said
    assert "none: each has one outcome" in said and "arrow_puzzle-photo" in said


def test_chance_is_described() -> None:
    assert "several outcomes" in describe_task("arrows:cubes=2,slip=0.2")


def test_a_regression_task_is_described_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "toy_regression"]) == 0
    assert "in the variants base, low_data, high_noise" in capsys.readouterr().out
    assert main(["describe", "toy"]) == 2
    assert "No task 'toy'" in capsys.readouterr().err
