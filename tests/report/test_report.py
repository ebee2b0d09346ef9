"""Reports: the same numbers in page, Markdown, tables and terminal; self-contained; honest whichever way they fall."""

from __future__ import annotations

import csv
import dataclasses
import html
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_results import bench_result, compared_rollout

from imagine_bench import reference, registry, statistics
from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.judge import filmstrips
from imagine_bench.protocols.control import Protocol
from imagine_bench.registry import AGENTS, AgentEntry
from imagine_bench.report import figures, summary_table, write_report
from imagine_bench.report import text as words
from imagine_bench.report.data import collect
from imagine_bench.report.sections.imagination import encoder_views
from imagine_bench.report.sections.success import gain
from imagine_bench.report.text import percent, signed_percent
from imagine_bench.statistics import Estimate
from imagine_bench.store.results import BenchResult


class Cells(HTMLParser):
    """Every table cell with data attributes, its text; and every address the page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[tuple[dict[str, str | None], str]] = []
        self.addresses: list[str] = []
        self._open: dict[str, str | None] | None = None
        self._text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.addresses += [str(value) for name, value in attrs if name in {"src", "href", "xlink:href", "data"}]
        if tag == "td":
            self._open, self._text = found, ""

    def handle_data(self, data: str) -> None:
        self._text += data

    def handle_endtag(self, tag: str) -> None:
        if tag == "td" and self._open is not None:
            self.cells.append((self._open, self._text.strip()))
            self._open = None


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    protocol = Protocol(task="arrow_puzzle", preset="thesis", budgets=(250, 2000, 6000), seeds=(0, 1, 7))
    return bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol)


@pytest.fixture(scope="module")
def folder(result: BenchResult) -> Path:
    return write_report(result).parent


@pytest.fixture(scope="module")
def page(folder: Path) -> Cells:
    parser = Cells()
    parser.feed((folder / "index.html").read_text(encoding="utf-8"))
    return parser


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_results_csv_is_the_result(result: BenchResult, folder: Path) -> None:
    found = rows(folder / "results.csv")
    assert len(found) == sum(len(run.checkpoints) for run in result.runs)
    for row in found:
        (run,) = (run for run in result.runs if (run.agent, str(run.seed)) == (row["agent"], row["seed"]))
        (checkpoint,) = (point for point in run.checkpoints if str(point.episodes) == row["episodes"])
        for name in ("env_steps", "test_episodes", "successes", "faults"):
            assert int(row[name]) == getattr(checkpoint, name)
        for name in ("success_rate", "mean_return", "mean_length", "train_cpu_s", "eval_cpu_s"):
            assert float(row[name]) == getattr(checkpoint, name)
        assert float(row["wilson_low"]) <= checkpoint.success_rate <= float(row["wilson_high"])
        for name, value in checkpoint.diagnostics.items():
            assert float(row[name]) == value


def test_every_seed_in_the_page_is_the_one_in_the_csv(folder: Path, page: Cells) -> None:
    shown = {
        (data["data-agent"], data["data-seed"], data["data-episodes"]): text
        for data, text in page.cells
        if "data-seed" in data
    }
    expected = {
        (row["agent"], row["seed"], row["episodes"]): percent(float(row["success_rate"]))
        for row in rows(folder / "results.csv")
    }
    assert shown == expected
    assert len(set(shown.values())) > 10  # not all alike, so that a mix-up would show


def test_open_loop_csv_has_every_depth_of_every_budget(result: BenchResult, folder: Path) -> None:
    found = rows(folder / "open_loop.csv")
    loops = {
        (run.agent, str(run.seed), str(point.episodes)): point.open_loop
        for run in result.runs
        for point in run.checkpoints
        if point.open_loop is not None
    }
    assert loops and len(found) == sum(len(loop.count) for loop in loops.values())
    for row in found:
        loop, index = loops[row["agent"], row["seed"], row["episodes"]], int(row["depth"]) - 1
        assert float(row["termination_error"]) == loop.termination_error[index]
        assert float(row["correct"]) == loop.correct[index]


def test_scores_in_the_page_are_those_in_the_summary(folder: Path, page: Cells) -> None:
    expected = {
        (row["agent"], row["episodes"]): [percent(float(row[name])) for name in ("success_iqm", "low_95", "high_95")]
        for row in rows(folder / "summary.csv")
    }
    shown = {
        (data["data-agent"], data["data-episodes"]): re.findall(r"\d+\.\d", text)[:3]
        for data, text in page.cells
        if "data-episodes" in data and "data-seed" not in data
    }
    assert shown == expected


def test_differences_and_gains_are_those_in_the_summary(folder: Path, page: Cells) -> None:
    checked = 0
    for row in rows(folder / "summary.csv"):
        for kind, attribute in (("difference_to_dqn", "data-difference"), ("gain", "data-gain")):
            if not row[kind]:
                continue
            stem = kind.removesuffix("_to_dqn")
            numbers = [signed_percent(float(row[name])) for name in (kind, f"{stem}_low_95", f"{stem}_high_95")]
            (text,) = (
                text
                for data, text in page.cells
                if data.get("data-agent") == row["agent"] and data.get(attribute) == row["episodes"]
            )
            assert re.findall("[+\u2212]\\d+\\.\\d", text)[:3] == numbers
            checked += 1
    assert checked == 2 * 2 * 3


def test_the_gain_s_plot_draws_the_table_and_the_thesis(result: BenchResult, folder: Path, tmp_path: Path) -> None:
    data = collect(result)
    assert set(data.thesis_gains) == {"imagination", "imagination_uncertainty"} < set(result.protocol.agents)
    drawn = [list(zip(*line.get_data(), strict=True)) for line in figures.gain_figure(data).axes[0].get_lines()]
    for agent, printed in data.thesis_gains.items():
        assert [(budget, 100.0 * gain) for budget, gain in printed.items()] in drawn
        assert [(budget, 100.0 * row.gain.value) for budget, row in data.comparisons[agent].items()] in drawn
    assert (folder / "gain.png").is_file() and "](gain.png)" in (folder / "report.md").read_text(encoding="utf-8")
    without = Protocol(task="arrow_puzzle", preset="thesis", agents=("imagination",), budgets=(2000,), seeds=(0,))
    assert not (write_report(bench_result(tmp_path, protocol=without)).parent / "gain.png").exists()


def test_areas_agree_in_page_summary_and_markdown(folder: Path, page: Cells) -> None:
    summary = {(row["agent"], row["episodes"]): row for row in rows(folder / "summary.csv") if row["area"]}
    shown = {
        (data["data-agent"], data["data-area"]): re.findall(r"\d+\.\d", text)
        for data, text in page.cells
        if "data-area" in data
    }
    assert {agent for agent, _ in shown} == {"dqn", "imagination", "imagination_uncertainty"}
    assert shown == {
        key: [percent(float(row[name])) for name in ("area", "area_low_95", "area_high_95")]
        for key, row in summary.items()
    }
    markdown = (folder / "report.md").read_text(encoding="utf-8")
    for value, low, high in shown.values():
        assert f"{value} [{low}, {high}]" in markdown


def test_areas_that_are_alike_are_not_ranked(result: BenchResult) -> None:
    data = collect(result)
    one = data.areas["dqn"]
    assert re.search(r"highest for “.*” \(.*\); next is “", " ".join(words.answers(data)))
    tied = dataclasses.replace(data, areas={"dqn": one, "imagination": one, "imagination_uncertainty": one})
    alike = r"highest for “DQN” \([^)]*\), “imagination” \([^)]*\) and “imagination \+ uncertainty” \([^)]*\) alike\."
    assert re.search(alike, " ".join(words.answers(tied)))


def test_the_thesis_stands_beside_ours(folder: Path, page: Cells) -> None:
    by_cell = {
        (data["data-agent"], data["data-episodes"]): text
        for data, text in page.cells
        if "data-episodes" in data and "data-seed" not in data
    }
    assert "thesis 42.2 (6.0)" in by_cell["dqn", "2000"]
    assert "thesis 97.0 (2.1)" in by_cell["imagination_uncertainty", "6000"]
    assert "thesis" not in by_cell["dqn", "250"] + by_cell["oracle", "2000"]
    text = " ".join(text for _, text in page.cells)
    for agent in ("dqn", "imagination", "imagination_uncertainty"):
        for mean, _ in reference.success("arrow_puzzle", agent).values():
            assert percent(mean) in text
    assert "thesis +47.4" in text
    summary = {(row["agent"], row["episodes"]): row for row in rows(folder / "summary.csv")}
    assert float(summary["dqn", "2000"]["thesis_mean"]) == pytest.approx(0.4218)


def test_titles_are_those_of_the_registry_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert words.agent_words("dqn").title == "DQN"
    monkeypatch.setitem(AGENTS, "my_agent", AgentEntry(make="x:make"))
    assert words.agent_words("my_agent") == words.AgentWords("my agent", "A registered agent.")
    monkeypatch.setitem(AGENTS, "my_agent", AgentEntry(make="x:make", title="Mine", description="Learns."))
    assert words.agent_words("my_agent") == words.AgentWords("Mine", "Learns.")
    assert words.agent_words("of_another_time").title == "of another time"


def test_markdown_agrees_with_the_tables(result: BenchResult, folder: Path) -> None:
    markdown = (folder / "report.md").read_text(encoding="utf-8")
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in markdown.splitlines() if line.startswith("|")]
    titles = {agent: words.agent_words(agent).title for agent in result.protocol.agents}
    seeds = {(row[0], row[1]): row[2:] for row in table if len(row) == 5 and row[1].isdigit()}
    for agent, title in titles.items():
        for index, seed in enumerate(result.protocol.seeds):
            assert seeds[title, str(seed)] == [percent(share) for share in result.success_rates(agent)[index]]
    header = next(row for row in table if row[0] == "solved (%) after")
    first = table.index(header)
    scores = {row[0]: dict(zip(header, row, strict=True)) for row in table[first : first + 2 + len(titles)]}
    for row in rows(folder / "summary.csv"):
        cell = scores[titles[row["agent"]]][f"{int(row['episodes']):,}"]
        assert cell.startswith(percent(float(row["success_iqm"])))
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", markdown):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")


def test_the_page_loads_nothing(page: Cells, folder: Path) -> None:
    for address in page.addresses:
        assert address.startswith(("data:image/png;base64,", "#")) or (folder / address).is_file(), address[:80]
    assert any(address.startswith("data:") for address in page.addresses)
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"@import|url\((?!#)|<script|<link", text)


def test_text_from_outside_is_escaped(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert "a <processor>" not in text
    assert html.escape("a <processor> & more") in text


def test_how_it_was_made_is_complete(result: BenchResult, folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    command = str(result.environment["command"])
    for fact in (command, result.protocol.hash, "3.17.0", f"git checkout 0123456789ab &amp;&amp; {command}"):
        assert fact in text


def test_plots_take_the_pages_color_and_do_not_share_ids(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    assert text.count("<svg") == 5  # success, ladder, gain, acceptance, open loop
    assert "currentColor" in text
    assert "#2b2b2f" not in text
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))


def test_writing_again_gives_the_same_files(result: BenchResult, folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    write_report(result)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_missing_and_doubled_runs_are_refused(result: BenchResult) -> None:
    with pytest.raises(ArtefactError, match=r"missing: \[\('imagination_uncertainty', 7\)\]"):
        dataclasses.replace(result, runs=result.runs[:-1])
    with pytest.raises(ArtefactError, match="holds 16"):
        dataclasses.replace(result, runs=(*result.runs, result.runs[0]))


def test_one_seed_gets_an_interval_over_episodes_and_no_verdict(tmp_path: Path) -> None:
    result = bench_result(
        tmp_path, protocol=Protocol(task="arrow_puzzle", preset="smoke", seeds=(0,), budgets=(10, 20))
    )
    data = collect(result)
    assert all(score.over == "episodes" for scores in data.scores.values() for score in scores.values())
    assert all(math.isnan(row.gain.low) for budgets in data.comparisons.values() for row in budgets.values())
    assert "one seed says nothing about how much of that is luck" in " ".join(words.answers(data))
    write_report(result)


def test_agents_alone_and_without_imagination(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle_hard", preset="quick", agents=("random", "oracle"), budgets=(5,))
    page = write_report(bench_result(tmp_path, protocol=protocol)).read_text(encoding="utf-8")
    assert "needs dqn and an imagining agent side by side" in page
    assert page.count("<svg") == 1


def shifted(result: BenchResult, agent: str, shares: list[int]) -> BenchResult:
    """The result with other successes of one agent, a seed each, at every budget."""
    runs = []
    for run in result.runs:
        if run.agent == agent:
            successes = shares[result.protocol.seeds.index(run.seed)]
            points = tuple(dataclasses.replace(point, successes=successes) for point in run.checkpoints)
            run = dataclasses.replace(run, checkpoints=points)  # noqa: PLW2901
        runs.append(run)
    return dataclasses.replace(result, runs=tuple(runs))


@pytest.mark.parametrize(
    ("successes", "sentence"),
    [
        ([150, 152, 154], "corrected): at this budget it is ahead."),
        ([50, 52, 54], "corrected): at this budget it is behind."),
        ([80, 100, 140], "corrected): at this budget no difference is shown."),
    ],
)
def test_the_answer_says_which_way_it_went(result: BenchResult, successes: list[int], sentence: str) -> None:
    changed = shifted(shifted(result, "dqn", [100, 102, 104]), "imagination", successes)
    answers = words.answers(collect(changed))
    (verdict,) = (answer for answer in answers if answer.startswith("“imagination” "))
    assert sentence in verdict
    difference = signed_percent((sum(successes) / 3 - 102) / 200).lstrip("+\u2212")
    assert f"{difference} percentage points" in verdict


def test_summary_table_for_the_terminal(result: BenchResult) -> None:
    lines = summary_table(result).splitlines()
    (at_2000,) = (line for line in lines if line.startswith("2,000"))
    assert at_2000.split()[1] == "4.6"
    assert at_2000.split()[-1] == "100.0"
    for agent in result.protocol.agents:
        assert percent(np.mean(result.success_rates(agent)[:, 1])) in at_2000
    thesis = lines[lines.index(at_2000) + 1]
    assert thesis.split() == ["thesis", "42.2", "(6.0)", "57.3", "(6.4)", "62.2", "(4.4)"]
    assert not any(line != line.rstrip() for line in lines)


def test_every_encoder_stands_with_those_who_see_through_it(result: BenchResult) -> None:
    both = dataclasses.replace(
        result.protocol, agents=("random", "dqn", "factored:given"), encoder="a@0123456789ab", codes="b@0123456789ab"
    )
    views = encoder_views(SimpleNamespace(protocol=both))  # type: ignore[arg-type]
    assert [(view.identity, view.agents) for view in views] == [
        ("a@0123456789ab", ("dqn",)), ("b@0123456789ab", ("factored:given",)),
    ]  # fmt: skip


def test_a_difference_is_shown_only_after_holm_s_correction(result: BenchResult) -> None:
    """The same difference counts less among more comparisons, and what could have been shown stands below the table."""
    changed = shifted(shifted(result, "dqn", [90, 100, 110]), "imagination", [116, 126, 136])
    data = collect(changed)
    one, budgets = data.comparisons["imagination"][2000], len(data.budgets)
    assert (
        one.difference.p < 0.05 < one.p_adjusted <= budgets * len(data.comparisons) * one.difference.p
        and one.shown == 0
    )
    assert "no difference is shown" in "".join(words.answers(data))
    said = words.detectable_words(data.comparisons)
    sizes = [each.detectable for by_budget in data.comparisons.values() for each in by_budget.values()]
    assert f"{percent(min(sizes))} to {percent(max(sizes))} points" in said
    assert f"all {len(sizes)} comparisons" in said
    assert said in " ".join(table.caption for table in gain(data).tables)


def test_an_uncertainty_that_an_agent_does_not_know_is_not_drawn(result: BenchResult) -> None:
    data = collect(result)
    loop = data.open_loop["imagination"]
    none = dataclasses.replace(loop, aleatoric=np.zeros_like(loop.aleatoric))
    panels = figures.open_loop_figure(dataclasses.replace(data, open_loop={"imagination": loop})).axes
    fewer = figures.open_loop_figure(dataclasses.replace(data, open_loop={"imagination": none})).axes
    assert len(panels[3].lines) == len(fewer[3].lines) + 1
    assert panels[3].get_yscale() == fewer[3].get_yscale() == "log"


def test_unwritable_folder_is_one_sentence(result: BenchResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SetupError, match=r"Cannot write .*a part of that path is a file"):
        write_report(dataclasses.replace(result, folder=tmp_path / "file"))


def test_strip_marks_cut_error_and_end() -> None:
    names = tuple(f"turn cube {index}" for index in range(6))
    cut, whole = (filmstrips.filmstrip(compared_rollout(np.random.default_rng(0), cut=cut), names) for cut in (3, None))
    assert cut.shape == whole.shape
    assert (cut == filmstrips._CUT).all(axis=2).sum() > 500  # the line
    assert not (whole == filmstrips._CUT).all(axis=2).any()
    for color in (filmstrips.RIGHT, filmstrips.WRONG):
        assert (whole == color).all(axis=2).sum() > 500  # frames in both colors
    narrow = filmstrips.filmstrip(compared_rollout(np.random.default_rng(0)), names, columns=2)
    assert narrow.shape[1] < whole.shape[1]


def test_real_frames_are_shown_unaltered_and_upright() -> None:
    compared = compared_rollout(np.random.default_rng(0), cut=None)
    strip = filmstrips.filmstrip(compared, tuple("abcdef"))
    left, top = filmstrips.left_px(0), filmstrips.HEADER_PX
    shown = strip[top : top + 128 : 2, left : left + 128 : 2]
    np.testing.assert_array_equal(shown, compared.start_frame)


def test_episodes_to_success_use_the_threshold_of_the_task(
    result: BenchResult, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = collect(result).spec
    assert f"Real episodes to {100 * spec.success_threshold:g}\u00a0%" in (folder / "index.html").read_text(
        encoding="utf-8"
    )
    agent = result.protocol.agents[-1]
    lowest = min(row.success_rate for run in result.of(agent) for row in run.checkpoints)
    assert 0.0 < lowest < 1.0
    first, seeds = result.protocol.budgets[0], len(result.protocol.seeds)
    for success_threshold, reached in ((lowest, (first,) * seeds), (1.0, (None,) * seeds)):
        demanding = dataclasses.replace(spec, success_threshold=success_threshold)
        monkeypatch.setattr("imagine_bench.report.missing.registry.task", lambda _, spec=demanding: spec)
        assert collect(result).reached[agent] == reached


def test_no_two_registered_agents_share_a_color() -> None:
    own = [name for name, entry in registry.AGENTS.items() if entry.make.startswith("imagine_bench.")]  # no test's
    colors = [figures.color(agent) for agent in own]
    assert len(own) > 8 and len(set(colors)) == len(colors)
    assert figures.color("an agent that nobody registered").startswith("#")


def test_a_p_value_of_just_5_percent_shows_no_difference(result: BenchResult) -> None:
    def say(value: float, p_adjusted: float) -> str:
        data = collect(result)
        rows = data.comparisons["imagination"]
        row = dataclasses.replace(
            rows[data.decisive_budget], difference=Estimate(value, value - 0.1, value + 0.1), p_adjusted=p_adjusted
        )
        changed = {**data.comparisons, "imagination": dict.fromkeys(rows, row)}
        answers = words.answers(dataclasses.replace(data, comparisons=changed))
        return next(answer for answer in answers if answer.startswith("“imagination” "))

    for value in (0.2, -0.2):
        said = say(value, 1.0 - statistics.LEVEL)
        assert said.count("no difference is shown") == 1 and "is a difference shown" in said
        assert "ahead" not in said and "behind" not in said
    assert say(0.2, 0.049).count("ahead") == 2 and say(-0.2, 0.049).count("behind") == 2
