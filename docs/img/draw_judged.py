"""Draws the pictures of judged world models from docs/results: ``python docs/img/draw.py evidence|promise|ranking``."""

import csv
from pathlib import Path

import matplotlib as mpl

from imagine_bench.report import figures

mpl.use("agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"


def scores(folder: str) -> list[dict[str, str]]:
    """The scores of every judged fit of a kept folder."""
    with (RESULTS / folder / "scores.csv").open() as file:
        return list(csv.DictReader(file))


def levels(folder: str) -> list[dict[str, str]]:
    """The scores of a judgement of levels. Those of ``structured`` are of a second judgement, with today's agent."""
    again = scores(folder.replace("-judge", "_structured-judge"))
    newer = {(row["model"], row["transitions"], row["seed"]): row for row in again}
    return [newer.get((row["model"], row["transitions"], row["seed"]), row) for row in scores(folder)]


def ranking() -> None:
    """Each judged fit by its ranking of policies (L5) and by the loss of planning in it (L6)."""
    rows = [row for row in levels("arrow_puzzle-levels-judge") if row["value_loss"]]
    models = list(dict.fromkeys(row["model"] for row in rows))
    sizes = sorted({int(row["transitions"]) for row in rows})
    plot, axes = plt.subplots(figsize=(8, 4.4), layout="constrained")
    for place, model in enumerate(models):
        for size in sizes:
            fits = [row for row in rows if row["model"] == model and int(row["transitions"]) == size]
            across, up = ([float(row[name]) for row in fits] for name in ("policy_r", "value_loss"))
            style = {"color": figures.COLORS[place % 8], "marker": figures.MARKERS[place % 7]}
            area = 20 + 60 * sizes.index(size)
            axes.scatter(across, up, s=area, alpha=0.75, label=model if size == sizes[1] else None, **style)
    axes.set_xlabel("Pearson's r of the returns of 43 policies, L5 (1: ranked as in the world)")
    axes.set_ylabel("value loss of the plan that is optimal\nin the model, L6 (units of reward)")
    axes.set_title(
        f"Each mark is one training; larger marks: after {', '.join(f'{size:,}' for size in sizes)} transitions",
        fontsize=10,
    )
    axes.set_xlim(right=1.05)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower left")
    plot.savefig(HERE / "ranking.png", dpi=100)


def evidence() -> None:
    """Total variation of each judged fit, and its exploit with the upper bound, by the size of its data."""
    rows = [row for row in levels("arrow_puzzle_clockwise-levels-judge") if row["exploit"]]
    models = list(dict.fromkeys(row["model"] for row in rows))
    sizes = sorted({int(row["transitions"]) for row in rows})
    plot, panels = plt.subplots(1, len(models), figsize=(9, 3.8), sharex=True, sharey=True, layout="constrained")
    for axes, model in zip(panels, models, strict=True):
        for place, size in enumerate(sizes, 2):
            fits = [row for row in rows if row["model"] == model and int(row["transitions"]) == size]
            away, low, high = (
                [float(row[name]) for row in fits] for name in ("total_variation", "exploit", "exploit_bound")
            )
            style = {"color": figures.COLORS[place % 8], "marker": figures.MARKERS[place % 7]}
            axes.vlines(away, low, high, color=style["color"], alpha=0.6)
            axes.scatter(away, low, s=60, label=f"{size} transitions", **style)
        axes.set_title(model, fontsize=11)
        axes.set_xscale("symlog", linthresh=0.01)
        axes.set_xlim(-0.001, 1.1)
        axes.set_xticks([0.0, 0.01, 0.1, 1.0], ["0", "0.01", "0.1", "1"])
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("exploit, L7 (units of reward)\nmark: found; line: to the upper bound")
    panels[0].legend(loc="upper right", frameon=False)
    plot.supxlabel("total variation after one macro-action, L1 (linear below 0.01, then logarithmic)", fontsize=10)
    plot.suptitle("arrows:cubes=3,goal=clockwise: each mark is one training of a world model", fontsize=10)
    plot.savefig(HERE / "evidence.png", dpi=100)


def promise() -> None:
    """Shares that are accepted though wrong, by uncertainty and distribution; a mark is a fit."""
    rows = scores("arrow_puzzle-signals-judge")
    where = {
        "on_data": "on its data (guaranteed: at most 5 %)",
        "rare": "where its data is rare",
        "policies": "under other policies, mean",
        "worst_policy": "under the worst policy",
    }
    models = list(dict.fromkeys(row["model"] for row in rows))
    plot, axes = plt.subplots(figsize=(8, 3.8), layout="constrained")
    for place, (name, label) in enumerate(where.items()):
        across = [models.index(row["model"]) + 0.16 * (place - 1.5) for row in rows]
        shares = [100.0 * float(row[f"conformal_wrong_{name}"]) for row in rows]
        style = {"color": figures.COLORS[place % 8], "marker": figures.MARKERS[place % 7]}
        axes.scatter(across, shares, s=36, alpha=0.8, label=label, **style)
    axes.axhline(5.0, color="gray", linewidth=1, linestyle=":")
    axes.set_xticks(range(len(models)), models, fontsize=8)
    axes.set_ylabel("accepted though wrong (% of transitions)")
    axes.set_title("One training of each model; each mark is one exact share", fontsize=10)
    axes.grid(axis="y", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper left")
    top = max(100.0 * float(row["conformal_wrong_worst_policy"]) for row in rows)
    axes.set_ylim(0.0, 1.35 * top)
    plot.savefig(HERE / "promise.png", dpi=100)
