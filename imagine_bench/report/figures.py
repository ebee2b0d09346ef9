"""The plots of a report, in one style: color-blind-safe, labelled directly, readable on light and dark pages."""

from __future__ import annotations

import io
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeVar
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from imagine_bench.judge.causes import CAUSES
from imagine_bench.registry import AGENTS
from imagine_bench.registry.entries import entrant
from imagine_bench.report.data import ReportData, Score
from imagine_bench.report.tables import Image
from imagine_bench.report.text import agent_words
from imagine_bench.statistics import Estimate

_INK = "#2b2b2f"  # in the SVG this becomes the page's own text color
# Okabe and Ito's palette, grays, Tol's muted colors and ColorBrewer's, in the order in which agents are registered.
_COLORS = (
    "#8c8c8c", "#b8860b", "#0072b2", "#d55e00", "#009e73", "#882255",
    "#e69f00", "#999933", "#332288", "#cc79a7", "#56b4e9", "#661100",
    "#44aa99", "#aa4499", "#117733", "#cc6677", "#7f5539", "#9aa600",
    "#4d9221", "#5b5ea6", "#c51b7d", "#5ab4ac", "#b35806", "#542788",
    "#01665e", "#bf812d", "#762a83", "#7fbc41", "#2166ac", "#b2182b",
    "#de77ae", "#35978f", "#a6761d", "#7570b3", "#e7298a", "#1b7837",
)  # fmt: skip
Value = TypeVar("Value")
Failures = dict[str, dict[int, tuple[int, Counter[str]]]]
"""By agent and budget: tests of all seeds, and failures by cause."""
_CAUSE_COLORS = ("#0072b2", "#56b4e9", "#e69f00", "#cc79a7", "#882255", "#8c8c8c", "#2b2b2f")
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "imagine_bench",
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "axes.titlecolor"), _INK),
    **dict.fromkeys(("xtick.color", "ytick.color"), _INK),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": "#8c8c8c",
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "lines.linewidth": 2.0,
    "figure.constrained_layout.w_pad": 0.1,  # in inches; letters are wider in the file than in the layout
}


_KINDS = (("epistemic", "-"), ("aleatoric", "--"), ("modal", ":"))
_THESIS_LINE: dict[str, Any] = {
    "marker": "D", "markersize": 5, "markerfacecolor": "none", "linestyle": ":", "linewidth": 1.0,
}  # fmt: skip
_LEADER: dict[str, Any] = {
    "arrowstyle": "-", "linewidth": 0.6, "color": "#8c8c8c", "shrinkA": 2, "shrinkB": 0, "relpos": (0, 0.5),
}  # fmt: skip
_LONG = 32  # letters of a title that stand in one line beside a plot
_THESIS_REACH = 2.0  # its points beyond so many times the last budget would leave the run's own no room
_REFERENCE_LINE: dict[str, Any] = {"color": _INK, "linewidth": 1.0, "linestyle": (0, (4, 3)), "alpha": 0.7}


