"""Figures draw the numbers of the tables: nothing is clipped, and nothing unknown is drawn."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import matplotlib as mpl
import numpy as np
import pytest
from fake_results import bench_result
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg

from imagine_bench.protocols.control import Protocol
from imagine_bench.report import figures
from imagine_bench.report.bench import success_figure
from imagine_bench.report.data import ReportData, collect
from imagine_bench.report.imagination import open_loop_figure
from imagine_bench.statistics import Estimate

REACHED = {
    "dqn": (1000, None, None),
    "random": (None, None, None),
    "factored": (60, 80, 60),
    "count_table": (250, 500, 250),
}
LAST, LOWEST = 2000, 62.0


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ReportData:
    protocol = Protocol(task="arrow_puzzle", preset="thesis", budgets=(250, 2000, 6000), seeds=(0, 1, 7))
    return collect(bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol))


@pytest.fixture(scope="module")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> ReportData:
    """Two budgets that end long before the thesis' begin."""
    agents = ("dqn", "imagination", "imagination_uncertainty")
    protocol = Protocol(task="arrow_puzzle", preset="thesis", agents=agents, budgets=(10, 20), seeds=(0, 1))
    return collect(bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol))


def lines(axes: Axes) -> list[list[tuple[float, float]]]:
    """The points of every line."""
    return [[(float(x), float(y)) for x, y in line.get_xydata()] for line in axes.get_lines()]


def test_the_success_figure_draws_scores_and_bands(data: ReportData) -> None:
    axes = success_figure(data).axes[0]
    for scores in data.scores.values():
        assert [(budget, 100.0 * each.success.value) for budget, each in scores.items()] in lines(axes)
    assert len(axes.collections) >= len(data.scores)
    thesis = [(budget, 100.0 * mean) for budget, (mean, _) in data.thesis["dqn"].items()]
    assert any(np.allclose(each, thesis) for each in lines(axes) if len(each) == len(thesis))


def test_far_points_of_the_thesis_do_not_stretch_the_figures(short_run: ReportData) -> None:
    assert min(short_run.thesis["dqn"]) == 2000
    axes = success_figure(short_run).axes[0]
    assert axes.get_xlim()[1] < 25


def test_an_uncertainty_that_an_agent_does_not_know_is_not_drawn(data: ReportData) -> None:
    drawn = []
    loop = data.open_loop["imagination"]
    for each in (loop, dataclasses.replace(loop, aleatoric=np.zeros_like(loop.aleatoric))):
        changed = ReportData(data.result)
        vars(changed)["open_loop"] = {"imagination": each}
        drawn.append({axes.get_title(): lines(axes) for axes in open_loop_figure(changed).axes})
    assert [len(panels["aleatoric"]) for panels in drawn] == [1, 0]
    assert all(len(panels["reward error"]) == 1 for panels in drawn)


def test_lines_along_an_axis_are_not_clipped() -> None:
    panels = {"zeros": {"a": {1: 0.0, 2: 0.0}}, "ones": {"a": {1: 1.0, 2: 1.0}, "b": {1: 0.5, 2: 1.0}}}
    for axes in figures.lines(panels, {"a": "#000000", "b": "#0072b2"}, "depth").axes:
        low, high = axes.get_ylim()
        values = np.array([y for line in lines(axes) for _, y in line])
        assert low < values.min() and values.max() < high


# The ladder --------------------------------------------------------------------------------------------------------


def points(axes: Axes, marker: str) -> dict[str, list[float]]:
    """The points on each row, by its label."""
    labels = [label.get_text() for label in axes.get_yticklabels()]
    found: dict[str, list[float]] = {label: [] for label in labels}
    for line in axes.get_lines():
        if line.get_marker() == marker:
            ((x, y),) = line.get_xydata()
            assert abs(y - round(y)) < 0.2
            found[labels[round(y)]].append(float(x))
    return found


def test_rows_fall_with_the_medians_and_hold_every_seed() -> None:
    (axes,) = figures.ladder_figure(REACHED, LAST, LOWEST).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["random", "DQN", "count table", "factored"]
    learned, never = points(axes, "o"), points(axes, ">")
    assert learned == {"factored": [60, 80, 60], "count table": [250, 500, 250], "DQN": [1000], "random": []}
    assert [len(never[name]) for name in ("DQN", "random", "factored")] == [2, 3, 0]
    assert min(never["random"]) > LAST and axes.get_xscale() == "log"
    middles = points(axes, "|")
    assert middles["factored"] == [60.0] and middles["count table"] == [250.0] and middles["DQN"][0] > LAST


def test_the_cautious_learner_is_a_line_where_it_is_known() -> None:
    (axes,) = figures.ladder_figure(REACHED, LAST, LOWEST).axes
    upright = [line.get_xdata() for line in axes.get_lines() if list(line.get_ydata()) == [0, 1]]
    assert [list(ends) for ends in upright] == [[LOWEST, LOWEST]]
    assert "62 episodes" in axes.get_title(loc="left") + axes.get_title()
    (without,) = figures.ladder_figure(REACHED, LAST, None).axes
    assert "episodes" not in without.get_title(loc="left") + without.get_title()
    assert "never" in [label.get_text() for label in without.get_xticklabels()]


def test_names_with_many_settings_leave_room_for_all() -> None:
    settings = ",".join(f"{name}_learning_rate=0.0003" for name in ("model", "actor", "critic"))
    long = {f"dreamer_v3:{settings},batch_size={size},replay_ratio=2": (None, None, 500) for size in (16, 64)}
    with mpl.rc_context(figures.STYLE):
        figure = figures.ladder_figure({**REACHED, **long}, LAST, LOWEST)
        FigureCanvasAgg(figure).draw()
    (axes,) = figure.axes
    boxes = [label.get_window_extent() for label in axes.get_yticklabels()]
    assert all(above.y0 > below.y1 for above, below in pairwise(boxes))
    assert axes.get_window_extent().width > 0.6 * figure.get_window_extent().width


# Primitives --------------------------------------------------------------------------------------------------------


def test_a_curve_has_a_band_exactly_where_there_are_intervals() -> None:
    _, axes = figures.panel()
    figures.curve(axes, {1: Estimate(0.5, 0.25, 0.75), 2: Estimate(0.5, np.nan, np.nan)}, scale=100.0, color="#000000")
    assert lines(axes) == [[(1.0, 50.0), (2.0, 50.0)]]
    band = np.concatenate([path.vertices for path in axes.collections[0].get_paths()])
    assert {float(y) for x, y in band if x == 1.0} >= {25.0, 75.0}


def test_small_multiples_have_as_many_panels_as_asked_for() -> None:
    for count in (1, 4, 5):
        figure, panels = figures.small_multiples(count, 3, width=2.0, height=2.0)
        assert len(panels) == count and sum(axes.get_visible() for axes in figure.axes) == count


def test_the_radar_clips_scores_to_the_rim_and_leaves_gaps() -> None:
    spokes = ("memory", "size", "transfer")
    scores = {"dqn": [Estimate(-0.5, -1.0, 0.2), Estimate(np.nan, np.nan, np.nan), Estimate(1.0, 0.9, 1.2)]}
    (axes,) = figures.radar_figure(spokes, scores).axes
    radii = axes.get_lines()[0].get_ydata()
    assert list(radii[[0, 2, 3]]) == [0.0, 1.0, 0.0] and np.isnan(radii[1])
    assert [label.get_text() for label in axes.get_xticklabels()] == list(spokes)
