"""The plots of a report, in one style: color-blind-safe, labelled directly, readable on light and dark pages."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from imagine_bench.registry import AGENTS
from imagine_bench.report.data import ReportData
from imagine_bench.report.text import agent_words

_INK = "#2b2b2f"  # in the SVG this becomes the page's own text color
# Okabe and Ito's palette, grays and Tol's muted colors, in the order in which agents are registered.
_COLORS = (
    "#8c8c8c", "#b8860b", "#0072b2", "#d55e00", "#009e73", "#882255",
    "#e69f00", "#999933", "#332288", "#cc79a7", "#56b4e9", "#661100",
    "#44aa99", "#aa4499", "#117733",
)  # fmt: skip
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "imagine_bench",
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    "text.color": _INK,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "axes.titlecolor": _INK,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.grid": True,
    "grid.color": "#8c8c8c",
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "lines.linewidth": 2.0,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.frameon": False,
}


_KINDS = (("epistemic", "-"), ("aleatoric", "--"), ("modal", ":"))
_THESIS_LINE: dict[str, Any] = {
    "marker": "D", "markersize": 5, "markerfacecolor": "none", "linestyle": ":", "linewidth": 1.0,
}  # fmt: skip
_LEADER: dict[str, Any] = {"arrowstyle": "-", "linewidth": 0.7, "alpha": 0.45, "linestyle": (0, (1, 2))}
_REFERENCE_LINE: dict[str, Any] = {"color": _INK, "linewidth": 1.0, "linestyle": (0, (4, 3)), "alpha": 0.7}


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A finished plot.

    Attributes:
        name: File name without ending.
        svg: Inline SVG whose text and axes take the page's color.
        png: The same on white, 2x.
        alt: What a reader who does not see it should know.
    """

    name: str
    svg: str
    png: bytes
    alt: str


def all_plots(data: ReportData) -> list[Plot]:
    """Success against real episodes; gain where the thesis has one; acceptance, open-loop error and futures if any."""
    plots = [_render("success", success_figure, data, "Success of each agent against real training episodes.")]
    if set(data.thesis_gains) & set(data.comparisons):
        plots.append(_render("gain", gain_figure, data, "Gain over DQN against real training episodes."))
    if data.acceptance:
        alt = "Share of imagined transitions kept, by real training episodes."
        plots.append(_render("acceptance", acceptance_figure, data, alt))
    if any(len(loop.correct) > 1 for loop in data.open_loop.values()):  # one depth is a table, not a curve
        alt = "Open-loop quality of imagination by depth: correct share, errors, uncertainties."
        plots.append(_render("open_loop", open_loop_figure, data, alt))
    if data.futures:
        alt = "Imagined against exact distributions of outcomes: total variation, missing and hallucinated outcomes."
        plots.append(_render("futures", futures_figure, data, alt))
    return plots


def color(agent: str) -> str:
    """The agent's color, the same in every plot."""
    known = list(AGENTS)
    return _COLORS[(known.index(agent) if agent in known else sum(agent.encode())) % len(_COLORS)]


def success_figure(data: ReportData) -> Figure:
    """Success (%) against real training episodes, with 95 % intervals, chance level, optimum and the thesis' points."""
    figure = Figure(figsize=(9.2, 4.9), layout="constrained")
    axes = figure.add_subplot()
    budgets = np.array(data.budgets)
    for share in (data.facts.optimum, data.facts.chance_level):
        axes.axhline(100.0 * share, **_REFERENCE_LINE)
    for agent, scores in data.scores.items():
        values = np.array([[scores[b].value, scores[b].low, scores[b].high] for b in data.budgets]) * 100.0
        axes.plot(budgets, values[:, 0], color=color(agent), marker="o", markersize=4.5, zorder=3)
        axes.fill_between(budgets, values[:, 1], values[:, 2], color=color(agent), alpha=0.18, linewidth=0)
    _thesis_points(axes, data)
    _success_legend(axes, data)
    axes.set(ylabel="test episodes solved (%)", ylim=(-2, 108))
    last = {agent: (budgets[-1], 100.0 * scores[budgets[-1]].value) for agent, scores in data.scores.items()}
    _end_labels(axes, last, _episodes_axis(axes, data))
    return figure


