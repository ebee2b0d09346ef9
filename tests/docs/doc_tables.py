"""Tables of the pages, recomputed from docs/results.

A comment before a table names its folders and describes its cells, in the words of :data:`.CELLS`, a call a column:

    <!-- table: A=arrow_puzzle-quick; iqm(@,A/dqn)|average(@,A/random) -->

``@`` is the number in the row's first cell or, where the comment has ``rows: ...|...;``, the row's own arguments.
``text`` is a column of words. Below a table that compares stand the meaning of its bold cells and the smallest
difference that it could have shown. ``python tests/docs/doc_tables.py`` writes all that anew.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from doc_cells import CELLS, ITALIC, Compared
from kept import ROOT

from imagine_bench import statistics

PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.parent.name != "report")]
"""All but the reports that somebody has written of kept results, which git ignores."""
_MARKED = re.compile(
    r"<!-- table: (?P<spec>.*?) -->\n(?P<table>(?:\|[^\n]*\n)+(?:\n\*(?:Bold|Too few)[^\n]*\*\n)?)", re.DOTALL
)


@dataclass(frozen=True)
class Table:
    """A marked table: where its text lies in the page, its lines, and the right text."""

    start: int
    end: int
    lines: tuple[str, ...]
    spec: str

    @property
    def entries(self) -> list[str]:
        """The arguments of each row, where the comment names them."""
        parts = self.spec.split("; ")
        return next((part.removeprefix("rows: ").split("|") for part in parts if part.startswith("rows:")), [])

    @property
    def rows(self) -> list[list[Any]]:
        """The cells of each row, as they are."""
        return [_cells(line) for line in self.lines[2:] if line.startswith("|")]

    def misnamed(self) -> list[str]:
        """Names of rows that are words of another row's arguments, and not of their own."""
        words = [{word.partition(":")[0] for word in re.split(r"[,/]", entry)} for entry in self.entries]
        names = [re.findall(r"`([^`:]+)", row[0]) for row in self.rows]
        return [
            name
            for own, row in zip(words, names, strict=False)
            for name in row
            if name not in own and any(name in others for others in words)
        ]

    def expected(self) -> list[str]:
        """The lines as they should be."""
        *before, columns = self.spec.split("; ")
        folders = dict(pair.split("=") for part in before if not part.startswith("rows:") for pair in part.split())
        entries, specs, rows = self.entries, columns.split("|"), self.rows
        if entries and len(entries) != len(rows):
            raise ValueError(f"{len(entries)} rows are named and {len(rows)} are there: {self.lines[0]}")
        for index, row in enumerate(rows):
            key = entries[index] if entries else re.sub(r"[^\d]", "", row[0])
            if len(row) != len(specs) + 1:
                raise ValueError(f"{len(specs)} columns are named and {len(row) - 1} are there: {row}")
            values = [_cell(spec.replace("@", key), folders) for spec in specs]
            rows[index] = [row[0], *(old if new is None else new for old, new in zip(row[1:], values, strict=True))]
        tests = [part for row in rows for cell in row if isinstance(cell, list) for part in cell]
        is_shown = statistics.holm([test.p for test in tests]) < 1.0 - statistics.LEVEL
        worse = any(test.mark == ITALIC for test, shown in zip(tests, is_shown, strict=True) if shown)
        each = iter(is_shown)
        texts = [[_text(cell, each) if isinstance(cell, list) else cell for cell in row] for row in rows]
        return [*self.lines[:2], *("| " + " | ".join(row) + " |" for row in texts), *_caption(tests, worse=worse)]


def tables(text: str) -> Iterator[Table]:
    """The marked tables of a page."""
    for found in _MARKED.finditer(text):
        lines = found["table"].rstrip("\n").split("\n")
        yield Table(found.start("table"), found.end("table"), tuple(lines), " ".join(found["spec"].split()))


def unmarked(text: str) -> list[str]:
    """Heads of the tables that no comment describes and that hold a measured number: a decimal, or a share."""
    blocks = re.findall(r"(?:^[^|\n][^\n]*\n)?(?:^\|[^\n]*\n)+", text, re.MULTILINE)
    plain = [re.sub(r"`[^`]*`|\]\([^)]*\)", "", block) for block in blocks if not block.startswith("<!--")]
    return [block.split("\n")[0] for block in plain if re.search(r"\d\.\d|\d ?%", block)]


def _text(parts: list[Compared], is_shown: Iterator[bool]) -> str:
    return "; ".join(f"{part.mark}{part.text}{part.mark}" if next(is_shown) else part.text for part in parts)


def _caption(tests: Sequence[Compared], *, worse: bool) -> list[str]:
    if not tests:
        return []
    tested = [test for test in tests if not np.isnan(test.p)]
    sizes = [min(100.0 * test.detectable(cells=len(tested)), 100.0) for test in tested]
    sizes = [size for size in sizes if not np.isnan(size)]
    if not sizes:
        return ["", f"*Too few seeds to say which is better: none of {len(tests)} comparisons can be shown.*"]
    least, most = (f"{size:.1f}" if size < 9.95 else f"{size:.0f}" for size in (min(sizes), max(sizes)))
    could = f"{least} to {most} points (by cell)" if least != most else f"{least} points"
    few = f" In {len(tests) - len(sizes)} cells there are too few seeds for a test." if len(sizes) < len(tests) else ""
    kind = "it is shown to be better. Italics: it is shown to be worse" if worse else "the difference is shown"
    bold = f"Bold: {kind} (p < 0.05, corrected for {len(tested)} tests)."
    return ["", f"*{bold} A true difference of {could} would be shown with a probability of 80 %.{few}*"]


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _cell(spec: str, folders: Mapping[str, str]) -> str | list[Compared] | None:
    if spec == "text":
        return None
    name, _, arguments = spec.removesuffix(")").partition("(")
    (values,) = csv.reader([arguments]) if arguments else ([],)
    return CELLS[name](*(re.sub(r"^[A-Z]\b(?=/|$)", lambda found: folders[found[0]], value) for value in values))


def rewritten(text: str) -> str:
    """A page with every marked table as it should be."""
    for table in reversed(list(tables(text))):
        text = text[: table.start] + "\n".join(table.expected()) + "\n" + text[table.end :]
    return text


def main(pages: Sequence[str]) -> None:
    """Write the tables of some pages, or of all, anew."""
    for page in [Path(name) for name in pages] or PAGES:
        page.write_text(rewritten(page.read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
