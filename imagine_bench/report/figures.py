"""Figures in one style, color-blind-safe: small multiples of curves with their intervals.

A figure is drawn by a function that returns a matplotlib ``Figure``; :func:`image` makes a PNG of it. Filmstrips are
images of their own.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from typing import Any
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.report.data import agent_title
from imagine_bench.report.page import Image
from imagine_bench.statistics import Estimate

INK = "#2b2b2f"
# Okabe and Ito's palette, grays, Tol's muted colors and ColorBrewer's, in the order in which agents are registered.
COLORS = (
    "#8c8c8c", "#b8860b", "#0072b2", "#d55e00", "#009e73", "#e69f00",
    "#999933", "#332288", "#cc79a7", "#56b4e9", "#882255", "#661100",
    "#44aa99", "#aa4499", "#117733", "#cc6677", "#7f5539", "#9aa600",
    "#4d9221", "#5b5ea6", "#c51b7d", "#5ab4ac", "#b35806", "#542788",
    "#01665e", "#bf812d", "#762a83", "#7fbc41", "#2166ac", "#b2182b",
    "#de77ae", "#35978f", "#a6761d", "#7570b3", "#e7298a", "#1b7837",
)  # fmt: skip
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.alpha": 0.4,
    "lines.linewidth": 2.0,
    "lines.markersize": 4.5,
    "legend.fontsize": 9,
}
REFERENCE: dict[str, Any] = {"color": INK, "linewidth": 1.0, "linestyle": (0, (4, 3)), "alpha": 0.7}
"""How a line of reference looks: chance, optimum, zero."""


def image(name: str, draw: Callable[[], Figure], caption: str) -> Image:
    """A figure in the style of all reports, drawn when it is first asked for."""

    def styled() -> Figure:
        with mpl.rc_context(STYLE):
            return draw()

    def png() -> bytes:
        content = io.BytesIO()
        with mpl.rc_context(STYLE):
            draw().savefig(content, format="png", dpi=160, facecolor="white", metadata={"Software": None})
        return content.getvalue()

    return Image(name, png, caption, styled)


def color(name: str) -> str:
    """The color of an agent, the same in every figure."""
    names = list(registry.agents())
    place = names.index(name) if name in names else crc32(name.encode())
    return COLORS[place % len(COLORS)]


def colors(agents: Iterable[str]) -> dict[str, str]:
    """The colors of agents by title."""
    return {agent_title(agent): color(agent) for agent in agents}


def small_multiples(count: int, columns: int, *, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels in so many columns, each of this width and height in inches."""
    columns = min(columns, count)
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns + 0.8, height * lines + 0.7), layout="constrained")
    every = list(figure.subplots(lines, columns, squeeze=False).ravel())
    for spare in every[count:]:
        spare.set_visible(False)
    return figure, every[:count]


def curve(axes: Axes, values: Mapping[Any, float | Estimate], **style: Any) -> None:
    """A line through values at their places on the x axis, and a band of their intervals where they are estimates."""
    ends = [each[:3] if isinstance(each, Estimate) else (each, each, each) for each in values.values()]
    middle, low, high = np.array(ends, dtype=float).reshape(-1, 3).T
    (line,) = axes.plot(list(values), middle, **{"marker": "o", "zorder": 3, **style})
    axes.fill_between(list(values), low, high, color=line.get_color(), alpha=0.18, linewidth=0)


def lines(
    panels: Mapping[str, Mapping[str, Mapping[Any, float | Estimate]]], by_name: Mapping[str, str], xlabel: str
) -> Figure:
    """A curve a name in each panel, three panels a row; names have the same color everywhere and stand above."""
    columns = min(3, len(panels))
    figure, every = small_multiples(len(panels), columns, width=9.0 / columns, height=max(2.2, 5.0 / columns))
    for axes, (title, curves) in zip(every, panels.items(), strict=True):
        for name, values in curves.items():
            curve(axes, values, color=by_name[name], label=name)
        axes.set_title(title, fontsize=9.5)
        axes.margins(y=0.06)  # lines along an axis are seen whole
    figure.supxlabel(xlabel)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
