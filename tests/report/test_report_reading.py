"""A report can be read: nothing clipped, no ``nan``, sound Markdown, an answer about the budget that tells most."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from fake_results import LEVELS, bench_result
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from report_pages import check_report, narrowest_px, read_tables

from imagine_bench.protocols.control import Protocol
from imagine_bench.registry import AGENTS, AgentEntry
from imagine_bench.report import figures, text, write_report
from imagine_bench.report.data import ReportData, collect
from imagine_bench.report.page import markdown_code, markdown_text
from imagine_bench.report.tables import DASH, Cell, Table
from imagine_bench.store.results import BenchResult


def make(folder: Path, agents: tuple[str, ...], budgets: tuple[int, ...], seeds: tuple[int, ...]) -> BenchResult:
    protocol = Protocol(task="arrow_puzzle", preset="thesis", agents=agents, budgets=budgets, seeds=seeds)
    return bench_result(folder, protocol=protocol)


def short_run(folder: Path) -> ReportData:
    """Two budgets that end long before the thesis' begin."""
    return collect(make(folder, ("dqn", "imagination", "imagination_uncertainty"), (10, 20), (0, 1)))


def with_successes(result: BenchResult, successes: dict[str, tuple[int, ...]]) -> BenchResult:
    """The result with other successes at each budget."""
    runs = []
    for run in result.runs:
        pairs = zip(run.checkpoints, successes[run.agent], strict=True)
        points = tuple(dataclasses.replace(point, successes=count) for point, count in pairs)
        runs.append(dataclasses.replace(run, checkpoints=points))
    return dataclasses.replace(result, runs=tuple(runs))


def test_the_answer_is_about_the_budget_that_tells_most(tmp_path: Path) -> None:
    result = make(tmp_path, ("oracle", "dqn", "imagination"), (100, 200, 300), (0, 1, 2))
    result = with_successes(result, {"oracle": (200,) * 3, "dqn": (60, 80, 198), "imagination": (70, 180, 199)})
    answers = text.answers(collect(result))
    assert answers[0].startswith("After 200 real episodes, where the learners differ most, DQN")
    assert "solves 40.0\u00a0%" in answers[0]
    assert answers[1].startswith("“imagination” solves 90.0\u00a0%, 50.0 percentage points more than DQN")


def test_one_agent_far_ahead_does_not_choose_the_budget(tmp_path: Path) -> None:
    agents = ("dqn", "imagination", "imagination_uncertainty", "imagination_only")
    result = make(tmp_path, agents, (100, 200), (0, 1, 2))
    levels = {"dqn": (20, 100), "imagination": (20, 160), "imagination_uncertainty": (20, 150)}
    data = collect(with_successes(result, {**levels, "imagination_only": (200, 200)}))
    assert data.spread(100) == 0.0
    assert data.decisive_budget == 200


def test_without_any_difference_it_is_about_the_last_budget(tmp_path: Path) -> None:
    result = make(tmp_path, ("dqn", "imagination"), (100, 200), (0, 1))
    data = collect(with_successes(result, {"dqn": (90, 100), "imagination": (90, 100)}))
    assert data.decisive_budget == 200
    assert text.answers(data)[0].startswith("After 200 real episodes DQN")