def gain_figure(data: ReportData) -> Figure:
    """Gain over DQN (%) against real training episodes, with 95 % intervals, beside the thesis' (figures 5.5 and 5.7).

    Only agents of which the thesis gives a gain: others' may be tens of times as large.
    """
    figure = Figure(figsize=(9.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.axhline(0.0, **_REFERENCE_LINE)
    last: dict[str, tuple[float, float]] = {}
    for agent, printed in data.thesis_gains.items():
        axes.plot(list(printed), 100.0 * np.array(list(printed.values())), color=color(agent), **_THESIS_LINE)
        gains = {budget: row.gain for budget, row in data.comparisons[agent].items() if np.isfinite(row.gain.value)}
        if gains:
            values = 100.0 * np.array([(gain.value, gain.low, gain.high) for gain in gains.values()])
            axes.plot(list(gains), values[:, 0], color=color(agent), marker="o", markersize=4.5, zorder=3)
            axes.fill_between(list(gains), values[:, 1], values[:, 2], color=color(agent), alpha=0.18, linewidth=0)
            last[agent] = (max(gains), values[-1, 0])
    axes.set(ylabel="gain over DQN (%)")
    axes.plot([], [], color=_INK, marker="o", markersize=4.5, label="this run, band: 95 % interval")
    axes.plot([], [], color=_INK, label="thesis", **_THESIS_LINE)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.06, 1.0), ncols=2, fontsize=9)
    _end_labels(axes, last, _episodes_axis(axes, data))
    return figure


def acceptance_figure(data: ReportData) -> Figure:
    """Share of imagined transitions kept (%) while training up to each budget."""
    figure = Figure(figsize=(9.2, 2.9), layout="constrained")
    axes = figure.add_subplot()
    for agent, rates in data.acceptance.items():
        axes.plot(
            list(rates), [100.0 * rate for rate in rates.values()], color=color(agent), marker="o", markersize=4.5
        )
    axes.set(xlabel="real training episodes", ylabel="transitions kept (%)", ylim=(-3, 106))
    last = {agent: (max(rates), 100.0 * rates[max(rates)]) for agent, rates in data.acceptance.items()}
    _end_labels(axes, last, max(end for end, _ in last.values()))
    axes.set_xlim(left=0)
    return figure


def open_loop_figure(data: ReportData) -> Figure:
    """Four panels by imagined depth: correct share, reward error, termination error, uncertainties."""
    figure = Figure(figsize=(9.2, 6.6), layout="constrained")
    grid = figure.subplots(2, 2)
    panels: list[Axes] = list(grid.ravel())
    for agent, loop in data.open_loop.items():
        depth = np.arange(1, len(loop.correct) + 1)
        style: dict[str, Any] = {"color": color(agent), "marker": "o", "markersize": 3.5}
        title = agent_words(agent).title
        panels[0].plot(depth, 100.0 * loop.correct, label=title, **style)
        if np.isfinite(loop.correct_accepted).any() and (loop.accepted < 1.0).any():
            label = f"{title}, kept by the filter"
            panels[0].plot(depth, 100.0 * loop.correct_accepted, linestyle="--", label=label, **style)
        panels[1].plot(depth, loop.reward_mae, label=title, **style)
        panels[2].plot(depth, 100.0 * loop.termination_error, label=title, **style)
        for name, line in _KINDS:
            if getattr(loop, name).any():  # an agent that knows no such kind says 0
                panels[3].plot(depth, getattr(loop, name), linestyle=line, color=color(agent))
    for name, line in _KINDS:
        panels[3].plot([], [], linestyle=line, label=name, color=_INK)
    panels[0].set(title="Macrostate as the rules say", ylabel="imagined transitions (%)", ylim=(-3, 106))
    panels[1].set(title="Error of the predicted reward", ylabel="mean absolute error", ylim=(0, None))
    panels[2].set(title="Wrong about the episode's end", ylabel="imagined transitions (%)", ylim=(-3, 106))
    measure = "variance of latents" + ("\n(“imagine”: probability)" if "factored" in data.open_loop else "")
    panels[3].set(title="Uncertainty", ylabel=measure, yscale=_log_if_positive(data))
    for axes in panels:
        axes.set_xlabel("imagined depth (macro-actions)")
        axes.legend(fontsize=8, loc="best")
    return figure


def futures_figure(data: ReportData) -> Figure:
    """Four panels: total variation by depth and by real episodes, missing and hallucinated outcomes by depth."""
    figure = Figure(figsize=(9.2, 6.6), layout="constrained")
    panels: list[Axes] = list(figure.subplots(2, 2).ravel())
    for agent, found in data.futures.items():
        depth = np.arange(1, len(found.floor) + 1)
        style: dict[str, Any] = {"color": color(agent), "marker": "o", "markersize": 3.5}
        title = agent_words(agent).title
        panels[0].plot(depth, found.total_variation, label=title, **style)
        panels[0].plot(depth, found.by_chance, linestyle="--", **style)
        budgets = list(found.by_budget)
        panels[1].plot(budgets, [first for first, _ in found.by_budget.values()], label=title, **style)
        deepest = [last for _, last in found.by_budget.values()]
        panels[1].plot(budgets, deepest, linestyle="--", **style)
        panels[2].plot(depth, found.missing / found.pairs, label=title, **style)
        panels[3].plot(depth, found.hallucinated / found.pairs, label=title, **style)
    floor = next(iter(data.futures.values())).floor
    panels[0].plot([], [], linestyle="--", color=_INK, label="where several are possible")
    panels[0].plot(np.arange(1, len(floor) + 1), floor, label="samples of the truth", **_REFERENCE_LINE)
    panels[1].plot([], [], linestyle="--", color=_INK, label=f"depth {len(floor)}")
    panels[0].set(title="Distance from the exact distribution", ylabel="total variation", ylim=(0, None))
    panels[1].set(title="The same while learning, depth 1", ylabel="total variation", ylim=(0, None))
    panels[2].set(title="Possible, but not imagined", ylabel="outcomes a beginning", ylim=(0, None))
    panels[3].set(title="Imagined, but impossible", ylabel="outcomes a beginning", ylim=(0, None))
    for index, axes in enumerate(panels):
        axes.set_xlabel("real training episodes" if index == 1 else "imagined depth (macro-actions)")
        axes.legend(fontsize=8, loc="best")
    return figure


