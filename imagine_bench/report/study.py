"""What a study found: one table, one row a seed in CSV, one plot."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from imagine_bench import statistics
from imagine_bench.report.analysis import markdown
from imagine_bench.report.figures import image
from imagine_bench.report.text import estimate_text, percent
from imagine_bench.store.files import csv_text, make_folder, write_bytes, write_json
from imagine_bench.sweep.grid import Study
from imagine_bench.sweep.run import Line

_HELPS, _HURTS, _UNCLEAR = "#009e73", "#d55e00", "#8c8c8c"  # Okabe and Ito's palette


def study_table(study: Study, lines: Sequence[Line]) -> str:
    """Success (%) of every variant at every budget, and its difference in points from what it is compared with.

    With what a model imagines right of one macro-action, at the last budget (%).
    """
    budgets = [f"{budget:,}" for budget in study.budgets]
    rows = []
    for line in lines:
        reached = [percent(statistics.iqm(column)) for column in line.success.T]
        moved = [estimate_text(one) for one in line.difference] if line.difference else ["–"] * len(budgets)
        one = line.variant
        head = (one.factor, one.name, one.agent)
        right = line.imagined_right[:, -1].mean()
        foreseen = "–" if np.isnan(right) else percent(right)
        rows.append([*head, *reached, one.against or "–", *moved, foreseen, f"{line.train_cpu_s:.0f}"])
    columns = ["factor", "variant", "agent", *budgets, "against", *budgets, "imagined right", "CPU s"]
    return "\n".join(markdown(columns, rows))


def write_study(folder: Path, study: Study, lines: Sequence[Line]) -> None:
    """Write ``study.md``, ``seeds.csv``, ``summary.csv``, ``runs.json`` and, if anything is compared, ``study.png``.

    Raises:
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    head = (
        f"# {study.question}\n\n{study.execution}, {study.appearance}, tuning seeds "
        f"{', '.join(map(str, study.seeds))}, {study.evaluation_episodes} test episodes; interquartile means, "
        "differences in points with 95 % intervals over seeds, each alone: of many, some exclude zero by chance.\n\n"
    )
    compared = [line for line in lines if line.difference]
    if compared:
        head += "![Differences](study.png)\n\n"
        write_bytes(folder / "study.png", image("study", lambda: _figure(study, compared), alt="", caption="").png)
    write_bytes(folder / "study.md", f"{head}{study_table(study, lines)}\n".encode())
    write_bytes(folder / "seeds.csv", _seeds(study, lines).encode())
    write_bytes(folder / "summary.csv", _summary(study, lines).encode())
    write_json(folder / "runs.json", [_origin(line) for line in lines])


def _origin(line: Line) -> dict[str, Any]:
    """Where a line's numbers come from."""
    facts = {name: line.environment.get(name) for name in ("command", "commit", "versions", "machine")}
    variant = line.variant
    return {
        "variant": variant.name,
        "settings": dict(variant.settings),
        "world": dict(variant.world),
        "bench": line.folder.name,
        **facts,
    }


def _seeds(study: Study, lines: Sequence[Line]) -> str:
    head = "factor,variant,agent,against,protocol,seed,episodes,success,imagined_right,cpu_s"
    rows: list[list[Any]] = [head.split(",")]
    for line in lines:
        one = line.variant
        named = [one.factor, one.name, one.agent, one.against or "", line.folder.name.rpartition("-")[2]]
        for (seed, budget), success, right in zip(
            itertools.product(study.seeds, study.budgets), line.success.flat, line.imagined_right.flat, strict=True
        ):
            foreseen = "" if np.isnan(right) else f"{right:.4f}"
            rows.append([*named, seed, budget, f"{success:.6g}", foreseen, f"{line.train_cpu_s:.1f}"])
    return csv_text(rows)


def _summary(study: Study, lines: Sequence[Line]) -> str:
    rows: list[list[Any]] = [
        ["factor", "variant", "agent", "episodes", "success_iqm", "against", "difference", "low_95", "high_95", "cpu_s"]
    ]
    for line in lines:
        for index, budget in enumerate(study.budgets):
            estimate = line.difference[index][:3] if line.difference else ("", "", "")
            variant, iqm = line.variant, statistics.iqm(line.success[:, index])
            rows.append([
                variant.factor, variant.name, variant.agent, budget, f"{iqm:.6g}", variant.against or "", *estimate,
                f"{line.train_cpu_s:.1f}",
            ])  # fmt: skip
    return csv_text(rows)


def _figure(study: Study, compared: Sequence[Line]) -> Figure:
    """Differences in points with their intervals, a panel a budget, a row a variant."""
    usual = Counter(line.variant.against for line in compared).most_common(1)[0][0]
    figure = Figure(figsize=(10.0, 1.6 + 0.27 * len(compared)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(study.budgets), sharey=True))
    for index, (axes, budget) in enumerate(zip(panels, study.budgets, strict=True)):
        axes.axvline(0.0, color="#2b2b2f", linewidth=1.0)
        for row, line in enumerate(compared):
            assert line.difference is not None
            value, low, high = (100.0 * number for number in line.difference[index][:3])
            color = _HELPS if low > 0 else _HURTS if high < 0 else _UNCLEAR
            axes.plot([low, high], [row, row], color=color)
            axes.plot([value], [row], marker="o", markersize=5, color=color)
        axes.set_title(f"{budget:,} episodes")
    panels[0].set_yticks(range(len(compared)), [_label(line, usual) for line in compared])
    panels[0].invert_yaxis()
    figure.supxlabel(f"points of success, against {usual} where nothing else is named", fontsize="medium")
    return figure


def _label(line: Line, usual: str | None) -> str:
    """What a row compares; ``usual`` need not be named in every one."""
    variant = line.variant
    if variant.against == usual:
        return f"{variant.factor}: {variant.name}"
    return f"{variant.name} – {variant.against}"
