"""Draws levels.png, success against robot time, from docs/results/motion: ``python docs/img/draw_levels.py``."""

import json
from pathlib import Path
from typing import Any

import matplotlib as mpl

from imagine_bench import registry
from imagine_bench.exact import motion

mpl.use("agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results" / "motion"
AGENTS = {
    "factored": ("#202020", "s"),
    "factored:given": ("#202020", "s"),
    "imagination": ("#d55e00", "D"),
    "dqn": ("#0072b2", "o"),
}
"""Color and marker of an agent of macro-actions."""
LINES = {"planner": ("-", "planned"), "clone": ("--", "cloned")}
"""Line of planner and clone, and the word for macro-actions that they carry out."""
MINUTES = (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)
NOT_RUN = {1: "not run: a clone of one cube; SAC for longer", 3: "not run: SAC on three cubes"}
FLAT = ("#9a9a9a", "^")


def today(kept: dict[str, Any]) -> bool:
    """Whether a curve is of the planner or of a clone that its file names; older files name none."""
    return kept["execution"] == "planner" or "clone" in kept


def curves(cubes: int) -> list[dict[str, Any]]:
    """The kept curves of agents of macro-actions in the world of so many cubes, without slips, with today's clone."""
    kept = [json.loads(file.read_text()) for file in sorted(RESULTS.glob("level_*.json"))]
    return [
        each
        for each in kept
        if each["cubes"] == cubes and each["agent"] != "oracle" and not each["slip"] and today(each)
    ]


def draw(axes: plt.Axes, cubes: int) -> None:
    """Curves of one world, its chance level, its optimum, and the success that planned motions were shown to reach."""
    spec = registry.task("arrow_puzzle" if cubes == 3 else f"arrows:cubes={cubes},horizon=10")
    facts = spec.facts()
    measured = motion.measured(spec.id).get("appearances", {})
    labels = set()
    for curve in curves(cubes):
        color, marker = AGENTS[curve["agent"]]
        line, word = LINES[curve["execution"]]
        minutes = [point["robot_s"] / 60 for point in curve["curve"]]
        shares = [100 * point["successes"] / point["tests"] for point in curve["curve"]]
        label = f"{curve['agent']}, {word} macro-actions"
        label = f"_{label}" if label in labels else label  # of several seeds the legend names one
        labels.add(label)
        face = color if curve["execution"] == "planner" else "white"
        axes.plot(minutes, shares, line, color=color, marker=marker, markerfacecolor=face, markersize=6, label=label)
    axes.axhline(100 * facts.chance_level, color="#9a9a9a", linestyle=":", label="chance, macro-actions at random")
    axes.axhline(100, color="#4daf4a", linestyle=":", label="optimum of the rules")
    if "clean" in measured:
        shown = 100 * motion.certificate(spec, measured["clean"]).shown
        axes.axhline(shown, color="#e69f00", linestyle="--", label=f"shown reachable at 25 Hz, {shown:.1f} %")
    axes.set_xscale("log")
    axes.set_xticks(MINUTES, [f"{each:g}" for each in MINUTES])
    axes.minorticks_off()
    axes.set_xlim(0.75 * MINUTES[0], 1.5 * MINUTES[-1])
    axes.text(0.02, 0.84, NOT_RUN[cubes], transform=axes.transAxes, fontsize=8, color="#606060")
    axes.set_ylim(-2, 104)
    axes.set_xlabel("minutes of robot time in training (logarithmic)")
    axes.set_title(f"{cubes} cube{'s' if cubes > 1 else ''}")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def draw_flat(axes: plt.Axes) -> None:
    """The flat baseline, for each reward and settings that were measured."""
    for file, line in zip(sorted(RESULTS.glob("flat_*.json")), ("-", "--"), strict=False):
        kept = json.loads(file.read_text())
        minutes = [point["robot_s"] / 60 for point in kept["curve"]]
        shares = [100 * point["successes"] / point["tests"] for point in kept["curve"]]
        color, marker = FLAT
        settings = kept.get("settings", "library")  # older files are of the library's
        label = f"SAC, flat at 25 Hz, {kept['reward']} reward, {settings} settings"
        axes.plot(minutes, shares, line, color=color, marker=marker, markersize=4, label=label)


def main() -> None:
    """Write the figure."""
    figure, (one, three) = plt.subplots(1, 2, figsize=(11.0, 4.6), sharey=True, layout="constrained")
    draw(one, 1)
    draw_flat(one)
    draw(three, 3)
    one.set_ylabel("test episodes that succeed (%)")
    for axes in (one, three):
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    figure.savefig(HERE / "levels.png", dpi=110)


if __name__ == "__main__":
    main()
