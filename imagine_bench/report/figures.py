"""Figures in one style, color-blind-safe, readable on light and dark pages; and the primitives that draw all of them.

A figure is drawn by a function that returns a matplotlib ``Figure``; :func:`image` makes PNG and SVG of it. The
primitives are a curve with its interval, bars with intervals (:func:`rungs`), stacked bars, small multiples and the
radar chart; filmstrips are images of their own.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from imagine_bench.judge.causes import CAUSES
from imagine_bench.registry import AGENT_GROUP, AGENTS
from imagine_bench.registry.guests import guests
from imagine_bench.report.data import agent_title
from imagine_bench.report.tables import Image
from imagine_bench.statistics import Estimate

INK = "#2b2b2f"  # in the SVG this becomes the page's own text color
GRAY = "#8c8c8c"
# Okabe and Ito's palette, grays, Tol's muted colors and ColorBrewer's, in the order in which agents are registered.
COLORS = (
    "#8c8c8c", "#b8860b", "#0072b2", "#d55e00", "#009e73", "#e69f00",
    "#999933", "#332288", "#cc79a7", "#56b4e9", "#882255", "#661100",
    "#44aa99", "#aa4499", "#117733", "#cc6677", "#7f5539", "#9aa600",
    "#4d9221", "#5b5ea6", "#c51b7d", "#5ab4ac", "#b35806", "#542788",
    "#01665e", "#bf812d", "#762a83", "#7fbc41", "#2166ac", "#b2182b",
    "#de77ae", "#35978f", "#a6761d", "#7570b3", "#e7298a", "#1b7837",
)  # fmt: skip
Failures = dict[str, dict[int, tuple[int, Counter[str]]]]
"""By agent and budget: tests of all seeds, and failures by cause."""
_CAUSE_COLORS = ("#0072b2", "#56b4e9", "#e69f00", "#cc79a7", "#882255", "#8c8c8c", "#2b2b2f")
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "imagine_bench",
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "axes.titlecolor"), INK),
    **dict.fromkeys(("xtick.color", "ytick.color"), INK),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "grid.color": GRAY,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "lines.linewidth": 2.0,
    "lines.markersize": 4.5,
    "legend.fontsize": 9,
    "figure.constrained_layout.w_pad": 0.1,  # in inches; letters are wider in the file than in the layout
}
REFERENCE: dict[str, Any] = {"color": INK, "linewidth": 1.0, "linestyle": (0, (4, 3)), "alpha": 0.7}
"""How a line of reference looks: chance, optimum, zero."""
_LONG = 32  # letters of a title that stand in one line beside a figure
_EPISODES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)


def image(name: str, draw: Callable[[], Figure], caption: str, *, svg: bool = False, dpi: int = 150) -> Image:
    """A figure in the style of all reports, as PNG of so many pixels an inch and, with ``svg``, as inline SVG too."""

    def drawn() -> tuple[bytes, str]:
        vector = io.StringIO()
        png = io.BytesIO()
        with mpl.rc_context(STYLE):
            figure = draw()
            FigureCanvasAgg(figure)
            figure.draw_without_rendering()
            figure.set_layout_engine("none")  # laid out once, for both files
            if svg:
                figure.savefig(vector, format="svg", metadata={"Date": None})
            figure.savefig(png, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
        return png.getvalue(), _inline(vector.getvalue(), name, caption) if svg else ""

    return Image(name, drawn, caption)


def plot(name: str, draw: Callable[[], Figure], caption: str) -> Image:
    """A plot of lines and bars, sharp at every size."""
    return image(name, draw, caption, svg=True, dpi=180)


def _inline(svg: str, name: str, alt: str) -> str:
    """Strip prologue, metadata and fixed size, and let text take the page's color."""
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", body, count=1)
    body = re.sub(r'(<svg[^>]*?) width="[^"]*"', rf'\1 role="img" aria-label="{alt}"', body, count=1)
    body = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{name}-", body)  # ids of several figures share one page
    return body.replace(INK, "currentColor")


def color(agent: str, known: Iterable[str] | None = None) -> str:
    """The color of an agent, or of another learner of these known ones, the same in every figure.

    A guest of this suite has its color also where its package is not installed.
    """
    of_guests = (name for guest in guests() for name in guest.names[AGENT_GROUP])
    names = [*AGENTS, *of_guests] if known is None else list(known)
    bases = [name for name in names if re.match(rf"{re.escape(name)}([:,]|$)", agent)]
    base = max(bases, key=len, default=agent)
    place = names.index(base) if base in names else sum(base.encode())
    other = 1 + crc32(agent.encode()) % (len(COLORS) - 1) if agent != base else 0  # never that of the agent as it is
    return COLORS[(place + other) % len(COLORS)]


