"""A bench's report: its tables are its CSV files, its verdict follows the corrected p-values, its page stands alone."""

from __future__ import annotations

import csv
import dataclasses
import html
import io
import re
from pathlib import Path

import numpy as np
import pytest
from fake_results import LEVELS, bench_result
from report_pages import addresses, check_texts, narrowest_px, read_tables, without_images

from imagine_bench import reference, registry, statistics
from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.protocols.control import Protocol
from imagine_bench.registry import AGENTS, AgentEntry
from imagine_bench.report import bench_page, figures, write_report
from imagine_bench.report.bench import verdict
from imagine_bench.report.data import ReportData, agent_title, collect
from imagine_bench.report.imagination import encoder_readers
from imagine_bench.report.page import markdown_code, markdown_text, texts
from imagine_bench.report.tables import DASH, Cell, Page, Table, percent, signed_percent
from imagine_bench.statistics import Estimate
from imagine_bench.store.results import BenchResult

WIDE = Protocol(task="arrow_puzzle", preset="thesis", budgets=(250, 2000, 6000), seeds=(0, 1, 7))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    return bench_result(tmp_path_factory.mktemp("bench"), protocol=WIDE)


@pytest.fixture(scope="module")
def page(result: BenchResult) -> Page:
    return bench_page(result)


@pytest.fixture(scope="module")
def folder(result: BenchResult) -> Path:
    """The report, written with all its figures."""
    return write_report(result).parent


def text_of(page: Page) -> dict[str, str]:
    """The texts of a page, without its figures."""
    return texts(without_images(page))


def table(page: Page, name: str) -> Table:
    """A table of a page."""
    (found,) = (each for section in page.sections for each in section.tables if each.name == name)
    return found


def records(page: Page, name: str) -> list[dict[str, str]]:
    """A CSV file of a page."""
    return list(csv.DictReader(io.StringIO(page.files[name])))


# The same numbers everywhere ---------------------------------------------------------------------------------------


def test_results_csv_is_the_result(result: BenchResult, page: Page) -> None:
    found = records(page, "results.csv")
    assert len(found) == sum(len(run.checkpoints) for run in result.runs)
    for row in found:
        (run,) = (run for run in result.runs if (run.agent, str(run.seed)) == (row["agent"], row["seed"]))
        (checkpoint,) = (point for point in run.checkpoints if str(point.episodes) == row["episodes"])
        for name in ("env_steps", "test_episodes", "successes", "faults"):
            assert int(row[name]) == getattr(checkpoint, name)
        for name in ("success_rate", "mean_return", "mean_length", "train_cpu_s", "eval_cpu_s"):
            assert float(row[name]) == getattr(checkpoint, name)
        assert float(row["wilson_low"]) <= checkpoint.success_rate <= float(row["wilson_high"])
        assert {name: float(row[name]) for name in checkpoint.diagnostics} == checkpoint.diagnostics


@pytest.mark.parametrize(
    ("name", "columns", "words"),
    [
        ("scores", ("success_iqm", "low_95", "high_95"), percent),
        ("differences", ("difference_to_dqn", "difference_low_95", "difference_high_95"), signed_percent),
        ("gains", ("gain", "gain_low_95", "gain_high_95"), signed_percent),
        ("areas", ("area", "area_low_95", "area_high_95"), percent),
    ],
)
def test_tables_show_the_columns_of_the_summary(page: Page, name: str, columns: tuple[str, ...], words) -> None:
    summary = {(agent_title(row["agent"]), row["episodes"]): row for row in records(page, "summary.csv")}
    found = table(page, name)
    checked = 0
    for title, *cells in found.cells:
        for budget, cell in zip(found.header[1:], cells, strict=True):
            row = summary.get((title.text, budget.replace(",", "")))
            if row is not None:
                value, low, high = (words(float(row[column])) for column in columns)
                assert (cell.text, cell.interval) == (value, f"[{low}, {high}]")
                checked += 1
    assert checked == sum(row[columns[0]] != "" for row in summary.values()) > 5


