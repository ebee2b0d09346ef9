"""The ladder: a rung an agent in the order of medians, a point a seed, and triangles for those that never learned."""

from __future__ import annotations

from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg

from imagine_bench.report import figures

REACHED = {
    "dqn": (1000, None, None),
    "random": (None, None, None),
    "factored": (60, 80, 60),
    "count_table": (250, 500, 250),
}
LAST, FLOOR = 2000, 62.0


def points(axes: Axes, marker: str) -> dict[str, list[float]]:
    """What stands on each rung, by its label."""
    labels = [label.get_text() for label in axes.get_yticklabels()]
    found: dict[str, list[float]] = {label: [] for label in labels}
    for line in axes.get_lines():
        if line.get_marker() == marker:
            for x, y in line.get_xydata():
                assert abs(y - round(y)) < 0.2
                found[labels[round(y)]].append(float(x))
    return found


def test_rungs_rise_with_the_medians_and_hold_every_seed() -> None:
    (axes,) = figures.ladder_figure(REACHED, LAST, FLOOR).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["factored", "count table", "DQN", "random"]
    learned, never = points(axes, "o"), points(axes, ">")
    assert learned == {"factored": [60, 80, 60], "count table": [250, 500, 250], "DQN": [1000], "random": []}
    assert [len(never[name]) for name in ("DQN", "random", "factored")] == [2, 3, 0]
    assert min(never["random"]) > LAST and axes.get_xscale() == "log"
    middles = points(axes, "|")
    assert middles["factored"] == [60.0] and middles["count table"] == [250.0] and middles["DQN"][0] > LAST


def test_the_floor_stands_where_the_certificate_has_it() -> None:
    (axes,) = figures.ladder_figure(REACHED, LAST, FLOOR).axes
    upright = [line.get_xdata() for line in axes.get_lines() if list(line.get_ydata()) == [0, 1]]
    assert [list(ends) for ends in upright] == [[FLOOR, FLOOR]]
    assert [text.get_text() for text in axes.texts] == ["information floor, 62"]
    (without,) = figures.ladder_figure(REACHED, LAST, None).axes
    assert not without.texts and "never" in [label.get_text() for label in without.get_xticklabels()]


def test_names_with_many_settings_leave_room_for_all() -> None:
    settings = ",".join(f"{name}_learning_rate=0.0003" for name in ("model", "actor", "critic"))
    long = {f"dreamer_v3:{settings},batch_size={size},replay_ratio=2": (None, None, 500) for size in (16, 64)}
    figure = figures.ladder_figure({**REACHED, **long}, LAST, FLOOR)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    (axes,) = figure.axes
    boxes = [label.get_window_extent() for label in axes.get_yticklabels()]
    assert all(below.y1 < above.y0 for below, above in pairwise(boxes))
    assert axes.get_window_extent().width > 0.6 * figure.get_window_extent().width