def image(name: str, draw: Callable[[], Figure], *, alt: str, caption: str, svg: bool = False, dpi: int = 150) -> Image:
    """A figure in the style of all reports; as :class:`Image` says, with ``svg`` as inline SVG too.

    ``dpi`` is pixels an inch of the PNG.
    """

    def drawn() -> tuple[bytes, str]:
        with mpl.rc_context(STYLE):
            figure = draw()
            FigureCanvasAgg(figure)
            figure.draw_without_rendering()
            figure.set_layout_engine("none")  # laid out once, for both files
            vector, png = io.StringIO(), io.BytesIO()
            if svg:
                figure.savefig(vector, format="svg", metadata={"Date": None})
            figure.savefig(png, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
        return png.getvalue(), _inline(vector.getvalue(), name, alt) if svg else ""

    return Image(name=name, draw=drawn, alt=alt, caption=caption)


def color(agent: str) -> str:
    """The agent's color, the same in every plot."""
    known, base = list(AGENTS), entrant(agent).agent
    place = known.index(base) if base in known else sum(base.encode())
    other = 1 + crc32(agent.encode()) % (len(_COLORS) - 1) if agent != base else 0  # never that of the agent as it is
    return _COLORS[(place + other) % len(_COLORS)]


def success_figure(data: ReportData) -> Figure:
    """Success (%) against real training episodes, with 95 % intervals, chance level, optimum and the thesis' points."""
    lines = sum(_lines(_in_lines(agent_words(agent).title)) for agent in data.scores)
    figure = Figure(figsize=(9.2, max(4.9, 0.33 * lines)), layout="constrained")
    axes = figure.add_subplot()
    for share in (data.facts.optimum, data.facts.chance_level):
        axes.axhline(100.0 * share, **_REFERENCE_LINE)
    for agent, scores in data.scores.items():
        _band(axes, agent, {budget: scores[budget] for budget in data.budgets})
    _success_legend(axes, data, thesis=_thesis_points(axes, data))
    axes.set(ylabel="test episodes solved (%)", ylim=(-2, 108))
    last = {agent: 100.0 * scores[data.budgets[-1]].value for agent, scores in data.scores.items()}
    _end_labels(axes, last, _episodes_axis(axes, data))
    return figure


def ladder_figure(reached: Mapping[str, Sequence[int | None]], last: int, floor: float | None) -> Figure:
    """Real episodes until the task is learned, a rung an agent and a point a seed, the quickest at the bottom.

    Args:
        reached: By agent, of every seed the test from which on it is solved; None where it never was.
        last: Episodes of the last test: those that never solved it stand as triangles beyond it.
        floor: Episodes of the information floor, or None where there is none.
    """
    beyond = 1.6 * last
    found = {agent: [beyond if each is None else each for each in seeds] for agent, seeds in reached.items()}
    rungs = sorted(found, key=lambda agent: (float(np.median(found[agent])), float(np.mean(found[agent]))))
    names = [_in_lines(agent_words(agent).title) for agent in rungs]
    spans = np.array([max(1.0, 0.5 * _lines(name)) for name in names])  # of a rung, in single ones
    heights = spans.cumsum() - 0.5 * spans - 0.5
    figure = Figure(figsize=(9.2, 1.0 + 0.34 * spans.sum()), layout="constrained")
    axes = figure.add_subplot()
    for height, agent in zip(heights, rungs, strict=True):
        middle = float(np.median(found[agent]))
        axes.plot([floor or min(found[agent]), middle], [height] * 2, color=color(agent), alpha=0.35)
        axes.plot([middle], [height], "|", color=color(agent), markersize=13, markeredgewidth=2.5)
        for marker, never in (("o", False), (">", True)):
            values = [each for each in found[agent] if (each == beyond) == never]
            shifts = 0.24 * (np.arange(len(values)) - (len(values) - 1) / 2) / max(1, len(values) - 1)
            axes.plot(values, height + shifts, marker, color=color(agent), markersize=4.5, linestyle="none")
    if floor is not None:
        axes.axvline(floor, **_REFERENCE_LINE)
        name, top = f"information floor, {floor:.0f}", (floor, spans.sum() - 0.45)
        axes.annotate(name, top, xytext=(4, 0), textcoords="offset points", fontsize=9)
    ticks = [each for each in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000) if each <= last]
    axes.set_xscale("log")
    axes.set_xticks([*ticks, beyond], [*(f"{each:,}" for each in ticks), "never"])
    axes.minorticks_off()
    axes.set_yticks(heights, names)
    least = min(floor or beyond, *(min(seeds) for seeds in found.values()))
    axes.set(xlim=(0.6 * least, 1.1 * beyond), ylim=(-0.6, spans.sum() - 0.1))
    axes.set_xlabel("real training episodes (logarithmic)")
    return figure


