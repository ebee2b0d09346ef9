"""The list of ``make mutants`` names files, tests and lines that are there."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = runpy.run_path(str(Path(__file__).with_name("mutant_rooms.py")))["ROOMS"]
EXCUSED = json.loads(Path(__file__).with_name("mutants_that_may_live.json").read_text())
FILES = {file for room in ROOMS.values() for file in room}


def test_every_file_of_the_list_is_there() -> None:
    tests = {test for room in ROOMS.values() for each in room.values() for test in each}
    assert len(FILES) > 10 and len(tests) > 10
    assert [name for name in sorted(FILES | tests) if not (ROOT / name).is_file()] == []


def test_every_excused_change_is_of_a_line_that_is_there() -> None:
    """An excuse for a line that was changed or moved to another file excuses nothing."""
    assert set(EXCUSED) <= FILES
    for file, changes in EXCUSED.items():
        lines = {line.strip() for line in (ROOT / file).read_text().splitlines()}
        assert [change for change in changes if change.partition(" -> ")[0] not in lines] == [], file