@pytest.mark.parametrize("seeds", [pytest.param((0,), marks=pytest.mark.slow), (0, 1, 2)])
def test_the_widest_report_can_be_read(seeds: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = ("sb3_dqn", "sb3_qrdqn", "sb3_dqn_latents", "imagination_only_uncertainty", "factored:given")
    for agent in others:
        monkeypatch.setitem(LEVELS, agent, (0.1, 0.9))
    agents = (*(name for name in LEVELS if name not in others), *others)
    budgets = (20, 40, 60, 80, 100, 250, 500, 1000, 2000, 6000)
    folder = write_report(make(tmp_path, agents, budgets, seeds)).parent
    check_report(folder)
    widest = max(read_tables((folder / "index.html").read_text(encoding="utf-8")), key=lambda table: len(table[0]))
    assert len(widest[0]) == 12 and narrowest_px(widest) > 700  # ten budgets, a name and a seed: not vacuous


def test_reports_of_few_runs_can_be_read(tmp_path: Path) -> None:
    for index, agents in enumerate((("random", "oracle"), ("dqn",), ("imagination_uncertainty",))):
        check_report(write_report(make(tmp_path / str(index), agents, (5,), (0,))).parent)


def test_a_dash_is_explained_only_where_there_is_one() -> None:
    table = Table(name="t", header=["a", "b"], rows=[["x", "1"]], caption="Numbers.", why_dash="not measured")
    assert table.remark == "Numbers."
    assert dataclasses.replace(table, rows=[["x", DASH]]).remark == "Numbers. –: not measured."
    assert str(Cell(text="61.3", interval="[55.0, 67.2]", note="thesis 60.0")) == "61.3 [55.0, 67.2]; thesis 60.0"


def test_far_points_of_the_thesis_do_not_stretch_the_plots(tmp_path: Path) -> None:
    data = short_run(tmp_path)
    assert min(data.thesis["dqn"]) == 2000
    axes = figures.success_figure(data).axes[0]
    assert axes.get_xlim()[1] < 25
    assert not any("thesis" in label.get_text() for label in axes.get_legend().get_texts())
    assert not (write_report(data.result).parent / "gain.png").exists()
    page = (data.result.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert "Diamonds" not in page and "42.2 (6.0)" in page, "the table still says it"


def test_leader_lines_stay_in_the_margin(tmp_path: Path) -> None:
    data = short_run(tmp_path)
    for draw in (figures.success_figure, figures.acceptance_figure):
        axes = draw(data).axes[0]
        assert axes.texts
        colors = {line.get_color() for line in axes.get_lines()}
        for label in axes.texts:
            assert label.xy[0] > 1.0 and label.get_position()[0] > 1.0, "right of the axes"
            assert label.arrow_patch.get_edgecolor() not in colors and label.arrow_patch.get_linestyle() == "solid"


def test_a_name_with_many_settings_stays_in_the_picture() -> None:
    agent = "dreamer_v3:actor_learning_rate=0.001,critic_learning_rate=0.001,model_learning_rate=0.001,replay_ratio=4"
    with mpl.rc_context(figures.STYLE):
        figure = Figure(figsize=(9.2, 4.9), layout="constrained")
        axes = figure.add_subplot()
        axes.set_ylim(-2, 108)
        figures._end_labels(axes, {agent: 50.0}, 1.0)
        FigureCanvasAgg(figure).draw()
    (label,) = axes.texts
    written = label.get_window_extent()
    assert written.x1 <= figure.bbox.x1 and axes.bbox.width > 0.5 * figure.bbox.width
    assert label.get_text().replace("\n", " ").endswith("replay_ratio 4)"), "all of it"


def test_names_move_only_as_far_as_they_must() -> None:
    assert figures.spread_labels([4.0, 98.0, 99.0, 100.0], [5.0] * 4, top=106.0) == [4.0, 96.0, 101.0, 106.0]
    assert figures.spread_labels([0.0, 0.0, 50.0], [5.0] * 3, top=106.0) == [0.0, 5.0, 50.0]
    assert figures.spread_labels([0.0, 0.0, 0.0], [2.0, 6.0, 2.0], top=106.0) == [0.0, 4.0, 8.0]


def test_lines_along_an_axis_are_not_clipped(tmp_path: Path) -> None:
    data = short_run(tmp_path)
    loop = data.open_loop["imagination"]
    loop = dataclasses.replace(loop, reward_mae=0.0 * loop.reward_mae, correct=0.0 * loop.correct + 1.0)
    for axes in figures.open_loop_figure(dataclasses.replace(data, open_loop={"imagination": loop})).axes[:3]:
        low, high = axes.get_ylim()
        values = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()])
        assert low < np.nanmin(values) and np.nanmax(values) < high


def test_names_are_escaped_in_markdown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = AgentEntry(make="x:make", title="my_agent | <b>", description="Has *stars*\nand lines.")
    monkeypatch.setitem(AGENTS, "imagination_only", entry)
    folder = write_report(make(tmp_path, ("dqn", "imagination_only"), (5, 10), (0, 1))).parent
    markdown = (folder / "report.md").read_text(encoding="utf-8")
    assert r"| my\_agent \| \<b\> | Has \*stars\* and lines. |" in markdown
    assert "my_agent |" not in markdown and "<b>" not in markdown
    check_report(folder)
    assert markdown_text("[a](b) `c` d_e") == r"[a]\(b) \`c\` d\_e"
    assert markdown_text("# a & <b>") == r"\# a \& \<b\>"
    assert markdown_code("a`b``c\nd") == "``` a`b``c d ```" and markdown_code("a") == "`a`"