def plan_lengths_figure(lengths: Sequence[tuple[int, int]]) -> Figure:
    """Starts by the fewest macro-actions that they need; those that need -1 cannot be solved."""
    figure = Figure(figsize=(9.2, 2.4), layout="constrained")
    axes = figure.add_subplot()
    names = ["none" if length < 0 else str(length) for length, _ in lengths]
    axes.bar_label(axes.bar(names, [count for _, count in lengths], color=_COLORS[2], width=0.5), fmt="{:,.0f}")
    axes.margins(y=0.2)
    axes.locator_params(axis="y", integer=True)
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="macro-actions of the shortest plan", ylabel="starts")
    return figure


def gain_figure(data: ReportData) -> Figure:
    """Gain over DQN (%) against real training episodes, with 95 % intervals, beside the thesis' (figures 5.5 and 5.7).

    Only agents of which the thesis gives a gain: others' may be tens of times as large.
    """
    figure = Figure(figsize=(9.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.axhline(0.0, **_REFERENCE_LINE)
    last: dict[str, float] = {}
    for agent, every in data.thesis_gains.items():
        printed = near(data, every)
        axes.plot(list(printed), 100.0 * np.array(list(printed.values())), color=color(agent), **_THESIS_LINE)
        gains = {budget: row.gain for budget, row in data.comparisons[agent].items() if np.isfinite(row.gain.value)}
        if gains:
            _band(axes, agent, gains)
            last[agent] = 100.0 * gains[max(gains)].value
    axes.set(ylabel="gain over DQN (%)")
    axes.plot([], [], color=_INK, marker="o", markersize=4.5, label="this run, band: 95 % interval")
    axes.plot([], [], color=_INK, label="thesis", **_THESIS_LINE)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.06, 1.0), ncols=2, fontsize=9)
    _end_labels(axes, last, _episodes_axis(axes, data))
    return figure


def causes_figure(found: Failures) -> Figure:
    """Failed test episodes (%) by cause, stacked, at every budget, a panel an agent."""
    columns = min(3, len(found))
    lines = -(-len(found) // columns)
    figure = Figure(figsize=(1.2 + 2.9 * columns, 0.9 + 2.5 * lines), layout="constrained")
    panels = np.atleast_1d(figure.subplots(lines, columns, sharey=True, squeeze=False)).ravel()
    shown = [name for name in CAUSES if any(counts[name] for rows in found.values() for _, counts in rows.values())]
    for axes, (agent, by_budget) in zip(panels, found.items(), strict=False):
        bottom, places = np.zeros(len(by_budget)), np.arange(len(by_budget))
        for name in shown:
            shares = np.array([100.0 * counts[name] / tests for tests, counts in by_budget.values()])
            axes.bar(places, shares, 0.8, bottom=bottom, color=_CAUSE_COLORS[list(CAUSES).index(name)], label=name)
            bottom += shares
        axes.set_title(agent_words(agent).title, fontsize=9.5)
        axes.set_xticks(places, [f"{budget:,}" for budget in by_budget], rotation=45, ha="right")
        axes.grid(visible=False, axis="x")
        axes.set_ylim(0, 100)
    for axes in panels[len(found) :]:
        axes.set_visible(False)
    figure.supxlabel("real training episodes", fontsize=10.5)
    figure.supylabel("test episodes that failed (%)", fontsize=10.5)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)
    return figure


def _band(axes: Axes, agent: str, by_budget: Mapping[int, Score | Estimate]) -> None:
    """An agent's values (%) with their intervals."""
    budgets = list(by_budget)
    values = 100.0 * np.array([(one.value, one.low, one.high) for one in by_budget.values()])
    axes.plot(budgets, values[:, 0], color=color(agent), marker="o", markersize=4.5, zorder=3)
    axes.fill_between(budgets, values[:, 1], values[:, 2], color=color(agent), alpha=0.18, linewidth=0)


