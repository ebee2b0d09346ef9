"""The judgement of models of motions as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from imagine_bench.judge.motion.scores import DEPTH, MotionScores, Row
from imagine_bench.report.page import Table

_CAPTION = (
    "Percent of questions, means over seeds. Right: motions as planned, whose imagined final frame shows the "
    "macrostate that the simulator ends in. Nothing: the same motions 60 mm higher, which grip nothing, and the model "
    "says so. Painted: of these, the model paints the change all the same. Pairs: both motions are right. After n: so "
    "many motions, each imagined from the frame imagined before. The simulator's own frames show the reader's errors."
)


def motion_table(rows: Sequence[Row]) -> Table:
    """The scores of each model at each number of motions, means over seeds."""
    cells = []
    for name, size in dict.fromkeys((row.model, row.size) for row in rows):
        scores = [row.scores for row in rows if (row.model, row.size) == (name, size)]
        shares = [_mean(scores, field) for field in ("right", "nothing_right", "painted", "pairs")]
        depths = np.mean([each.by_depth for each in scores], axis=0).tolist()
        cells.append(
            [
                name,
                str(size or ""),
                *(f"{100 * share:.0f}" for share in shares),
                *(f"{100 * share:.0f}" for share in depths),
                f"{_mean(scores, 'fit_cpu_s'):.0f}",
            ]
        )
    chain = [f"after {depth + 1}" for depth in range(DEPTH)]
    header = ["model", "motions", "right", "nothing", "painted", "pairs", *chain, "CPU s"]
    return Table("motions", header, cells, _CAPTION)


def motion_rows(rows: Sequence[Row]) -> list[dict[str, float | str]]:
    """The rows as those of a CSV file, shares in [0, 1]."""
    found: list[dict[str, float | str]] = []
    for row in rows:
        values: dict[str, float | str] = {"model": row.model, "motions": row.size, "seed": row.seed}
        scores = asdict(row.scores)
        by_depth = scores.pop("by_depth")
        found.append(values | scores | {f"after_{depth + 1}": share for depth, share in enumerate(by_depth)})
    return found


def _mean(scores: Sequence[MotionScores], field: str) -> float:
    return float(np.mean([getattr(each, field) for each in scores]))
