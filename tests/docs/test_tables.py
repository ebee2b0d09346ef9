"""Every table of README and docs has the numbers of docs/results and of the thesis' data."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest
from doc_cells import KEPT, iqm
from doc_tables import PAGES, tables, unmarked
from information_cells import needed_by_any
from kept import RESULTS, ROOT
from matplotlib.figure import Figure

from imagine_bench.registry import TASKS
from imagine_bench.running.bench import read_protocol
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.fixture
def page_with_tables(request: pytest.FixtureRequest) -> Path:
    """A page. The exact facts of two tasks, which the cells of one page share, are there before it is tested."""
    page: Path = request.param
    if page.name == "certificates.md":
        for task in ("arrow_puzzle", "arrow_puzzle_hard"):
            needed_by_any(task)
    return page


WITH_TABLES = [page for page in PAGES if "<!-- table:" in page.read_text()]


@pytest.mark.parametrize("page_with_tables", WITH_TABLES, ids=name, indirect=True)
def test_tables_say_what_was_kept(page_with_tables: Path) -> None:
    text = page_with_tables.read_text()
    assert text.count("<!-- table:") == len(list(tables(text))), "a comment stands before no table"
    for table in tables(text):
        assert list(table.lines) == table.expected()
        assert not table.misnamed()


def test_a_row_that_has_the_name_of_another_is_found() -> None:
    head = "<!-- table: A=some; rows: A/dqn|A/dqn:controller.updates_per_step=2|A/oracle; price(@,env_steps) -->\n"
    rows = ["| agent | n |", "|---|---|", "| `dqn` | 1 |", "| `dqn`, two updates | 2 |", "| `oracle` | 3 |", ""]
    (right,) = tables(head + "\n".join(rows))
    (wrong,) = tables(head + "\n".join([*rows[:3], rows[4], rows[3], ""]))
    assert not right.misnamed()
    assert wrong.misnamed() == ["oracle", "dqn"]


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "thesis.md"], ids=name)
def test_no_measured_number_stands_in_an_unmarked_table(page: Path) -> None:
    assert not unmarked(page.read_text())


@pytest.mark.parametrize("folder", KEPT, ids=name)
def test_kept_benches_are_read(folder: Path) -> None:
    facts = json.loads((folder / "bench.json").read_text())
    assert list(facts)[:4] == ["protocol", "protocol_hash", "environment", "sessions"]
    assert list(facts)[4:] in ([], ["certificate"])
    read = read_protocol(folder).as_dict()
    assert {field: read[field] for field in facts["protocol"]} == facts["protocol"]
    if facts["protocol"]["task"] in TASKS:
        result = load_so_far(folder)
        assert isinstance(result, BenchResult) and result.protocol_hash == facts["protocol_hash"]


def test_every_kept_folder_is_cited() -> None:
    words = "".join(page.read_text() for page in [*PAGES, ROOT / "docs" / "img" / "draw.py"])
    folders = {path.parent.relative_to(RESULTS).as_posix() for path in RESULTS.rglob("results.csv")}
    folders = {folder for folder in folders if not folder.endswith("/report")}
    assert not [folder for folder in sorted(folders) if folder not in words]


def test_the_figures_of_pages_draw_what_was_kept() -> None:
    draw = runpy.run_path(str(ROOT / "docs" / "img" / "draw.py"), run_name="draw")
    axes = Figure().add_subplot()
    draw["curve"](axes, "arrow_puzzle-2000-episodes", "dqn")
    (line,) = axes.lines
    shown = [f"{value:.1f}" for value in line.get_ydata()]
    assert shown == [iqm(str(budget), "arrow_puzzle-2000-episodes/dqn").split()[0] for budget in line.get_xdata()]
