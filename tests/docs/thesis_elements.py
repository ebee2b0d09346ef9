"""The page docs/thesis.md, made from docs/thesis.csv: every element of the thesis, its place and its result.

``python tests/docs/thesis_elements.py`` writes it anew. In a cell, ``{iqm(500,arrow_puzzle-quick/dqn)}`` is what
:mod:`doc_cells` computes from the kept results.
"""

from __future__ import annotations

import csv
import itertools
import re
from collections import Counter

from doc_cells import CELLS, Compared
from kept import ROOT

ELEMENTS, PAGE = ROOT / "docs" / "thesis.csv", ROOT / "docs" / "thesis.md"
VERDICTS = {
    "built": "it is there and tested; there is nothing to compare",
    "agrees": "as in the thesis",
    "contradicts": "otherwise than in the thesis",
    "cannot be told": "measured, and nothing is shown: too few seeds, one encoder, or a base with nothing left to gain",
    "open": "not measured as the thesis means it",
    "missing": "not there",
    "not used": "the thesis speaks of it and does not use it",
}
CHAPTERS = {
    "2": "Background", "3": "Imagination", "4": "Uncertainty", "5": "Imagination beside reality", "6": "Future work",
    "A": "Appendix",
}  # fmt: skip


def elements() -> list[dict[str, str]]:
    with ELEMENTS.open() as file:
        return list(csv.DictReader(file))


def filled(text: str) -> str:
    """A cell with its figures."""

    def figure(found: re.Match[str]) -> str:
        name, _, arguments = found[1].removesuffix(")").partition("(")
        (values,) = csv.reader([arguments])
        cell = CELLS[name](*values)
        return cell if isinstance(cell, str) else ", ".join(part.text for part in cell if isinstance(part, Compared))

    return re.sub(r"\{([^}]*)\}", figure, text)


def page() -> str:
    """The page as it should be."""
    rows = elements()
    counts = Counter(row["verdict"] for row in rows)
    lines = [
        "# What does the thesis claim, and what holds here?",
        "",
        "Mohammad Thabet's thesis (*Imagination-Augmented Deep Reinforcement Learning for Robotic Applications*, "
        "Manchester, 2022) trains a DQN on transitions that a learned model imagines, and discards those of high "
        "epistemic uncertainty. Imagination saves real experience here too while it is scarce, [with other "
        "settings](explanation/imagination.md); a gain by the filter is not shown.",
        "",
        f"{len(rows)} elements: " + ", ".join(f"{counts[word]} {word}" for word in VERDICTS if counts[word]) + ".",
        "",
        *(f"- *{word}*: {meaning}" for word, meaning in VERDICTS.items() if counts[word]),
        "",
        "Made from [thesis.csv](thesis.csv), which names a test of each. Intervals are of 95 %.",
    ]
    for chapter, group in itertools.groupby(rows, lambda row: row["section"][0]):
        lines += ["", f"## {CHAPTERS[chapter]}", "", "| section | element | code | here | thesis | verdict |"]
        lines.append("|---" * 6 + "|")
        for row in group:
            code = f"`{row['code']}`" if row["code"] else ""
            here = filled(row["here"])
            here = f"{here} [more]({row['page']})".strip() if row["page"] else here
            cells = [row["section"], row["element"], code, here, filled(row["thesis"]), row["verdict"]]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def missing(row: dict[str, str]) -> list[str]:
    """Names of an element that are not there."""
    lacks = [] if not row["code"] or (ROOT / row["code"]).is_file() else [row["code"]]
    if row["page"] and not (ROOT / "docs" / row["page"]).is_file():
        lacks.append(row["page"])
    file, _, name = row["tests"].partition("::")
    path = ROOT / file if file.startswith("agents/guests/") else ROOT / "tests" / file
    if file and not (path.is_file() and f"def test_{name}(" in path.read_text()):
        lacks.append(row["tests"])
    return lacks


if __name__ == "__main__":
    PAGE.write_text(page())
