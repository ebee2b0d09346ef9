"""What a report is made of: a page of sections with text, figures and tables; and how its numbers are printed."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

DASH = "–"  # printed where there is no number; the table's caption says why


@dataclass(frozen=True, kw_only=True)
class Image:
    """An image or figure, drawn when it is first asked for: a table on a terminal needs none."""

    name: str  # file name without ending
    draw: Callable[[], tuple[bytes, str]]  # draws ``png`` and ``svg``
    alt: str  # what a reader who does not see it should know
    caption: str  # the text below it

    @classmethod
    def of(cls, png: bytes, *, name: str, alt: str, caption: str) -> Image:
        """A finished image."""
        return cls(name=name, draw=lambda: (png, ""), alt=alt, caption=caption)

    @cached_property
    def _drawn(self) -> tuple[bytes, str]:
        return self.draw()

    @property
    def png(self) -> bytes:
        """The image, on white."""
        return self._drawn[0]

    @property
    def svg(self) -> str:
        """The same as inline SVG whose text takes the page's color; empty where there is none."""
        return self._drawn[1]

    @property
    def base64(self) -> str:
        """The image for a data URL."""
        return base64.b64encode(self.png).decode()


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell of a table."""

    text: str  # its value
    interval: str = ""  # an interval, in brackets
    note: str = ""  # a second value to compare with
    # names and values of ``data-`` attributes in the page, for whoever reads it by program
    data: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        """In one line, as Markdown and CSV have it."""
        return "; ".join(part for part in (f"{self.text} {self.interval}".strip(), self.note) if part)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of finished texts."""

    name: str  # its id in the page, and the name of its CSV file where it has one
    header: Sequence[str]  # names of the columns
    rows: Sequence[Sequence[str | Cell]]  # as many cells each
    caption: str = ""  # the text below it
    notes: Sequence[str] = ()  # sentences below that, a line each
    why_dash: str = ""  # why a cell may hold a dash instead of a number; shown where one does
    folded: str = ""  # words to unfold it by; empty for a table that is always shown
    prose: bool = False  # whether its cells hold sentences, which are aligned to the left

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
    """A part of a report."""

    title: str  # its heading
    words: Sequence[str] = ()  # paragraphs
    images: Sequence[Image] = ()  # in their order
    tables: Sequence[Table] = ()  # in their order
    answers: Sequence[str] = ()  # sentences of it that belong into the short answer at the top


@dataclass(frozen=True, kw_only=True)
class Page:
    """A whole report."""

    title: str  # its heading
    subtitle: str  # preset, execution and the like, in one line
    question: str  # what was asked
    answers: Sequence[str]  # the short answer, a sentence each
    sections: Sequence[Section]  # in their order
    facts: Sequence[tuple[str, str]]  # how it was made: name and value
    settings: Mapping[str, Sequence[tuple[str, str]]]  # settings of each learner as run, by title: name and value
    protocol: Sequence[tuple[str, str]]  # the complete protocol: name and value
    recordings: Sequence[str]  # paths of the recordings, below the bench
    files: Mapping[str, str]  # the CSV files beside the page, by name
    colors: Mapping[str, str] = field(default_factory=dict)  # colors of the learners, by title


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
