"""What a report is made of: a page of sections with text, figures and tables; and how its numbers are printed."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

DASH = "–"
"""Printed where there is no number; the table's caption says why."""


@dataclass(frozen=True, kw_only=True)
class Image:
    """A finished image or figure.

    Attributes:
        name: File name without ending.
        png: The image, on white.
        alt: What a reader who does not see it should know.
        caption: The text below it.
        svg: The same as inline SVG whose text takes the page's color; empty where there is none.
    """

    name: str
    png: bytes
    alt: str
    caption: str
    svg: str = ""

    @property
    def base64(self) -> str:
        """The image for a data URL."""
        return base64.b64encode(self.png).decode()


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell of a table.

    Attributes:
        text: Its value.
        interval: An interval, in brackets.
        note: A second value to compare with.
        data: Names and values of ``data-`` attributes in the page, for whoever reads it by program.
    """

    text: str
    interval: str = ""
    note: str = ""
    data: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        """In one line, as Markdown and CSV have it."""
        return "; ".join(part for part in (f"{self.text} {self.interval}".strip(), self.note) if part)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of finished texts.

    Attributes:
        name: Its id in the page, and the name of its CSV file where it has one.
        header: Names of the columns.
        rows: As many cells each.
        caption: The text below it.
        why_dash: Why a cell may hold a dash instead of a number; shown where one does.
        folded: Words to unfold it by; empty for a table that is always shown.
        prose: Whether its cells hold sentences, which are aligned to the left.
    """

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    caption: str = ""
    why_dash: str = ""
    folded: str = ""
    prose: bool = False

    @property
    def cells(self) -> list[list[Cell]]:
        """The rows, every cell in full."""
        return [[cell if isinstance(cell, Cell) else Cell(text=cell) for cell in row] for row in self.rows]

    @property
    def remark(self) -> str:
        """The caption, and what a dash means where there is one."""
        dash = any(cell.text == DASH for row in self.cells for cell in row)
        return f"{self.caption} {DASH}: {self.why_dash}.".strip() if dash and self.why_dash else self.caption


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a report.

    Attributes:
        title: Its heading.
        words: Paragraphs.
        images: In their order.
        tables: In their order.
        answers: Sentences of it that belong into the short answer at the top.
    """

    title: str
    words: Sequence[str] = ()
    images: Sequence[Image] = ()
    tables: Sequence[Table] = ()
    answers: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class Page:
    """A whole report.

    Attributes:
        title: Its heading.
        subtitle: Preset, execution and the like, in one line.
        question: What was asked.
        answers: The short answer, a sentence each.
        sections: In their order.
        facts: How it was made: name and value.
        settings: Settings of each learner as run, by title: name and value.
        protocol: The complete protocol: name and value.
        recordings: Paths of the recordings, below the bench.
        files: The CSV files beside the page, by name.
        colors: Colors of the learners, by title.
    """

    title: str
    subtitle: str
    question: str
    answers: Sequence[str]
    sections: Sequence[Section]
    facts: Sequence[tuple[str, str]]
    settings: Mapping[str, Sequence[tuple[str, str]]]
    protocol: Sequence[tuple[str, str]]
    recordings: Sequence[str]
    files: Mapping[str, str]
    colors: Mapping[str, str] = field(default_factory=dict)


def seconds(value: float) -> str:
    """``1,234.5``; not a number as a dash."""
    return DASH if math.isnan(value) else f"{value:,.1f}"


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits from 1 on, and so many decimals below; not a number as a dash.

    In powers of ten from 100,000 on, and where those decimals would show nothing.
    """
    if not math.isfinite(value):
        return DASH if math.isnan(value) else "\u221e".rjust(1 + (value < 0), "\u2212")
    if value and (abs(value) >= 10**5 or abs(value) < 10.0**-digits):
        return f"{value:.{digits - 1}e}".replace("-", "\u2212")
    rounded = float(f"{abs(value):.{digits - 1}e}")  # 9.999 is printed as 10.0
    whole = len(str(int(rounded))) if rounded >= 1 else 0
    return f"{value:.{max(0, digits - whole)}f}".replace("-", "\u2212")


def mean_std(values: Sequence[float] | NDArray[np.float64]) -> str:
    """``2.36 (0.45)``: mean and standard deviation, as the thesis prints them."""
    mean = float(np.mean(values))
    if math.isnan(mean):
        return DASH
    return f"{mean:.2f}" if len(values) < 2 else f"{mean:.2f} ({np.std(values, ddof=1):.2f})"
