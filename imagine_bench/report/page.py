"""The parts of every report: tables, images, sections and the page; how numbers are printed, and pages written."""

from __future__ import annotations

import base64
import functools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2
import numpy as np

from imagine_bench import statistics
from imagine_bench.arrays import Floats
from imagine_bench.store.files import csv_text, make_folder, sweep, write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from imagine_bench.store.results import AllRuns, P, R

_TERMINAL = 80  # characters
DASH = "–"  # printed where there is no number; the table's caption says why


@dataclass(frozen=True)
class Table:
    """A table of finished texts; one type for pages, CSV and the terminal."""

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
        """The table for a terminal, at most 80 characters wide: columns that do not fit stand below, in more parts."""
        names, *columns = zip(self.header, *self.rows, strict=True)
        first = _padded(names, str.ljust)
        parts = [[first]]
        for column in columns:
            cells = _padded(column, str.rjust)
            if len(parts[-1]) > 1 and sum(len(each[0]) + 2 for each in (*parts[-1], cells)) - 2 > _TERMINAL:
                parts.append([first])
            parts[-1].append(cells)
        return "\n\n".join(map(_lines, parts))

    @property
    def csv(self) -> str:
        """The table as a CSV file."""
        return csv_text([self.header, *self.rows])


def _padded(cells: Sequence[str], pad: Callable[[str, int], str]) -> list[str]:
    width = max(map(len, cells))
    return [pad(cell, width) for cell in cells]


def _lines(columns: Sequence[Sequence[str]]) -> str:
    """Columns of equally wide cells as text, with a line below the header."""
    header, *others = ["  ".join(row).rstrip() for row in zip(*columns, strict=True)]
    return "\n".join([header, "-" * max(map(len, (header, *others))), *others])


@dataclass(frozen=True)
class Image:
    """An image or figure, drawn when it is first asked for: a table on a terminal needs none."""

    name: str  # file name without ending
    content: bytes | Callable[[], bytes]  # the PNG, or a function that draws it
    caption: str  # the text below it
    draw: Callable[[], Figure] | None = None  # draws it as a matplotlib figure, if it is one

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
    links: Mapping[str, str] = field(default_factory=dict)  # files beside the page: their paths from it, by name


@dataclass(frozen=True, kw_only=True)
class Page:
    """A whole report."""

    title: str  # its heading
    subtitle: str  # preset, execution and the like, in one line
    question: str  # the question
    table: Table  # the one that a terminal shows
    sections: Sequence[Section]  # in their order
    files: Mapping[str, str]  # the CSV files beside the page, by name
    facts: Mapping[str, object]  # how it was made, protocol and settings: JSON-like
    more: Sequence[Table] = ()  # further tables for a terminal

    @property
    def answers(self) -> list[str]:
        """The verdict: the lines of every section, in their order."""
        return [answer for section in self.sections for answer in section.answers]

    @property
    def summary(self) -> str:
        """The report on a terminal."""
        tables = [line for table in (self.table, *self.more) for line in (table.text, "")]
        return "\n".join([self.title, self.subtitle, "", *tables, *self.answers]).rstrip()


# How numbers are printed -------------------------------------------------------------------------------------------


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


def p_level(p: float) -> str:
    """``p < .01``: the smallest of the usual levels above a p-value that shows something."""
    return next(f"p < {level}" for level in (".001", ".01", ".05", "1.01") if p < float(level))


def estimate(found: statistics.Estimate, words: Callable[[float], str] = percent) -> str:
    """``61.3 [55.0, 67.2]``, without the brackets where there is no interval."""
    interval = "" if math.isnan(found.low) else f" [{words(found.low)}, {words(found.high)}]"
    return f"{words(found.value)}{interval}"


def over_seeds(
    values: Sequence[float],
    words: Callable[[float], str] = percent,
    *,
    trials: int | None = None,
    share: bool = False,
) -> str:
    """``95.5 / 91.2 [84.0, 97.6]``: interquartile mean over seeds, mean of all, and 95 % interval.

    The mean stands there where the other leaves seeds out. Too few seeds have, for an interval, ``(90.0 to 97.5)``, the
    lowest and the highest. No number is a dash; ``trials`` and ``share`` are as in :func:`.statistics.bounds`.
    """
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return DASH
    middle = words(statistics.iqm(known))
    if statistics.left_out(len(known)) and min(known) < max(known):
        middle += f" / {words(float(np.mean(known)))}"
    low, high = statistics.interval(known, trials=trials, share=share)
    ends = f"[{words(low)}, {words(high)}]"
    if math.isnan(low):
        low, high = min(known), max(known)
        ends = f"({words(low)} to {words(high)})"
    return middle if low == high else f"{middle} {ends}"


def seeds_note(seeds: int) -> str:
    """The names of the figures that :func:`over_seeds` shows of so many seeds."""
    out = statistics.left_out(seeds)
    middle = f"interquartile mean ({out} of {seeds} seeds left out) / mean of all" if out else "mean over seeds"
    if seeds < statistics.FEWEST:
        return f"{middle} (lowest to highest seed; too few for an interval)"
    return f"{middle} [95 % interval, of seeds and starts]"


def mean_std(values: Sequence[float] | Floats) -> str:
    """``2.36 (0.45)``: mean and standard deviation, as the thesis prints them; the mean alone of one value."""
    mean = decimals(float(np.mean(values)))
    return mean if mean == DASH or len(values) < 2 else f"{mean} ({np.std(values, ddof=1):.2f})"


# How pages are written ---------------------------------------------------------------------------------------------


def write_page(folder: Path, page: Page) -> Path:
    """Write a report: index.html, whose path is returned, the page's CSV files and images.

    Raises:
        SetupError: The folder cannot be written.
    """
    sweep(make_folder(folder), older_than_s=3600.0)  # another may write the same report
    files = {name: content.encode() for name, content in texts(page).items()}
    files |= {f"{image.name}.png": image.png for section in page.sections for image in section.images}
    for name, content in files.items():
        write_bytes(folder / name, content)
    others = sorted(path.name for path in folder.iterdir() if path.name not in files)
    if others:
        print(f"Note: {folder} also holds {', '.join(others)}, of an earlier report or of somebody else.")
    return folder / "index.html"


def texts(page: Page, *, images: bool = True) -> dict[str, str]:
    """The files of a report, by name, but for its images; these are in the page too, unless they need not be drawn."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("imagine_bench.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["base64"] = lambda image: base64.b64encode(image.png).decode() if images else ""
    environment.filters["json"] = functools.partial(json.dumps, indent=1, ensure_ascii=False)
    return {**page.files, "index.html": environment.get_template("page.html.j2").render(page=page)}


def made(result: AllRuns[P, R]) -> dict[str, object]:
    """How a result of any kind was made: the facts of its Page, with the settings of its learners by name.

    All seeds of a learner have the same settings.
    """
    environment = result.environment
    commit = str(environment.get("commit") or "").partition("+")[0]
    where = f"git checkout {commit} && " if commit else ""
    settings = {name: result.of(name)[0].settings for name in result.protocol.agents}
    return {
        "reproduce": f"{where}{environment.get('command', '')}",
        **environment,
        "protocol": {"hash": result.protocol_hash, **result.protocol.as_dict()},
        "settings": settings,
    }