def test_every_seed_is_the_one_of_the_csv(result: BenchResult, page: Page) -> None:
    shares = {}
    for row in records(page, "results.csv"):
        shares.setdefault((agent_title(row["agent"]), row["seed"]), []).append(percent(float(row["success_rate"])))
    assert {(row[0], row[1]): row[2:] for row in table(page, "seeds").rows} == shares
    assert len({cell for row in shares.values() for cell in row}) > 10, "a mix-up would show"


def test_open_loop_csv_has_every_depth_of_every_budget(result: BenchResult, page: Page) -> None:
    found = records(page, "open_loop.csv")
    loops = {
        (run.agent, str(run.seed), str(point.episodes)): point.open_loop
        for run, point in result.rows
        if point.open_loop is not None
    }
    assert loops and len(found) == sum(len(loop.count) for loop in loops.values())
    for row in found:
        loop, index = loops[row["agent"], row["seed"], row["episodes"]], int(row["depth"]) - 1
        assert float(row["termination_error"]) == loop.termination_error[index]
        assert float(row["correct"]) == loop.correct[index]


def test_the_thesis_stands_beside_ours(page: Page) -> None:
    notes = {row[0].text: [cell.note for cell in row[1:]] for row in table(page, "scores").cells}
    assert notes["DQN"] == ["", "thesis 42.2 (6.0)", "thesis 92.2 (2.6)"]
    assert notes["imagination + uncertainty"][2] == "thesis 97.0 (2.1)" and not any(notes["oracle"])
    shown = " ".join(str(cell) for name in ("scores", "thesis") for row in table(page, name).cells for cell in row)
    for agent in ("dqn", "imagination", "imagination_uncertainty"):
        assert all(percent(mean) in shown for mean, _ in reference.success("arrow_puzzle", agent).values())
    assert "thesis +47.4" in [cell.note for row in table(page, "gains").cells for cell in row]


def test_the_terminal_has_the_scores_and_the_verdict(result: BenchResult, page: Page) -> None:
    lines = page.summary.splitlines()
    (line,) = (line for line in lines if line.startswith("DQN ") and "[" in line)
    for share in result.success_rates("dqn").mean(axis=0):
        assert percent(share) in line
    assert lines[-len(page.answers) :] == list(page.answers)
    assert not any(line != line.rstrip() for line in lines)
    chance = next(line for line in lines if line.startswith("chance level"))
    assert chance.split()[2:] == ["4.6"] * 3


# The verdict -------------------------------------------------------------------------------------------------------


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
        ([150, 152, 154], "better after 250, 2,000, 6,000 real episodes (3 budgets)"),
        ([50, 52, 54], "worse after 250, 2,000, 6,000 real episodes (3 budgets)"),
        ([80, 100, 140], "no difference is shown (3 budgets)"),
    ],
)
def test_the_verdict_says_which_way_it_went(result: BenchResult, successes: list[int], sentence: str) -> None:
    changed = shifted(shifted(result, "dqn", [100, 102, 104]), "imagination", successes)
    (line,) = (line for line in verdict(collect(changed)) if line.startswith("“imagination” "))
    assert sentence in line
    assert f"difference {signed_percent((sum(successes) / 3 - 102) / 200)} [" in line


def test_the_verdict_takes_the_budget_of_the_smallest_corrected_p(result: BenchResult) -> None:
    data = collect(result)
    rows = data.comparisons["imagination_uncertainty"]
    best = min(rows, key=lambda budget: rows[budget].p_adjusted)
    (line,) = (line for line in verdict(data) if line.startswith("“imagination + uncertainty” "))
    assert f"after {best:,} episodes {percent(data.scores['imagination_uncertainty'][best].success.value)} %" in line


def test_a_difference_is_shown_only_after_holms_correction(result: BenchResult) -> None:
    changed = shifted(shifted(result, "dqn", [90, 100, 110]), "imagination", [116, 126, 136])
    data = collect(changed)
    one = data.comparisons["imagination"][2000]
    cells = len(data.budgets) * len(data.comparisons)
    assert one.difference.p < 0.05 < one.p_adjusted <= cells * one.difference.p and one.shown == 0
    sizes = [each.detectable for rows in data.comparisons.values() for each in rows.values()]
    caption = table(bench_page(changed), "differences").caption
    assert f"{percent(min(sizes))} to {percent(max(sizes))} points" in caption and f"for {cells} cells" in caption


