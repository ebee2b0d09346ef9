"""Figures draw the numbers of the tables: nothing is clipped, and nothing unknown is drawn."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable
from itertools import combinations

import numpy as np
import pytest
from fake_results import DEPTH, WIDE, bench_result
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb

from imagine_bench import registry
from imagine_bench.interfaces import Floats
from imagine_bench.protocols.control import protocol
from imagine_bench.recording.filmstrips import DARK, LIGHT
from imagine_bench.recording.stream import KINDS, SERIES
from imagine_bench.report import figures
from imagine_bench.report.bench import success_figure
from imagine_bench.report.data import ReportData, collect, open_loop_csv, open_loop_means
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
    for agent, band in zip(WIDE.agents, axes.collections, strict=False):  # three seeds: from the lowest to the highest
        runs = [[(row.episodes, 100.0 * row.success_rate) for row in run.checkpoints] for run in data.result.of(agent)]
        assert all(each in lines(axes) for each in runs), "thin lines"
        ends = {(x, end(y)) for x, *y in zip(WIDE.budgets, *np.array(runs)[:, :, 1], strict=True) for end in (min, max)}
        assert {(x, y) for path in band.get_paths() for x, y in path.vertices.tolist()} == ends
    levels = [line[0][1] for line in lines(axes) if [x for x, _ in line] == [0.0, 1.0]]
    assert levels == [100.0 * data.facts.optimum, 100.0 * data.facts.chance_level]
    looks = {(line.get_color(), line.get_marker()) for line in axes.get_lines()}
    assert {(style["color"], style["marker"]) for style in map(figures.line_style, WIDE.agents)} <= looks
    thesis = [(budget, 100.0 * mean) for budget, (mean, _) in data.thesis["dqn"].items()]
    assert any(np.allclose(each, thesis) for each in lines(axes) if len(each) == len(thesis))
    bars = [[(x, 100.0 * (mean + std)) for std in (-std, std)] for x, (mean, std) in data.thesis["dqn"].items()]
    assert any(np.allclose(each.get_segments(), bars) for each in axes.collections if isinstance(each, LineCollection))
    short = bench_result(data.result.folder, protocol=dataclasses.replace(WIDE, budgets=(800, 1000, 1240)))
    (axes,) = success_figure(collect(short)).axes
    assert axes.get_xlim()[1] < 2600, "far points of the thesis do not stretch it"
    ticks = {axes.get_xticks()[place]: label.get_text() for place, label in enumerate(axes.get_xticklabels())}
    assert ticks == {800: "800", 1000: "", 1240: "1,240"}, "words that would overlap are left out"


@pytest.mark.parametrize(
    ("budgets", "labelled"),
    [((30, 35, 40, 45, 50, 60, 70, 80), ["35", "45", "60", "80"]), ((100, 125, 1000), ["100", "125", "1,000"])],
)
def test_as_many_budgets_are_labelled_as_have_room(
    data: ReportData, budgets: tuple[int, ...], labelled: list[str]
) -> None:
    """From the largest one on, each that is a fifth below the last that was labelled."""
    result = bench_result(data.result.folder, protocol=dataclasses.replace(WIDE, budgets=budgets))
    (axes,) = success_figure(collect(result)).axes
    assert axes.get_xticks().tolist() == list(budgets)
    assert [text for label in axes.get_xticklabels() if (text := label.get_text())] == labelled


def test_the_open_loop_figure_draws_the_means_of_the_file_by_depth(data: ReportData) -> None:
    """The first macro-action that is imagined has depth 1."""
    loops = open_loop_means(data.result)
    first = next(run for run in data.result.runs if run.agent == "imagination").checkpoints[-1].open_loop
    assert first is not None
    known = first.auroc_epistemic.copy()
    first.auroc_epistemic[0] = np.nan
    some = open_loop_means(data.result)["imagination"]["auroc_epistemic"]
    first.auroc_epistemic[0] = known[0]
    assert some == pytest.approx(known), "of the runs in which it is known"
    assert loops["imagination"]["count"].tolist() == [100 * len(WIDE.seeds)] * DEPTH
    assert np.isnan(loops["imagination"]["auroc_modal"][0]), "unknown in every run"
    panels = {axes.get_title(): lines(axes) for axes in open_loop_figure(loops).axes}
    rows = [row for row in csv.DictReader(io.StringIO(open_loop_csv(data.result))) if row["episodes"] == "6000"]
    depths = range(1, DEPTH + 1)
    for title, name, scale in (
        ("macrostate right (%)", "correct", 100),
        ("wrong about the end (%)", "termination_error", 100),
        ("reward error", "reward_mae", 1),
    ):
        for agent, drawn in zip(loops, panels[title], strict=True):
            of = [row for row in rows if row["agent"] == agent]
            seeds = [[float(row[name]) for row in of if row["depth"] == str(depth)] for depth in depths]
            assert np.array(drawn) == pytest.approx(np.column_stack([depths, scale * np.mean(seeds, axis=1)])), title


def test_an_uncertainty_that_an_agent_does_not_know_is_not_drawn(data: ReportData) -> None:
    drawn = []
    loop = open_loop_means(data.result)["imagination"]
    for each in (loop, {**loop, "aleatoric": np.zeros_like(loop["aleatoric"])}):
        drawn.append({axes.get_title(): lines(axes) for axes in open_loop_figure({"imagination": each}).axes})
    assert [len(panels["aleatoric"]) for panels in drawn] == [1, 0]
    assert all(len(panels["reward error"]) == 1 for panels in drawn)


@pytest.mark.parametrize("count", [1, 3, 5])
@pytest.mark.parametrize("columns", [1, 2, 4])
def test_a_figure_has_as_many_panels_as_there_is_something_to_draw(count: int, columns: int) -> None:
    figure, panels = figures.small_multiples(count, columns, width=2.0, height=1.0)
    assert len(panels) == count
    assert [axes for axes in figure.axes if axes.get_visible()] == panels


def test_lines_along_an_axis_are_not_clipped() -> None:
    panels = {"zeros": {"a": {1: 0.0, 2: 0.0}}, "ones": {"a": {1: 1.0, 2: 1.0}, "b": {1: 0.5, 2: 1.0}}}
    figure = figures.lines(panels, {name: figures.line_style(name) for name in "ab"}, "depth")
    assert [axes.get_title() for axes in figure.axes] == list(panels)
    for axes in figure.axes:
        low, high = axes.get_ylim()
        values = np.array([y for line in lines(axes) for _, y in line])
        assert low < values.min() and values.max() < high


_VISION = {
    "common": np.eye(3),
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
}
"""Linear RGB as people with a color deficiency see it, severity 1.0 (Machado, Oliveira and Fernandes, 2009)."""
_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
"""Linear sRGB to CIE XYZ (IEC 61966-2-1), white D65."""


def lab(color: str | tuple[int, ...], vision: str) -> Floats:
    """CIELAB (CIE 1976) of a color as somebody sees it."""
    srgb = np.array(to_rgb(color)) if isinstance(color, str) else np.array(color) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(_VISION[vision]) @ linear, 0.0, 1.0)
    xyz = _XYZ @ seen / _XYZ.sum(axis=1)
    x, y, z = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def least_difference(colors: Iterable[str | tuple[int, ...]], vision: str) -> float:
    labs = [lab(color, vision) for color in colors]
    return min(float(np.linalg.norm(one - other)) for one, other in combinations(labs, 2))


@pytest.mark.parametrize("vision", _VISION)
@pytest.mark.parametrize("palette", [figures.COLORS, KINDS.values(), SERIES, LIGHT, DARK])
def test_color_blind_readers_tell_every_palette_apart(palette: Iterable[str], vision: str) -> None:
    assert least_difference(palette, vision) > 19


def test_a_palette_that_is_known_to_fail_fails() -> None:
    assert least_difference(("#b8860b", "#d55e00"), "deuteranopia") < 4, "oracle and imagination of 0.1"


def test_no_two_agents_have_the_same_line() -> None:
    every = [tuple(figures.line_style(agent).values()) for agent in registry.agents()]
    assert len(set(every)) == len(every)
    compared = protocol("arrow_puzzle", "quick").agents
    assert len({figures.color(agent) for agent in compared}) == len(set(compared))
    assert figures.color("an agent that nobody registered").startswith("#")
