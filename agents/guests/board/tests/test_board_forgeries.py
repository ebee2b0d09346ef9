"""Forged rows of a leaderboard are refused, or the forged claim is marked as not vouched."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from board_forging import BoardForger, honest_board
from board_kinds import KINDS
from imagine_bench_board.check import Checked, check
from imagine_bench_board.page import board_page
from imagine_bench_board.rows import Row

VARIANTS = 23
"""Of each kind, of which two are fast: 529 forgeries."""


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return honest_board(tmp_path_factory.mktemp("honest"))


def verdict(honest: Path, root: Path, kind: str, variant: int) -> Checked:
    """The finding about a forged row, in the board that holds it."""
    rng = np.random.default_rng([list(KINDS).index(kind), variant])
    forger = BoardForger(honest, root, rng)
    row = KINDS[kind][0](forger)
    (found,) = [each for each in check(forger.board) if each.verdict.what == row.folder.name]
    shutil.rmtree(root)
    return found


WORLD = "arrow_puzzle, kinematic, clean"


def is_never_silent(found: Checked, claim: str) -> bool:
    """Refused; or held in the table of another world, or where the forged claim is not vouched."""
    if found.row is None:
        return bool(found.verdict.complaint) and "\n" not in str(found)
    if f"holds in {WORLD}; " not in str(found):
        return found.row.world != WORLD and found.row.world in str(found)
    return claim in found.verdict.unshown and f"not vouched: {', '.join(found.verdict.unshown)}" in str(found)


def test_honest_rows_hold(honest: Path) -> None:
    found = check(honest)
    assert [each.verdict.complaint for each in found] == [""] * 8
    assert Counter(each.row.starts for each in found if each.row) == {"open starts": 4, "round winter": 4}
    last = {
        row.name: np.mean([each.successes for each in row.vouched][-1 :: -len(row.protocol.budgets)])
        / row.protocol.evaluation_episodes
        for row in (each.row for each in found)
        if isinstance(row, Row)
    }
    table = board_page(found).sections[0].tables[0]
    shown = [last[re.split('"|[.]html', row[1])[1]] for row in table.rows if "href" in row[1]]
    assert shown == sorted(last.values(), reverse=True), "the best come first"


@pytest.mark.parametrize("variants", [range(2), pytest.param(range(2, VARIANTS), marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_forged_row_is_refused_or_marked(honest: Path, tmp_path: Path, kind: str, variants: range) -> None:
    for variant in variants:
        found = verdict(honest, tmp_path / str(variant), kind, variant)
        assert is_never_silent(found, KINDS[kind][1]), (kind, variant, str(found))