def acceptance_figure(data: ReportData) -> Figure:
    """Share of imagined transitions kept (%) while training up to each budget."""
    figure = Figure(figsize=(9.2, 2.9), layout="constrained")
    axes = figure.add_subplot()
    for agent, rates in data.acceptance.items():
        percentages = [100.0 * rate for rate in rates.values()]
        axes.plot(list(rates), percentages, color=color(agent), marker="o", markersize=4.5)
    axes.set(xlabel="real training episodes", ylabel="transitions kept (%)", ylim=(-3, 106))
    last = {agent: 100.0 * rates[max(rates)] for agent, rates in data.acceptance.items()}
    _end_labels(axes, last, max(max(rates) for rates in data.acceptance.values()))
    axes.set_xlim(left=0)
    return figure


def open_loop_figure(data: ReportData) -> Figure:
    """Four panels by imagined depth: correct share, reward error, termination error, uncertainties."""
    figure, panels = _four_panels()
    filtered = False
    for agent, loop in data.open_loop.items():
        depth = np.arange(1, len(loop.correct) + 1)
        style: dict[str, Any] = {"color": color(agent), "marker": "o", "markersize": 3.5}
        panels[0].plot(depth, 100.0 * loop.correct, label=agent_words(agent).title, **style)
        if np.isfinite(loop.correct_accepted).any() and (loop.accepted < 1.0).any():
            panels[0].plot(depth, 100.0 * loop.correct_accepted, linestyle="--", **style)
            filtered = True
        panels[1].plot(depth, loop.reward_mae, **style)
        panels[2].plot(depth, 100.0 * loop.termination_error, **style)
        for name, line in _KINDS:
            if getattr(loop, name).any():  # an agent that knows no such kind says 0
                panels[3].plot(depth, getattr(loop, name), linestyle=line, color=color(agent))
    _agents_legend(figure, panels[0])
    _lines_legend(panels[0], {"kept by the filter": "--"} if filtered else {})
    _lines_legend(panels[3], dict(_KINDS))
    panels[0].set(title="Macrostate as the rules say", ylabel="imagined transitions (%)", ylim=(-3, 106))
    panels[1].set(title="Error of the predicted reward", ylabel="mean absolute error")
    _from_zero(panels[1])
    panels[2].set(title="Wrong about the episode's end", ylabel="imagined transitions (%)", ylim=(-3, 106))
    measure = "variance of latents" + (
        "\n(“factored:given”: probability)" if "factored:given" in data.open_loop else ""
    )
    panels[3].set(title="Uncertainty", ylabel=measure, yscale=_log_if_positive(data))
    for axes in panels:
        axes.set_xlabel("imagined depth (macro-actions)")
    return figure


def _four_panels() -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(9.2, 7.0), layout="constrained")
    return figure, list(figure.subplots(2, 2).ravel())


def _agents_legend(figure: Figure, axes: Axes) -> None:
    """The agents below all panels, where they hide nothing."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    for line in axes.get_lines():
        line.set_label("_")  # said


def _lines_legend(axes: Axes, styles: Mapping[str, str]) -> None:
    """The meaning of each kind of line in one panel."""
    for label, line in styles.items():
        axes.plot([], [], linestyle=line, color=_INK, label=label)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="best")


def _from_zero(axes: Axes) -> None:
    """Begin just below zero, so that a line of zeros is seen whole."""
    values = [np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()]
    highest = max((float(array[np.isfinite(array)].max(initial=0.0)) for array in values), default=0.0) or 1.0
    axes.set_ylim(-0.04 * highest, 1.08 * highest)


def _log_if_positive(data: ReportData) -> str:
    values = [getattr(loop, name) for loop in data.open_loop.values() for name, _ in _KINDS]
    joined = np.concatenate([value for value in values if value.any()] or [np.zeros(1)])
    return "log" if (joined[np.isfinite(joined)] > 0).all() else "linear"


def _episodes_axis(axes: Axes, data: ReportData) -> int:
    """A logarithmic axis of real episodes, which ends at the budget that is returned."""
    printed = sorted({budget for rows in data.thesis.values() for budget in near(data, rows)})
    ticks = sorted({*data.budgets, *printed[:1], *printed[-1:]})  # more would overlap
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks], rotation=45, ha="right")
    axes.minorticks_off()
    axes.set_xlabel("real training episodes (logarithmic)")
    return ticks[-1]


def near(data: ReportData, printed: Mapping[int, Value]) -> dict[int, Value]:
    """Those of the thesis' values that stand near the budgets of this run."""
    return {budget: value for budget, value in printed.items() if budget <= _THESIS_REACH * data.budgets[-1]}


