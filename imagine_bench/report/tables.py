"""What every report is made of: cells, tables, images, sections and the page; and how numbers are printed."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imagine_bench import statistics
from imagine_bench.store.files import csv_text

DASH = "–"  # printed where there is no number; the table's caption says why


@dataclass(frozen=True)
class Table:
    """A table of finished texts; one type for pages, Markdown, CSV and the terminal."""

    name: str  # its id in the page, and the name of its CSV file where it has one
    header: Sequence[str]  # names of the columns
    rows: Sequence[Sequence[str]]  # as many cells each
    caption: str = ""  # the text below it
    why_dash: str = ""  # why a cell may hold a dash instead of a number; shown where one does
    folded: str = ""  # words to unfold it by; empty for a table that is always shown
    prose: bool = False  # whether its cells hold sentences, which are aligned to the left

    @classmethod
    def of(cls, name: str, rows: Sequence[Mapping[str, str]], caption: str = "", why_dash: str = "") -> Table:
        """A table of rows by column, each with the same ones."""
        header = list(rows[0]) if rows else []
        return cls(name, header, [list(row.values()) for row in rows], caption, why_dash)

    @property
    def remark(self) -> str:
        """The caption, and the meaning of a dash where there is one."""
        dash = any(cell.startswith(DASH) for row in self.rows for cell in row)
        return f"{self.caption} {DASH}: {self.why_dash}.".strip() if dash and self.why_dash else self.caption

    @property
    def text(self) -> str:
        """The table for a terminal."""
        rows = [self.header, *self.rows]
        first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
        lines = []
        for name, *others in rows:
            cells = map(str.rjust, others, widths)
            lines.append("  ".join([name.ljust(first), *cells]).rstrip())
        return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])

    @property
    def csv(self) -> str:
        """The table as a CSV file."""
        return csv_text([self.header, *self.rows])

    @property
    def markdown(self) -> str:
        """The table as Markdown."""
        first, *others = (f"| {' | '.join(map(markdown_text, row))} |" for row in (self.header, *self.rows))
        return "\n".join([first, f"|{'---|' * len(self.header)}", *others])


@dataclass(frozen=True)
class Image:
    """An image or figure, drawn when it is first asked for: a table on a terminal needs none."""

    name: str  # file name without ending
    content: bytes | Callable[[], bytes]  # the PNG, or what draws it
    caption: str  # the text below it

    @cached_property
    def png(self) -> bytes:
        """The image, on white."""
        return self.content if isinstance(self.content, bytes) else self.content()


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
    summary: str = ""  # the report on a terminal


def markdown_text(value: object) -> str:
    """A text as Markdown shows it unchanged: in a line, its special characters escaped."""
    return re.sub(r"([\\`*_<>|&~]|^#|(?<=\])(?=\())", r"\\\1", " ".join(str(value).split()))


def printed(value: float, form: str) -> str:
    """A number in a format of Python's, with the minus a true one; not a number as a dash."""
    return DASH if math.isnan(value) else format(value, form).replace("-", "\u2212")


seconds = functools.partial(printed, form=",.1f")  # 1,234.5
count = functools.partial(printed, form=",.0f")  # 1,234
decimals = functools.partial(printed, form=".2f")  # 2.36


def percent(share: float) -> str:
    """A share as a percentage with one decimal: ``0.6125`` as ``61.3``."""
    return printed(100.0 * share, ".1f")


def signed_percent(share: float) -> str:
    """Like :func:`percent` with a sign."""
    return printed(100.0 * share, "+.1f")


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits from 1 on, and so many decimals below; not a number as a dash.

    In powers of ten from 100,000 on, and where those decimals would show nothing.
    """
    if math.isinf(value):
        return "∞" if value > 0 else "\u2212∞"
    if value and (abs(value) >= 10**5 or abs(value) < 10.0**-digits):
        return printed(value, f".{digits - 1}e")
    rounded = float(f"{abs(value):.{digits - 1}e}")  # 9.999 is printed as 10.0
    whole = len(str(int(rounded))) if rounded >= 1 else 0
    return printed(value, f".{max(0, digits - whole)}f")


def p_value(p: float) -> str:
    """``p = 0.012``."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def estimate(found: statistics.Estimate, words: Callable[[float], str] = percent, note: str = "") -> str:
    """``61.3 [55.0, 67.2]`` and a note, without the brackets where there is no interval."""
    interval = "" if math.isnan(found.low) else f" [{words(found.low)}, {words(found.high)}]"
    return f"{words(found.value)}{interval}{note}"


def over_seeds(values: Sequence[float], words: Callable[[float], str] = percent, *, share: bool = False) -> str:
    """Interquartile mean over seeds with its 95 % interval, of a ``share`` in [0, 1]; a dash for no number."""
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return DASH
    low, high = statistics.interval(known, share=share)
    return estimate(statistics.Estimate(statistics.iqm(known), math.nan if low == high else low, high), words)


def mean_std(values: Sequence[float] | NDArray[np.float64]) -> str:
    """``2.36 (0.45)``: mean and standard deviation, as the thesis prints them; the mean alone of one value."""
    mean = decimals(float(np.mean(values)))
    return mean if mean == DASH or len(values) < 2 else f"{mean} ({np.std(values, ddof=1):.2f})"
