"""Whole outputs compared with kept files, and the same files written again.

A test of ``tests/whole`` makes the whole output of a command or of a pipeline, as text, and compares it with
``tests/whole/expected/NAME.txt``. ``make test ARGS='tests/whole --write-expected'`` writes the files again; read the
difference with git before you commit it, for a file says what was, and only a reader says whether it is right.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

KEPT = Path(__file__).parent / "expected"
DECIMAL = re.compile(r"-?\d+\.\d+")


def matches(found: str, kept: str) -> bool:
    """Whether two lines are equal, but for one unit in the last digit of numbers that have a decimal point.

    Processors round differently: 0.1235 may be 0.1234 on another.
    """
    if DECIMAL.sub("#", found) != DECIMAL.sub("#", kept):
        return False
    for one, other in zip(DECIMAL.findall(found), DECIMAL.findall(kept), strict=True):
        digits = max(len(each.partition(".")[2]) for each in (one, other))
        if abs(float(one) - float(other)) > 1.001 * 10**-digits:
            return False
    return True


def difference(found: str, kept: str, *, exactly: bool = True) -> str:
    """A unified difference of two texts, empty where they match."""
    ours, theirs = found.splitlines(), kept.splitlines()
    if not exactly and len(ours) == len(theirs):
        ours = [old if matches(new, old) else new for new, old in zip(ours, theirs, strict=True)]
    return "\n".join(difflib.unified_diff(theirs, ours, "kept", "found", lineterm="", n=2))


class Expected:
    """Compares a text with the kept one of a name, or keeps it."""

    def __init__(self, write: bool, folder: Path = KEPT) -> None:
        self._write = write
        self._folder = folder

    def __call__(self, name: str, text: str, *, section: str = "", exactly: bool = True) -> None:
        """Fail with the difference; ``exactly=False`` lets the last digit of decimal numbers be one off.

        Args:
            name: Of the file.
            text: The whole output.
            section: The part of the file that this test compares; without it, all.
            exactly: Whether every digit counts.
        """
        file = self._folder / f"{name}.txt"
        text = "\n".join(line.rstrip() for line in text.strip("\n").splitlines()) + "\n"
        sections = _sections(file)
        kept = sections.get(section)
        found = "missing" if kept is None else difference(text, kept, exactly=exactly)
        if found and self._write:
            sections[section] = text
            parts = (f"==== {part}\n{sections[part]}" if part else sections[part] for part in sorted(sections))
            file.write_text("".join(parts), encoding="utf-8")
        elif found:
            where = f"{file.name} {section}".strip()
            pytest.fail(f"not the output of {where}; if it is right: --write-expected\n{found}", pytrace=False)


def expected_of(config: pytest.Config) -> Expected:
    """The comparison of a session, also of plug-ins' tests, which do not know the fixture."""
    return Expected(write=bool(config.getoption("--write-expected", default=False)))


def _sections(file: Path) -> dict[str, str]:
    """The text of each section of a file; that before any has an empty name."""
    if not file.exists():
        return {}
    first, *others = re.split(r"^==== (.*)\n", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = {"": first} if first else {}
    return found | dict(zip(others[::2], others[1::2], strict=True))


def questions(name: str) -> list[str]:
    """The lines of a kept file behind ``$``; the answer to each stands below it."""
    return re.findall(r"^\$ (.*)$", (KEPT / f"{name}.txt").read_text(encoding="utf-8"), re.MULTILINE)


def masked(text: str, folder: Path | None = None) -> str:
    """A text without digests, and with HERE for a folder."""
    text = text if folder is None else text.replace(str(folder), "HERE")
    return re.sub(r"\b(?<!\.)(?=[0-9a-f]*[a-f])[0-9a-f]{12,64}\b", "DIGEST", text)


def short(text: str) -> str:
    """A text whose decimal numbers have at most five significant digits, of which processors agree."""
    return re.sub(r"-?\d+\.\d{5,}(e-?\d+)?", lambda found: f"{float(found[0]):.5g}", text)


def rounded(value: object, digits: int = 3) -> str:
    """Numbers with so many significant digits; arrays and sequences in brackets; all else as text."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    if isinstance(value, float | np.floating):
        number = 0.0 if abs(value) < 10**-9 else float(value)
        return f"{number:.{digits}g}" if np.isfinite(number) else str(number)
    if isinstance(value, dict):
        return ", ".join(f"{name}: {rounded(each, digits)}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return "[" + " ".join(rounded(each, digits) for each in value) + "]"
    return str(value)


def tabulated(rows: Iterable[Iterable[object]], digits: int = 3) -> str:
    """Rows as lines, their cells rounded and separated by two spaces or more."""
    cells = [[rounded(cell, digits) for cell in row] for row in rows]
    count = max((len(row) for row in cells), default=0)
    widths = [max((len(row[place]) for row in cells if place < len(row)), default=0) for place in range(count)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)) for row in cells)