def _log_if_positive(data: ReportData) -> str:
    values = [getattr(loop, name) for loop in data.open_loop.values() for name, _ in _KINDS]
    joined = np.concatenate([value for value in values if value.any()] or [np.zeros(1)])
    return "log" if (joined[np.isfinite(joined)] > 0).all() else "linear"


def _episodes_axis(axes: Axes, data: ReportData) -> int:
    """A logarithmic axis of real episodes, which ends at the budget that is returned."""
    printed = sorted({budget for rows in data.thesis.values() for budget in rows})
    ticks = sorted({*data.budgets, *printed[:1], *printed[-1:]})  # more would overlap
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks], rotation=45, ha="right")
    axes.minorticks_off()
    axes.set_xlabel("real training episodes (logarithmic)")
    return ticks[-1]


def _thesis_points(axes: Axes, data: ReportData) -> None:
    for agent, rows in data.thesis.items():
        episodes = np.array(list(rows))
        means, stds = 100.0 * np.array(list(rows.values())).T
        axes.errorbar(*(episodes, means, stds), color=color(agent), elinewidth=0.8, capsize=2, zorder=2, **_THESIS_LINE)


def _success_legend(axes: Axes, data: ReportData) -> None:
    """What the kinds of line mean; which agent a color is, the right margin says."""
    axes.plot([], [], color=_INK, marker="o", markersize=4.5, label="this run, band: 95 % interval")
    if data.thesis:
        axes.plot([], [], color=_INK, label="thesis, bar: standard deviation", **_THESIS_LINE)
    levels = f"optimum {100 * data.facts.optimum:.1f} % and chance level {100 * data.facts.chance_level:.1f} %"
    axes.plot([], [], label=levels, **_REFERENCE_LINE)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.06, 1.0), ncols=3, fontsize=9)


def _end_labels(axes: Axes, last: Mapping[str, tuple[float, float]], to_x: float) -> None:
    """Name each line in the right margin, spread so that no two names overlap, with a thin leader to its last point."""
    low, high = axes.get_ylim()
    step = 0.065 * (high - low) * 4.9 / axes.get_figure(root=True).get_figheight()  # type: ignore[union-attr]
    placed: dict[str, float] = {}
    floor = -np.inf
    for agent, (_, value) in sorted(last.items(), key=lambda item: item[1][1]):
        floor = max(value, floor + step)
        placed[agent] = floor
    excess = max(0.0, floor - high)
    for agent, y in placed.items():
        axes.annotate(
            agent_words(agent).title, xy=last[agent], xycoords="data", xytext=(1.02, y - excess),
            textcoords=axes.get_yaxis_transform(), color=color(agent), fontweight="bold", va="center", fontsize=9.5,
            arrowprops={**_LEADER, "color": color(agent)},
        )  # fmt: skip
    axes.set_xlim(right=to_x * 1.04)


def _render(name: str, draw: Callable[[ReportData], Figure], data: ReportData, alt: str) -> Plot:
    with mpl.rc_context(STYLE):
        figure = draw(data)
        FigureCanvasAgg(figure).draw()
        figure.set_layout_engine("none")  # laid out once, for both files
        svg, png = io.StringIO(), io.BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None})
        figure.savefig(png, format="png", dpi=180, facecolor="white", metadata={"Software": None})
    return Plot(name=name, svg=_inline(svg.getvalue(), name, alt), png=png.getvalue(), alt=alt)


def _inline(svg: str, name: str, alt: str) -> str:
    """Strip what a page does not want (prologue, metadata, fixed size) and let text take the page's color."""
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", body, count=1)
    body = re.sub(r'(<svg[^>]*?) width="[^"]*"', rf'\1 role="img" aria-label="{alt}"', body, count=1)
    body = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{name}-", body)  # ids of several plots share one page
    return body.replace(_INK, "currentColor")