def colors(agents: Iterable[str]) -> dict[str, str]:
    """The colors of agents by title."""
    return {agent_title(agent): color(agent) for agent in agents}


def wrapped(title: str) -> str:
    """A long title in lines; what is in brackets begins one."""
    parts = [title] if len(title) <= _LONG else title.replace(" (", "\n(").splitlines()
    return "\n".join(line for part in parts for line in textwrap.wrap(part, _LONG))


# Primitives --------------------------------------------------------------------------------------------------------


def panel(height: float = 4.2) -> tuple[Figure, Axes]:
    """A figure of one panel, as wide as a page, its height in inches."""
    figure = Figure(figsize=(9.2, height), layout="constrained")
    return figure, figure.add_subplot()


def small_multiples(
    count: int, columns: int, *, width: float, height: float, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels in so many columns, each of this width and height in inches."""
    columns = min(columns, count)
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns + 0.8, height * lines + 0.7), layout="constrained")
    every = list(figure.subplots(lines, columns, squeeze=False, sharey=sharey).ravel())
    for spare in every[count:]:
        spare.set_visible(False)
    return figure, every[:count]


def curve(axes: Axes, values: Mapping[Any, float | Estimate], *, scale: float = 1.0, **style: Any) -> None:
    """A line through values at their places on the x axis, and a band of their intervals where they are estimates."""
    ends = [each[:3] if isinstance(each, Estimate) else (each, each, each) for each in values.values()]
    table = scale * np.array(ends, dtype=float).reshape(-1, 3)  # [points, 3]
    (line,) = axes.plot(list(values), table[:, 0], **{"marker": "o", "zorder": 3, **style})
    axes.fill_between(list(values), table[:, 1], table[:, 2], color=line.get_color(), alpha=0.18, linewidth=0)


def lines(
    panels: Mapping[str, Mapping[str, Mapping[Any, float]]], by_name: Mapping[str, str], xlabel: str, ylabel: str = "",
    columns: int = 3,
) -> Figure:  # fmt: skip
    """A curve a name in each panel, by title; names have the same color everywhere and stand below."""
    columns = min(columns, len(panels))
    figure, every = small_multiples(len(panels), columns, width=9.0 / columns, height=max(2.2, 6.0 / columns))
    for axes, (title, curves) in zip(every, panels.items(), strict=True):
        for name, values in curves.items():
            curve(axes, values, color=by_name[name], label=name)
        axes.set_title(title, fontsize=9.5)
        axes.margins(y=0.06)  # lines along an axis are seen whole
    figure.supxlabel(xlabel)
    figure.supylabel(ylabel)
    names_below(figure)
    return figure


def log_axis(
    axes: Axes, ticks: Mapping[float, str] | Sequence[int], label: str = "real training episodes (logarithmic)"
) -> None:
    """A logarithmic x axis with these ticks alone, which may have names."""
    names = ticks if isinstance(ticks, Mapping) else {tick: f"{tick:,}" for tick in ticks}
    axes.set_xscale("log")
    axes.set_xticks(list(names), list(names.values()), rotation=45, ha="right")
    axes.minorticks_off()
    axes.set_xlabel(label)


def names_below(figure: Figure) -> None:
    """The names of the first panel's lines or bars, below all panels."""
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)


class Rung(NamedTuple):
    """A row of :func:`rungs`: a bar from ``low`` to ``high``, a mark at ``value``, and points."""

    name: str
    color: str
    value: float
    low: float
    high: float
    points: Sequence[float] = ()


