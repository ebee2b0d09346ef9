"""Cells of the tables on programs and on questions about a whole world."""

from __future__ import annotations

import numpy as np
from kept import facts, table

from imagine_bench.report.page import over_seeds
from imagine_bench.sweep.grid import GRIDS, SUITE

_EXACT = 0.005
"""Total variation below which a program is exact."""


def _worlds(experiment: str, seen: str) -> set[tuple[str, str]]:
    """The worlds of an experiment, by task and by the codes that the writer reads; see :func:`written`."""
    (levels,) = (each.levels for each in GRIDS[SUITE].experiments if each.name == experiment)
    prefix = {"codes": "", "own": "own "}
    return {
        (each.task, f"{prefix[seen]}{each.protocol.get('appearance', 'clean')}" if seen in prefix else "")
        for each in levels
    }


def written(experiment: str, seen: str, column: str) -> str:
    """A figure of the writer of laws in the worlds of an experiment of the benchmark suite; a dash where none is.

    The writer was shown ``macrostates``, or read ``codes`` of an encoder, or of its ``own`` perception.
    """
    worlds = _worlds(experiment, seen)
    rows = [row for row in facts("programs/written.json")["rows"] if (row["task"], row["codes"]) in worlds]
    measured = {(row["task"], row["codes"]) for row in rows}
    if column == "worlds":
        return f"{len(measured)} of {len(worlds)}"
    if not rows:
        return "–"
    away = [row["total_variation"] for row in rows]
    spent = [row["macro_actions"] for row in rows]
    columns = {
        "spent": f"{min(spent):,}" if len({*spent}) == 1 else f"{min(spent):,} to {max(spent):,}",
        "mean": f"{np.mean(away):.3f}",
        "exact": f"{sum(each < _EXACT for each in away)} of {len(away)}",
        "facts": f"{100 * sum(row['found'] for row in rows) / sum(row['facts'] for row in rows):.0f}",
    }
    return columns[column]


def _whole(share: float) -> str:
    """Whole percent, but no share below 1 is 100."""
    return f"{100 * share:.0f}" if share == 1.0 or share < 0.995 else f"{np.floor(1000 * share) / 10:.1f}"


def asked(folder: str, model: str, transitions: str, family: str) -> str:
    """Questions of a family that a model answers rightly, %: mean over seeds, with the lowest and the highest.

    The columns ``chance``, ``copy`` and ``exact`` of the file can be given in place of a model.
    """
    every = table(f"{folder}/worlds.csv")
    rows = [row for row in every if row["family"] == family and row["transitions"] == transitions]
    if model in ("chance", "copy", "exact"):
        return _whole(float(rows[0][model]))
    found = [float(row["right"]) for row in rows if row["model"] == model and row["right"]]
    return over_seeds(found, _whole, share=True) if found else "–"
