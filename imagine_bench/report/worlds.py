"""The section of a judgement's report on questions about a whole world: families by models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from imagine_bench.judge.worlds.families import STREAM
from imagine_bench.judge.worlds.making import QUERIES
from imagine_bench.judge.worlds.scores import GRAPH, MARGIN
from imagine_bench.report.page import DASH, Section, Table, count, percent
from imagine_bench.statistics import iqm
from imagine_bench.store.files import table_text

_ENDS = ("chance", "copy", "exact")
_MARK = " *"
_WORDS = (
    "Each question shows frames and macro-actions and has a few possible answers, whose exact probabilities follow "
    "from the rules. A model's answers follow in the same way from its one-step predictions, as the reader reads them. "
    "The score is the exact probability of the answer that the model holds likeliest, in percent. So the best possible "
    "score, that of “exact”, is below 100 where chance decides.",
    "Masked frame: two macro-actions, and the image between them is hidden; choose it. Shortest plan: how many "
    "macro-actions until a shown image has probably come up? Reachability: does it come up within so many? Changed "
    f"rule: after how many of {STREAM} transitions did one macro-action also get the effect of another? Which of two "
    f"worlds: do {STREAM} transitions come from a world in which macro-actions slip? Luck alone: can slips explain "
    "them, or was another macro-action carried out once? Must it change: does a factor of the outcome depend on the "
    "one cause in which two starts differ?",
    "Single-cause pairs: two starts differ in one cause, and the same macro-action follows. A pair counts only if the "
    "outcome of both members is chosen right. (In What-If World, arXiv 2605.27589, none of nine models is above 52 %, "
    "open ones are near 28 %, and some causes that are hard to see have 14 %. That is another test, with other scenes "
    "and a rubric.)",
)
Cells = Mapping[str, Sequence[Mapping[str, Any]]]
"""The cells of each model, one for each seed."""


def worlds_section(cells: Cells, titles: Mapping[str, str]) -> Section | None:
    """The section, of cells at the most transitions; None where none has such scores.

    The columns copy and exact are enumerated, whether or not these models were judged.
    """
    scores = {model: [cell["worlds"] for cell in each if cell.get("worlds")] for model, each in cells.items()}
    known = {model: each for model, each in scores.items() if each}
    if not known:
        return None
    one = next(iter(known.values()))[0]
    models = [model for model in known if model not in _ENDS]
    header = ["family", *_ENDS, *(titles[model] for model in models)]
    rows = []
    for family, score in one.items():
        if family == GRAPH:
            continue
        marked = _MARK if score["copy"] > score["chance"] + MARGIN else ""
        held = [percent(iqm([each[family]["right"] for each in known[model]])) for model in models]
        rows.append([_indented(family) + marked, *(percent(score[end]) for end in _ENDS), *held])
    graphs = {model: [each[GRAPH] for each in known[model] if GRAPH in each] for model in models}
    offered = [each for each in graphs.values() if each]
    if offered:
        wrong = {model: iqm([graph["edges_wrong"] for graph in each]) for model, each in graphs.items() if each}
        held = [count(wrong[model]) if model in wrong else DASH for model in models]
        rows.append([f"{GRAPH}: wrong edges", DASH, count(offered[0][0]["edges"]), "0", *held])
    caption = (
        f"Percent; {QUERIES} questions a family. {_MARK.strip()}: to say that nothing changes is better than chance "
        "there, so the family alone shows little. Wrong edges: structural Hamming distance of the learned factor "
        "graph, under copy the number of edges that there are."
    )
    return Section(
        "Questions about the whole world",
        _WORDS,
        tables=[Table("worlds", header, rows, caption, "not offered by the model")],
    )


def _indented(family: str) -> str:
    """Causes stand below the family of pairs."""
    return f"  {family}" if family.startswith("only the ") else family


def worlds_csv(cells: Mapping[tuple[str, int], Sequence[Mapping[str, Any]]]) -> str:
    """Every score of every cell, a row a family."""
    names = ("right", "brier", *_ENDS, "edges_wrong", "edges")
    rows: list[dict[str, float | str]] = []
    for (model, transitions), each in cells.items():
        for cell in each:
            for family, scores in cell.get("worlds", {}).items():
                values = {name: scores.get(name, math.nan) for name in names}
                written = {name: "" if math.isnan(value) else f"{value:.6g}" for name, value in values.items()}
                named = {"model": model, "transitions": transitions, "seed": cell["seed"], "family": family}
                rows.append({**named, **written})
    return table_text(rows)
