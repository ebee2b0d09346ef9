"""Whole reports of made-up results; ``tests/report`` and ``tests/test_statistics.py`` compute their numbers too."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from fake_results import WIDE, bench_result
from report_pages import page_in_words
from whole_outputs import Expected, short

from imagine_bench import statistics
from imagine_bench.protocols.control import Protocol
from imagine_bench.report.bench import bench_page

MANY = dataclasses.replace(WIDE, seeds=tuple(range(statistics.FEWEST)))
ONE = Protocol(task="arrow_puzzle", preset="smoke", seeds=(0,), budgets=(10, 20))
CHAPTER_3 = Protocol(
    task="pick_place", preset="quick", agents=("dqn", "imagination_only"), seeds=(0, 1), budgets=(500, 1000)
)


@pytest.mark.parametrize(("name", "protocol"), [("seven_seeds", MANY), ("one_seed", ONE), ("chapter_3", CHAPTER_3)])
def test_page_of_a_bench(name: str, protocol: Protocol, tmp_path: Path, expected: Expected) -> None:
    page = bench_page(bench_result(tmp_path, protocol=protocol))
    text = f"{page_in_words(page)}\n== terminal\n{page.summary}".replace(str(tmp_path), "HERE")
    expected(f"page_{name}", short(text).replace(protocol.hash, "HASH"))