def _thesis_points(axes: Axes, data: ReportData) -> bool:
    """Draw them; whether there are any."""
    shown = {agent: rows for agent, printed in data.thesis.items() if (rows := near(data, printed))}
    for agent, rows in shown.items():
        means, stds = 100.0 * np.array(list(rows.values())).T
        axes.errorbar(list(rows), means, stds, color=color(agent), elinewidth=0.8, capsize=2, zorder=2, **_THESIS_LINE)
    return bool(shown)


def _success_legend(axes: Axes, data: ReportData, *, thesis: bool) -> None:
    """The meaning of each kind of line; which agent a color is, the right margin says."""
    axes.plot([], [], color=_INK, marker="o", markersize=4.5, label="this run, band: 95 % interval")
    if thesis:
        axes.plot([], [], color=_INK, label="thesis, bar: standard deviation", **_THESIS_LINE)
    if np.isfinite(data.facts.optimum):
        levels = f"optimum {100 * data.facts.optimum:.1f} % and chance level {100 * data.facts.chance_level:.1f} %"
        axes.plot([], [], label=levels, **_REFERENCE_LINE)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.06, 1.0), ncols=3, fontsize=9)


def _end_labels(axes: Axes, last: Mapping[str, float], to_x: float) -> None:
    """Name each line in the right margin, spread so that no two names overlap.

    A gray line joins a name to the value at which its curve ends. It stays in the margin, where no curve is.
    """
    low, high = axes.get_ylim()
    step = 0.065 * (high - low) * 4.9 / axes.get_figure(root=True).get_figheight()  # type: ignore[union-attr]
    names = sorted(last, key=lambda agent: last[agent])
    words = {agent: _in_lines(agent_words(agent).title) for agent in names}
    rooms = [step * _lines(words[agent]) for agent in names]
    places = spread_labels([last[agent] for agent in names], rooms, top=high)
    for agent, y in zip(names, places, strict=True):
        axes.annotate(
            words[agent], xy=(1.005, last[agent]), xycoords=axes.get_yaxis_transform(), xytext=(1.04, y),
            textcoords=axes.get_yaxis_transform(), color=color(agent), fontweight="bold", va="center", fontsize=9.5,
            arrowprops=_LEADER,
        )  # fmt: skip
    axes.set_xlim(right=to_x * 1.04)


def _in_lines(title: str) -> str:
    """A long title in lines; what is in brackets begins one."""
    parts = [title] if len(title) <= _LONG else title.replace(" (", "\n(").splitlines()
    return "\n".join(line for part in parts for line in textwrap.wrap(part, _LONG))


def _lines(text: str) -> int:
    return 1 + text.count("\n")


def spread_labels(values: Sequence[float], rooms: Sequence[float], *, top: float) -> list[float]:
    """Ascending values moved as little as it takes for each to have its room, half of it either way, none above top."""
    steps = [0.5 * (before + after) for before, after in pairwise(rooms)]
    places: list[float] = []
    for index, value in enumerate(values):
        places.append(max(value, places[-1] + steps[index - 1]) if places else value)
    for index in reversed(range(len(places))):
        places[index] = min(places[index], top - sum(steps[index:]))
    return places


def _inline(svg: str, name: str, alt: str) -> str:
    """Strip what a page does not want (prologue, metadata, fixed size) and let text take the page's color."""
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", body, count=1)
    body = re.sub(r'(<svg[^>]*?) width="[^"]*"', rf'\1 role="img" aria-label="{alt}"', body, count=1)
    body = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{name}-", body)  # ids of several plots share one page
    return body.replace(_INK, "currentColor")
