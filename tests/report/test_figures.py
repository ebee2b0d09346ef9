"""Figures draw the numbers of the tables: nothing is clipped, and nothing unknown is drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fake_results import WIDE, bench_result
from matplotlib.axes import Axes

from imagine_bench.report import figures
from imagine_bench.report.bench import success_figure
from imagine_bench.report.data import ReportData, collect, open_loop_means
from imagine_bench.report.sections import open_loop_figure


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ReportData:
    return collect(bench_result(tmp_path_factory.mktemp("bench"), protocol=WIDE))


def lines(axes: Axes) -> list[list[tuple[float, float]]]:
    """The points of every line."""
    return [[(float(x), float(y)) for x, y in line.get_xydata()] for line in axes.get_lines()]


def test_the_success_figure_draws_scores_bands_and_the_thesis(data: ReportData) -> None:
    (axes,) = success_figure(data).axes
    for agent in WIDE.agents:
        assert [(row["episodes"], 100.0 * row["success_iqm"]) for row in data.of(agent)] in lines(axes)
    assert len(axes.collections) >= len(WIDE.agents)
    thesis = [(budget, 100.0 * mean) for budget, (mean, _) in data.thesis["dqn"].items()]
    assert any(np.allclose(each, thesis) for each in lines(axes) if len(each) == len(thesis))
    short = bench_result(data.result.folder, protocol=dataclasses.replace(WIDE, budgets=(10, 20)))
    assert success_figure(collect(short)).axes[0].get_xlim()[1] < 25, "far points of the thesis do not stretch it"


def test_an_uncertainty_that_an_agent_does_not_know_is_not_drawn(data: ReportData) -> None:
    drawn = []
    loop = open_loop_means(data.result)["imagination"]
    for each in (loop, {**loop, "aleatoric": np.zeros_like(loop["aleatoric"])}):
        drawn.append({axes.get_title(): lines(axes) for axes in open_loop_figure({"imagination": each}).axes})
    assert [len(panels["aleatoric"]) for panels in drawn] == [1, 0]
    assert all(len(panels["reward error"]) == 1 for panels in drawn)


def test_lines_along_an_axis_are_not_clipped() -> None:
    panels = {"zeros": {"a": {1: 0.0, 2: 0.0}}, "ones": {"a": {1: 1.0, 2: 1.0}, "b": {1: 0.5, 2: 1.0}}}
    figure = figures.lines(panels, {"a": "#000000", "b": "#0072b2"}, "depth")
    assert [axes.get_title() for axes in figure.axes] == list(panels)
    for axes in figure.axes:
        low, high = axes.get_ylim()
        values = np.array([y for line in lines(axes) for _, y in line])
        assert low < values.min() and values.max() < high


def test_no_two_registered_agents_share_a_color() -> None:
    own = ("random", "oracle", "dqn", "imagination", "imagination_uncertainty", "imagination_only", "factored")
    assert len({figures.color(agent) for agent in own}) == len(own)
    assert figures.color("an agent that nobody registered").startswith("#")
    assert figures.colors(own)["dqn"] == figures.color("dqn")