def test_a_p_value_of_just_5_percent_shows_no_difference(result: BenchResult) -> None:
    one = collect(result).comparisons["imagination"][2000]
    for value in (0.2, -0.2):
        difference = Estimate(value, value - 0.1, value + 0.1)
        assert dataclasses.replace(one, difference=difference, p_adjusted=1.0 - statistics.LEVEL).shown == 0
        assert dataclasses.replace(one, difference=difference, p_adjusted=0.049).shown == np.sign(value)


def test_one_seed_gets_an_interval_over_episodes_and_no_verdict(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle", preset="smoke", seeds=(0,), budgets=(10, 20))
    page = bench_page(bench_result(tmp_path, protocol=protocol))
    assert {row["interval_over"] for row in records(page, "summary.csv")} == {"episodes"}
    assert all(row["gain_low_95"] in ("", "nan") for row in records(page, "summary.csv"))
    assert all(line.endswith("One seed does not show which is better.") for line in page.answers)
    check_texts(text_of(page))


def test_agents_that_do_not_learn_are_not_compared(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle_hard", preset="quick", agents=("random", "oracle"), budgets=(5,))
    page = bench_page(bench_result(tmp_path, protocol=protocol))
    assert page.answers == ["Nothing is compared: that needs dqn and another learner side by side."]
    assert [section.title for section in page.sections] == [
        "What was compared", "Success against real experience", "What it cost, and what went wrong",
    ]  # fmt: skip


def test_missing_and_doubled_runs_are_refused(result: BenchResult) -> None:
    with pytest.raises(ArtefactError, match=r"missing: \[\('imagination_uncertainty', 7\)\]"):
        dataclasses.replace(result, runs=result.runs[:-1])
    with pytest.raises(ArtefactError, match="holds 16"):
        dataclasses.replace(result, runs=(*result.runs, result.runs[0]))


# The page ----------------------------------------------------------------------------------------------------------


def test_the_page_loads_nothing_and_its_figures_share_no_ids(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    found = addresses(text)
    for address in found:
        assert address.startswith(("data:image/png;base64,", "#")) or (folder / address).is_file(), address[:80]
    assert any(address.startswith("data:") for address in found)
    assert not re.search(r"@import|url\((?!#)|<script|<link", text)
    assert text.count("<svg") == 4  # success, acceptance, open loop, ladder
    assert "currentColor" in text and figures.INK not in text
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))


def test_the_report_can_be_read_and_holds_every_figure(folder: Path) -> None:
    written = {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir() if path.suffix != ".png"}
    check_texts(written)
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", written["report.md"]):
        assert (folder / picture).read_bytes().startswith(b"\x89PNG")


def test_how_it_was_made_is_complete_and_escaped(result: BenchResult, page: Page) -> None:
    text = text_of(page)["index.html"]
    command = str(result.environment["command"])
    for fact in (command, result.protocol.hash, "3.17.0", f"git checkout 0123456789ab &amp;&amp; {command}"):
        assert fact in text
    assert "a <processor>" not in text and html.escape("a <processor> & more") in text


def test_the_same_result_gives_the_same_page(result: BenchResult, page: Page) -> None:
    again = bench_page(result)
    assert text_of(again) == text_of(page)
    first, second = (next(each for section in one.sections for each in section.images) for one in (page, again))
    assert first.drawn == second.drawn


def test_unwritable_folder_is_one_sentence(result: BenchResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(SetupError, match=r"Cannot write .*a part of that path is a file"):
        write_report(dataclasses.replace(result, folder=tmp_path / "file"))


def test_the_widest_report_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    others = ("tabular_long_name", "imagination_only_uncertainty", "factored:given")
    for agent in others:
        monkeypatch.setitem(LEVELS, agent, (0.1, 0.9))
    agents = (*(name for name in LEVELS if name not in others), *others)
    budgets = (20, 40, 60, 80, 100, 250, 500, 1000, 2000, 6000)
    protocol = dataclasses.replace(WIDE, agents=tuple(a for a in agents if a in AGENTS), budgets=budgets)
    written = text_of(bench_page(bench_result(tmp_path, protocol=protocol)))
    check_texts(written)
    widest = max(read_tables(written["index.html"]), key=lambda found: len(found[0]))
    assert len(widest[0]) == 12 and narrowest_px(widest) > 700  # ten budgets, a name and a seed: not vacuous


def test_names_are_escaped_in_markdown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = AgentEntry(make="x:make", title="my_agent | <b>", description="Has *stars*\nand lines.")
    monkeypatch.setitem(AGENTS, "imagination_only", entry)
    protocol = dataclasses.replace(WIDE, agents=("dqn", "imagination_only"), budgets=(5, 10))
    written = text_of(bench_page(bench_result(tmp_path, protocol=protocol)))
    assert r"| my\_agent \| \<b\> | Has \*stars\* and lines. |" in written["report.md"]
    assert "my_agent |" not in written["report.md"] and "<b>" not in written["report.md"]
    check_texts(written)
    assert markdown_text("[a](b) `c` d_e") == r"[a]\(b) \`c\` d\_e"
    assert markdown_text("# a & <b>") == r"\# a \& \<b\>"
    assert markdown_code("a`b``c\nd") == "``` a`b``c d ```" and markdown_code("a") == "`a`"


def test_a_dash_is_explained_only_where_there_is_one() -> None:
    found = Table("t", ["a", "b"], [["x", "1"]], "Numbers.", "not measured")
    assert found.remark == "Numbers."
    assert dataclasses.replace(found, rows=[["x", DASH]]).remark == "Numbers. –: not measured."
    assert str(Cell("61.3", "[55.0, 67.2]", "thesis 60.0")) == "61.3 [55.0, 67.2]; thesis 60.0"
    assert found.text.splitlines() == ["a  b", "----", "x  1"]
    assert found.markdown.splitlines() == ["| a | b |", "|---|---|", "| x | 1 |"]


# Agents and encoders -----------------------------------------------------------------------------------------------


def test_titles_are_those_of_the_registry_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert agent_title("dqn") == "DQN" and agent_title("of_another_time") == "of another time"
    monkeypatch.setitem(AGENTS, "my_agent", AgentEntry(make="x:make"))
    assert agent_title("my_agent") == "my agent"
    monkeypatch.setitem(AGENTS, "my_agent", AgentEntry(make="x:make", title="Mine"))
    assert agent_title("my_agent") == "Mine"


def test_no_two_registered_agents_share_a_color(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, entry in list(AGENTS.items()):
        if not entry.make.startswith("imagine_bench"):  # other tests' fakes
            monkeypatch.delitem(AGENTS, name)
    own = [name for name, entry in registry.agents().items() if entry.make.startswith("imagine_bench")]  # no test's
    colors = [figures.color(agent) for agent in own]
    assert len(own) > 8 and len(set(colors)) == len(colors)
    assert figures.color("an agent that nobody registered").startswith("#")


def test_every_encoder_stands_with_its_readers(result: BenchResult) -> None:
    both = dataclasses.replace(
        result.protocol, agents=("random", "dqn", "factored:given"), encoder="a@0123456789ab", codes="b@0123456789ab"
    )
    assert encoder_readers(both) == {"a@0123456789ab": ["dqn"], "b@0123456789ab": ["factored:given"]}


def test_episodes_to_success_use_the_threshold_of_the_task(result: BenchResult) -> None:
    agent = result.protocol.agents[-1]
    lowest = min(row.success_rate for run in result.of(agent) for row in run.checkpoints)
    assert 0.0 < lowest < 1.0
    first, seeds = result.protocol.budgets[0], len(result.protocol.seeds)
    for success_threshold, reached in ((lowest, (first,) * seeds), (1.0, (None,) * seeds)):
        data = ReportData(result)
        vars(data)["spec"] = dataclasses.replace(data.spec, success_threshold=success_threshold)
        assert data.reached[agent] == reached
