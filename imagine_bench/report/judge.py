"""What a judgement found: one table a model and size of its data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.judge.models.study import Judgement, kept
from imagine_bench.report.analysis import markdown
from imagine_bench.report.sections import DASH, number
from imagine_bench.statistics import interval, iqm

COLUMNS = {
    "total_variation": "total variation", "tv_5": "at depth 5", "tv_10": "at depth 10", "missed": "missed outcomes",
    "invented": "invented", "nothing": "no picture", "reward_error": "reward error", "end_error": "end error",
    "value_loss": "value loss", "regret": "regret", "auroc_epistemic": "AUROC, wrong", "fit_s": "CPU s to fit",
}  # fmt: skip


def judgement_table(folder: Path, judgement: Judgement) -> str:
    """Means over the seeds with 95 % intervals, as Markdown."""
    cells = kept(folder, judgement)
    rows = []
    for model in judgement.models:
        for size in judgement.sizes:
            own = [cell for cell in cells if (cell["model"], cell["transitions"]) == (model, size)]
            if own:
                title = registry.world_model_entry(model).title
                rows.append([title, f"{size:,}", len(own), *(_text(scores(own, name)) for name in COLUMNS)])
    return "\n".join(markdown(["world model", "transitions", "seeds", *COLUMNS.values()], rows))


def scores(cells: Sequence[dict[str, Any]], name: str) -> list[float]:
    """A score of each cell, by name; ``tv_5`` is the total variation at depth 5. NaN where there is none."""
    if name.startswith("tv_"):
        return [cell["tv_by_depth"][int(name[3:]) - 1] for cell in cells]
    return [math.nan if cell[name] is None else float(cell[name]) for cell in cells]


def _text(values: list[float]) -> str:
    there = [value for value in values if not math.isnan(value)]
    if not there:
        return DASH
    low, high = interval(there)
    return number(iqm(there)) if math.isnan(low) else f"{number(iqm(there))} [{number(low)}, {number(high)}]"
