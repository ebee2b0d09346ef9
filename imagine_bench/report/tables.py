"""What every report is made of: cells, tables, images, sections and the page; and how numbers are printed."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench import statistics
from imagine_bench.store.files import csv_text

V = TypeVar("V")
DASH = "–"  # printed where there is no number; the table's caption says why


@dataclass(frozen=True)
class Cell:
    """A cell of a table: a value, its interval in brackets, and a second value to compare it with."""

    text: str
    interval: str = ""
    note: str = ""

    def __str__(self) -> str:
        """The cell in one line, as terminal, Markdown and CSV have it."""
        value = f"{self.text} {self.interval}".strip()
        return f"{value}; {self.note}" if self.note else value


@dataclass(frozen=True)
class Table:
    """A table of finished texts; one type for pages, Markdown, CSV and the terminal."""

    name: str  # its id in the page, and the name of its CSV file where it has one
    header: Sequence[str]  # names of the columns
    rows: Sequence[Sequence[str | Cell]]  # as many cells each
    caption: str = ""  # the text below it
    why_dash: str = ""  # why a cell may hold a dash instead of a number; shown where one does
    folded: str = ""  # words to unfold it by; empty for a table that is always shown
    prose: bool = False  # whether its cells hold sentences, which are aligned to the left

    @property
    def cells(self) -> list[list[Cell]]:
        """The rows, every cell in full."""
        return [[cell if isinstance(cell, Cell) else Cell(cell) for cell in row] for row in self.rows]

    @property
    def remark(self) -> str:
        """The caption, and the meaning of a dash where there is one."""
        dash = any(cell.text == DASH for row in self.cells for cell in row)
        return f"{self.caption} {DASH}: {self.why_dash}.".strip() if dash and self.why_dash else self.caption

    @property
    def text(self) -> str:
        """The table for a terminal."""
        rows = [list(map(str, row)) for row in (self.header, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = []
        for first, *others in rows:
            cells = [f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True)]
            lines.append("  ".join([first.ljust(widths[0]), *cells]).rstrip())
        return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])

    @property
    def csv(self) -> str:
        """The table as a CSV file."""
        return csv_text([self.header, *self.rows])

    @property
    def markdown(self) -> str:
        """The table as Markdown."""
        first, *others = (f"| {' | '.join(map(str, row))} |" for row in (self.header, *self.rows))
        return "\n".join([first, f"|{'---|' * len(self.header)}", *others])


def by_budget(
    name: str, first: str, values: Mapping[str, Mapping[int, V]], words: Callable[[V], str | Cell], caption: str = "",
    why_dash: str = "",
) -> Table:  # fmt: skip
    """A table of a row a learner, by title, and a column a budget, each value put into words."""
    budgets = next(iter(values.values()), {})
    rows = [[title, *map(words, row.values())] for title, row in values.items()]
    return Table(name, [first, *(f"{budget:,}" for budget in budgets)], rows, caption, why_dash)


@dataclass(frozen=True)
class Image:
    """An image or figure, drawn when it is first asked for: a table on a terminal needs none."""

    name: str  # file name without ending
    draw: Callable[[], tuple[bytes, str]]  # draws ``png`` and ``svg``
    caption: str  # the text below it

    @classmethod
    def of(cls, name: str, png: bytes, caption: str) -> Image:
        """Wrap a finished image."""
        return cls(name, lambda: (png, ""), caption)

    @cached_property
    def drawn(self) -> tuple[bytes, str]:
        """The image on white, and the same as inline SVG whose text takes the page's color, or an empty text."""
        return self.draw()

    @property
    def png(self) -> bytes:
        """The image, on white."""
        return self.drawn[0]

    @property
    def html(self) -> str:
        """The element that shows it in a page, and needs no other file."""
        png, svg = self.drawn
        data = base64.b64encode(png).decode()
        return svg or f'<img alt="{escape(self.caption)}" src="data:image/png;base64,{data}">'


