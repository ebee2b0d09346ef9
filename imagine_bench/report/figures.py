"""Figures in one style, safe for color-blind readers: small multiples of curves with their intervals.

A figure is drawn by a function that returns a matplotlib ``Figure``; :func:`image` makes a PNG of it. Filmstrips are
images of their own.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypedDict
from zlib import crc32

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imagine_bench import registry
from imagine_bench.report.page import Image
from imagine_bench.statistics import Estimate

INK = "#2b2b2f"
COLORS = ("#9a9a9a", "#202020", "#0072b2", "#7cc8f2", "#d55e00", "#1b7837", "#f0b400", "#7a1f6b")
"""Eight colors that readers with any common color vision tell apart: the least difference between two of them in CIELAB
(CIE 1976) is 25 under simulated deuteranopia, 19 under protanopia and 33 otherwise."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES: tuple[tuple[float, tuple[float, ...] | None], ...] = (
    (0.0, None),
    (0.0, (5.0, 1.5)),
    (0.0, (1.5, 1.0)),
    (0.0, (5.0, 1.5, 1.0, 1.5)),
    (0.0, (8.0, 1.5, 1.0, 1.0, 1.0, 1.5)),
)
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


_FIRST = (
    "random",
    "oracle",
    "dqn",
    "dqn_more_updates",
    "imagination",
    "imagination_uncertainty",
    "factored",
    "factored:given",
)
"""Agents that have a color each, wherever they are compared, whether their packages are installed or not."""


class LineStyle(TypedDict):
    """How the line of an agent looks, in the words of matplotlib."""

    color: str
    marker: str
    linestyle: tuple[float, tuple[float, ...] | None]


def line_style(name: str) -> LineStyle:
    """The color, marker and dash pattern of an agent's line, the same in every figure.

    Agents that share a color differ in marker and dash pattern: the three lengths have no common divisor, so that 280
    agents are told apart.
    """
    names = list(dict.fromkeys((*_FIRST, *registry.agents())))
    place = names.index(name) if name in names else crc32(name.encode())
    return LineStyle(
        color=COLORS[place % len(COLORS)],
        marker=MARKERS[place % len(MARKERS)],
        linestyle=DASHES[place % len(DASHES)],
    )


def color(name: str) -> str:
    """The color of an agent, the same in every figure."""
    return line_style(name)["color"]


def line_styles(agents: Iterable[str]) -> dict[str, LineStyle]:
    """The styles of agents' lines, by agent."""
    return {agent: line_style(agent) for agent in agents}


def small_multiples(count: int, columns: int, *, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels in so many columns, each of this width and height in inches."""
    columns = min(columns, count)
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns + 0.8, height * lines + 0.7), layout="constrained")
    every = list(figure.subplots(lines, columns, squeeze=False).ravel())
    for spare in every[count:]:
        spare.set_visible(False)
    return figure, every[:count]


def curve(axes: Axes, values: Mapping[int, float | Estimate], **style: Any) -> None:
    """A line through values at their places on the x axis, and a band of their intervals where they are estimates."""
    ends = [each[:3] if isinstance(each, Estimate) else (each, each, each) for each in values.values()]
    middle, low, high = np.array(ends, dtype=float).reshape(-1, 3).T
    (line,) = axes.plot(list(values), middle, **{"marker": "o", "zorder": 3, **style})
    axes.fill_between(list(values), low, high, color=line.get_color(), alpha=0.18, linewidth=0)


def lines(
    panels: Mapping[str, Mapping[str, Mapping[int, float | Estimate]]], styles: Mapping[str, LineStyle], xlabel: str
) -> Figure:
    """A curve a name in each panel, three panels a row; names have the same style everywhere and stand above."""
    columns = min(3, len(panels))
    figure, every = small_multiples(len(panels), columns, width=9.0 / columns, height=max(2.2, 5.0 / columns))
    for axes, (title, curves) in zip(every, panels.items(), strict=True):
        for name, values in curves.items():
            curve(axes, values, label=name, **styles[name])
        axes.set_title(title, fontsize=9.5)
        axes.margins(y=0.06)  # lines along an axis are seen whole
    figure.supxlabel(xlabel)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, handlelength=3.5)
    return figure
