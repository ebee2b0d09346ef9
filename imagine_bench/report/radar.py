"""A radar chart: one spoke an experiment, one outline an agent, with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from imagine_bench.report.figures import color
from imagine_bench.report.text import agent_words
from imagine_bench.statistics import Estimate

_APART = 0.05  # radians between agents at a spoke, so that intervals do not cover each other
_UPRIGHT = 0.1  # sine of an angle up to which a spoke's name is centered on it


def radar_figure(spokes: Sequence[str], scores: Mapping[str, Sequence[Estimate]]) -> Figure:
    """Scores of agents, 0 in the middle and 1 at the rim, by spoke; NaN is a gap, and below 0 is drawn at 0."""
    figure = Figure(figsize=(8.4, 6.8), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    angles = np.linspace(0.0, 2.0 * np.pi, len(spokes), endpoint=False)
    for number, (agent, estimates) in enumerate(scores.items()):
        values, low, high = (np.clip(column, 0.0, 1.0) for column in np.array([each[:3] for each in estimates]).T)
        around = angles + _APART * (number - (len(scores) - 1) / 2.0)
        style: dict[str, Any] = {"color": color(agent), "linewidth": 1.8}
        axes.plot([*around, around[0]], [*values, values[0]], label=agent_words(agent).title, alpha=0.8, **style)
        axes.vlines(around, low, high, alpha=0.5, **style)
        axes.plot(around, values, "o", color=color(agent), markersize=4.5)
    axes.set(ylim=(0.0, 1.0), yticks=(0.25, 0.5, 0.75, 1.0), xticks=angles, yticklabels=("0.25", "0.5", "0.75", "1"))
    axes.set_theta_zero_location("N")  # type: ignore[attr-defined]  # of a polar projection
    axes.set_theta_direction(-1)  # type: ignore[attr-defined]
    axes.set_rlabel_position(180.0 / max(len(spokes), 1))  # type: ignore[attr-defined]
    axes.tick_params(axis="y", labelsize=8)
    axes.set_xticklabels([spoke.replace("_", " ") for spoke in spokes])
    axes.tick_params(axis="x", pad=2)
    for label, angle in zip(axes.get_xticklabels(), angles, strict=True):
        side = np.sin(angle)
        label.set_horizontalalignment("center" if abs(side) < _UPRIGHT else "left" if side > 0.0 else "right")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    return figure