@dataclass(frozen=True)
class Section:
    """A part of a report."""

    title: str  # its heading
    words: Sequence[str] = ()  # paragraphs
    images: Sequence[Image] = ()  # in their order
    tables: Sequence[Table] = ()  # in their order
    answers: Sequence[str] = ()  # its lines of the verdict at the top


@dataclass(frozen=True, kw_only=True)
class Page:
    """A whole report."""

    title: str  # its heading
    subtitle: str  # preset, execution and the like, in one line
    question: str  # what was asked
    answers: Sequence[str]  # the verdict, one line a finding
    sections: Sequence[Section]  # in their order
    files: Mapping[str, str]  # the CSV files beside the page, by name
    facts: Sequence[tuple[str, str]] = ()  # how it was made: name and value
    settings: Mapping[str, Sequence[tuple[str, str]]] = field(default_factory=dict)  # each learner's, by title
    protocol: Sequence[tuple[str, str]] = ()  # the complete protocol: name and value
    recordings: Sequence[str] = ()  # paths of the recordings, below the bench
    colors: Mapping[str, str] = field(default_factory=dict)  # colors of the learners, by title
    summary: str = ""  # the report on a terminal


def seconds(value: float) -> str:
    """``1,234.5``; not a number as a dash."""
    return DASH if math.isnan(value) else f"{value:,.1f}"


def count(value: float) -> str:
    """``1,234``; not a number as a dash."""
    return DASH if math.isnan(value) else f"{value:,.0f}"


def decimals(value: float) -> str:
    """``2.36``; not a number as a dash."""
    return DASH if math.isnan(value) else f"{value:.2f}"


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits from 1 on, and so many decimals below; not a number as a dash.

    In powers of ten from 100,000 on, and where those decimals would show nothing.
    """
    if math.isnan(value):
        return DASH
    if math.isinf(value):
        return "∞" if value > 0 else "\u2212∞"
    if value and (abs(value) >= 10**5 or abs(value) < 10.0**-digits):
        return f"{value:.{digits - 1}e}".replace("-", "\u2212")
    rounded = float(f"{abs(value):.{digits - 1}e}")  # 9.999 is printed as 10.0
    whole = len(str(int(rounded))) if rounded >= 1 else 0
    return f"{value:.{max(0, digits - whole)}f}".replace("-", "\u2212")


def percent(share: float) -> str:
    """A share as a percentage with one decimal: ``0.6125`` as ``61.3``; not a number as a dash."""
    return DASH if math.isnan(share) else f"{100.0 * share:.1f}"


def signed_percent(share: float) -> str:
    """Like :func:`percent` with a sign, the minus a true one."""
    return DASH if math.isnan(share) else f"{100.0 * share:+.1f}".replace("-", "\u2212")


def p_value(p: float) -> str:
    """``p = 0.012``."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def estimate(found: statistics.Estimate, words: Callable[[float], str] = percent, note: str = "") -> Cell:
    """``61.3`` with ``[55.0, 67.2]``, or without the brackets where there is no interval."""
    interval = "" if math.isnan(found.low) else f"[{words(found.low)}, {words(found.high)}]"
    return Cell(words(found.value), interval, note)


def mean_text(values: Sequence[float], words: Callable[[float], str] = percent) -> str:
    """Mean of a few runs with its 95 % interval; of one run the value alone, and a dash where one has none (NaN)."""
    if any(math.isnan(value) for value in values):
        return DASH
    low, high = statistics.interval(values, trim=0.0, share=words is percent)
    return str(estimate(statistics.Estimate(float(np.mean(values)), low, high), words))


def mean_std(values: Sequence[float] | NDArray[np.float64]) -> str:
    """``2.36 (0.45)``: mean and standard deviation, as the thesis prints them."""
    mean = float(np.mean(values))
    if math.isnan(mean):
        return DASH
    return f"{mean:.2f}" if len(values) < 2 else f"{mean:.2f} ({np.std(values, ddof=1):.2f})"