def rungs(axes: Axes, rows: Sequence[Rung], beyond: float = np.inf) -> None:
    """Bars with intervals, a row each from the top down; points at ``beyond`` are triangles: they lie past the end."""
    for place, row in enumerate(rows):
        axes.plot([row.low, row.high], [place, place], color=row.color, alpha=0.4)
        axes.plot([row.value], [place], "|", color=row.color, markersize=13, markeredgewidth=2.5)
        shifts = np.linspace(-0.12, 0.12, len(row.points))
        for point, shift in zip(row.points, shifts, strict=True):
            axes.plot([point], [place + shift], ">" if point == beyond else "o", color=row.color)
    axes.set_yticks(range(len(rows)), [row.name for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)


def stacked(axes: Axes, places: Sequence[str], parts: Mapping[str, Sequence[float]], colors: Mapping[str, str]) -> None:
    """Bars of several parts, one bar a place."""
    bottom = np.zeros(len(places))
    for name, values in parts.items():
        axes.bar(places, values, 0.8, bottom=bottom, color=colors[name], label=name)
        bottom += np.asarray(values)
    axes.grid(visible=False, axis="x")


# Figures that pages of the documentation draw too -------------------------------------------------------------------


def ladder_figure(reached: Mapping[str, Sequence[int | None]], last: int, lowest: float | None) -> Figure:
    """Real episodes until the task is learned: a row an agent and a point a seed, the quickest at the bottom.

    Args:
        reached: By agent, of every seed the test from which on it is solved; None where it never was.
        last: Episodes of the last test: those that never solved it stand as triangles beyond it.
        lowest: Episodes that a cautious learner with the factor graph needs, or None where not known.
    """
    beyond = 1.6 * last
    found = {agent: [beyond if each is None else each for each in seeds] for agent, seeds in reached.items()}
    least = min(lowest or beyond, *(min(seeds) for seeds in found.values()))
    rows = []
    for agent in sorted(found, key=lambda agent: (-np.median(found[agent]), -np.mean(found[agent]))):
        middle = float(np.median(found[agent]))
        rows.append(Rung(wrapped(agent_title(agent)), color(agent), middle, least, middle, found[agent]))
    lines = max(row.name.count("\n") for row in rows) + 1
    figure, axes = panel(1.4 + 0.2 * len(rows) * max(1.7, lines))
    rungs(axes, rows, beyond)
    if lowest is not None:
        axes.axvline(lowest, **REFERENCE)
        axes.set_title(f"dashed: cost of a cautious learner, {lowest:.0f} episodes", fontsize=9, fontweight="normal")
    ticks = [each for each in _EPISODES if each <= last]
    log_axis(axes, {**{tick: f"{tick:,}" for tick in ticks}, beyond: "never"})
    axes.set_xlim(0.6 * least, 1.1 * beyond)
    return figure


def causes_figure(found: Failures) -> Figure:
    """Failed test episodes (%) by cause, stacked, at every budget, a panel an agent."""
    figure, every = small_multiples(len(found), 3, width=2.9, height=2.5, sharey=True)
    colors = dict(zip(CAUSES, _CAUSE_COLORS, strict=True))
    shown = [name for name in CAUSES if any(counts[name] for rows in found.values() for _, counts in rows.values())]
    for axes, (agent, by_budget) in zip(every, found.items(), strict=True):
        parts = {name: [100.0 * counts[name] / tests for tests, counts in by_budget.values()] for name in shown}
        stacked(axes, [f"{budget:,}" for budget in by_budget], parts, colors)
        axes.set_title(agent_title(agent), fontsize=9.5)
        axes.tick_params(axis="x", rotation=45)
        axes.set_ylim(0, 100)
    figure.supxlabel("real training episodes")
    figure.supylabel("test episodes that failed (%)")
    names_below(figure)
    return figure


def radar_figure(spokes: Sequence[str], scores: Mapping[str, Sequence[Estimate]]) -> Figure:
    """Scores of agents, 0 in the middle and 1 at the rim, by spoke; NaN is a gap, and below 0 is drawn at 0."""
    figure = Figure(figsize=(8.4, 6.8), layout="constrained")
    axes = figure.add_subplot(projection="polar", theta_offset=np.pi / 2.0, theta_direction=-1)
    angles = np.linspace(0.0, 2.0 * np.pi, len(spokes) + 1)
    for agent, estimates in scores.items():
        ends = np.clip([each[:3] for each in (*estimates, estimates[0])], 0.0, 1.0)
        around = {angle: Estimate(*each) for angle, each in zip(angles, ends, strict=True)}
        curve(axes, around, color=color(agent), label=agent_title(agent))
    axes.set(ylim=(0.0, 1.0), yticks=(0.25, 0.5, 0.75, 1.0))
    axes.set_xticks(angles[:-1], [spoke.replace("_", " ") for spoke in spokes])
    names_below(figure)
    return figure
