"""Whole reports of made-up results; ``tests/report`` and ``tests/test_statistics.py`` compute their numbers too."""

from __future__ import annotations

import dataclasses
import re
from html import unescape
from pathlib import Path

import pytest
from fake_results import WIDE, bench_result
from report_pages import check_page
from whole_outputs import Expected, short

from imagine_bench import statistics
from imagine_bench.protocols.control import Protocol
from imagine_bench.report import bench_page
from imagine_bench.report.page import Page, texts

MANY = dataclasses.replace(WIDE, seeds=tuple(range(statistics.FEWEST)))
ONE = Protocol(task="arrow_puzzle", preset="smoke", seeds=(0,), budgets=(10, 20))
CHAPTER_3 = Protocol(
    task="pick_place", preset="quick", agents=("dqn", "imagination_only"), seeds=(0, 1), budgets=(500, 1000)
)


def words(page: Page) -> str:
    """What a reader sees of a page, a cell or a paragraph a line, and of each of its files the first and last lines."""
    written = texts(page, images=False)
    index = written.pop("index.html")
    check_page(index)
    text = re.sub(r"<(style|svg|script|title)\b.*?</\1>", "", index, flags=re.DOTALL)
    text = re.sub(r"</t[dh]>\s*<t[dh][^>]*>", " | ", text)
    text = re.sub(r"</(tr|p|h\d|li|summary|caption|figcaption|table|dt|dd|pre)>", "\n", text)
    lines = [" ".join(unescape(re.sub(r"<[^>]+>", "", line)).split()) for line in text.splitlines()]
    shown = [line for line in lines if line and "imagine_bench" not in line]
    for name, file in sorted(written.items()):
        rows = file.splitlines()
        shown += [f"== {name}: {len(rows)} lines", *rows[:3], *rows[-2:]]
    return "\n".join(shown)


@pytest.mark.parametrize(("name", "protocol"), [("seven_seeds", MANY), ("one_seed", ONE), ("chapter_3", CHAPTER_3)])
def test_page_of_a_bench(name: str, protocol: Protocol, tmp_path: Path, expected: Expected) -> None:
    page = bench_page(bench_result(tmp_path, protocol=protocol))
    text = f"{words(page)}\n== terminal\n{page.summary}".replace(str(tmp_path), "HERE")
    expected(f"page_{name}", short(text).replace(protocol.hash, "HASH"))
