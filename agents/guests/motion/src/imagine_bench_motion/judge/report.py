"""The judgement of models of motions as tables, and as rows of a CSV file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imagine_bench import statistics
from imagine_bench.report.page import DASH, Table, printed

from .interface import motion_models
from .judgement import SIMULATOR, MotionJudgement
from .questions import DEPTH

Cell = Mapping[str, Any]
_SHARES = {"right": "right", "unread": "unread", "raised_right": "raised", "painted": "painted", "pairs": "pairs"}
_SCORES = (
    "Percent of {pairs} pairs of motions; mean over seeds of data and model, with the 95 % interval in square brackets "
    "(seven seeds or more), else the lowest and the highest seed in parentheses. right: the imagined image of the "
    "motion as planned shows the macrostate that the simulator ends in. unread: the reader recognizes nothing in this "
    "image. raised: right for the same motion 60 mm higher, which grips nothing. painted: the imagined image of the "
    "raised motion shows the end of the motion as planned. pairs: both motions are right. level: whether the model is "
    "told the commands, or the macro-action alone. The row simulator shows the errors of the reader."
)
_DRIFT = (
    "Drift: percent of {chains} chains of {depth} planned motions in which every macrostate so far is right. Each "
    "motion is imagined from the image that was imagined before."
)


def motion_tables(judgement: MotionJudgement, cells: Sequence[Cell]) -> list[Table]:
    """The scores of each model at each number of motions, and their drift by depth."""
    groups: dict[tuple[str, int], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell["model"], cell["transitions"]), []).append(cell)
    scores = []
    drift = []
    for (name, size), group in groups.items():
        is_model = name != SIMULATOR.model
        shares = [_shown([each[share] for each in group], judgement.pairs) for share in _SHARES]
        fit_s = printed(float(np.mean([each["fit_s"] for each in group])), ".0f") if is_model else DASH
        begin = [name, str(size) if is_model else DASH]
        scores.append([*begin, _level(name), str(len(group)) if is_model else DASH, *shares, fit_s])
        depths = zip(*(each["by_depth"] for each in group), strict=True)
        drift.append([*begin, *(_shown(list(each), judgement.chains) for each in depths)])
    head = ["model", "motions"]
    about_scores = _SCORES.format(pairs=judgement.pairs)
    about_drift = _DRIFT.format(chains=judgement.chains, depth=DEPTH)
    return [
        Table("motions", [*head, "level", "seeds", *_SHARES.values(), "fit, CPU s"], scores, about_scores),
        Table("drift", [*head, *(f"after {depth}" for depth in range(1, DEPTH + 1))], drift, about_drift),
    ]


def motion_rows(cells: Sequence[Cell]) -> list[dict[str, float | str]]:
    """The cells as rows of a CSV file, shares in [0, 1]."""
    found = []
    for cell in cells:
        values = {name: value for name, value in cell.items() if name not in ("by_depth", "transitions")}
        depths = {f"after_{depth}": share for depth, share in enumerate(cell["by_depth"], start=1)}
        found.append({"model": values.pop("model"), "motions": cell["transitions"], **values, **depths})
    return found


def _level(name: str) -> str:
    entry = motion_models().get(name)
    return DASH if entry is None else entry.level


def _shown(shares: Sequence[float | None], trials: int) -> str:
    """The mean of shares in percent, and its interval; of fewer seeds than that needs, the lowest and the highest."""
    known = [share for share in shares if share is not None]
    if not known:
        return DASH
    mean = f"{100.0 * float(np.mean(known)):.0f}"
    low, high = statistics.interval(known, trials=trials, trim=0.0)
    if not np.isnan(low):
        return f"{mean} [{100.0 * low:.0f}, {100.0 * high:.0f}]"
    ends = f"({100.0 * min(known):.0f} to {100.0 * max(known):.0f})"
    return f"{mean} {ends}" if min(known) < max(known) else mean
