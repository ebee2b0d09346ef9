"""What a report is made of where its content is not fixed: sections of words, tables and pictures."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from imagine_bench.report.plots import STYLE


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A finished picture.

    Attributes:
        name: File name without ending.
        png: The picture, on white.
        alt: What a reader who does not see it should know.
        caption: What stands below it.
    """

    name: str
    png: bytes
    alt: str
    caption: str

    @property
    def base64(self) -> str:
        """The picture for a data URL."""
        return base64.b64encode(self.png).decode()


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of finished texts.

    Attributes:
        name: File name without ending, for its CSV.
        header: Names of the columns.
        rows: As many cells each.
        caption: What stands below it.
    """

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of a report.

    Attributes:
        title: Its heading.
        words: Paragraphs.
        pictures: In their order.
        tables: In their order.
        answers: Sentences of it that belong into the short answer at the top.
    """

    title: str
    words: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    answers: Sequence[str] = field(default_factory=tuple)


def picture(name: str, draw: Callable[[], Figure], *, alt: str, caption: str, dpi: int = 150) -> Picture:
    """Draw a figure in the style of all reports."""
    with mpl.rc_context(STYLE):
        content = io.BytesIO()
        draw().savefig(content, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    return Picture(name=name, png=content.getvalue(), alt=alt, caption=caption)


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits from 1 on, and so many decimals below; not a number as an en dash.

    In powers of ten from 100,000 on, and where those decimals would show nothing.
    """
    if math.isnan(value):
        return "–"
    if value and (abs(value) >= 10**5 or abs(value) < 10.0**-digits):
        return f"{value:.{digits - 1}e}".replace("-", "\u2212")
    rounded = float(f"{abs(value):.{digits - 1}e}")  # 9.999 is printed as 10.0
    whole = len(str(int(rounded))) if rounded >= 1 else 0
    return f"{value:.{max(0, digits - whole)}f}".replace("-", "\u2212")


def mean_std(values: Sequence[float] | NDArray[np.float64]) -> str:
    """``2.36 (0.45)``: mean and standard deviation, as the thesis prints them."""
    count = len(values)
    mean = sum(values) / count
    if math.isnan(mean):
        return "–"
    if count < 2:
        return f"{mean:.2f}"
    spread = (sum((value - mean) ** 2 for value in values) / (count - 1)) ** 0.5
    return f"{mean:.2f} ({spread:.2f})"
