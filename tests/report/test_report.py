"""A bench's report: its tables are its CSV files, its verdict follows the corrected p-values, its page stands alone."""

from __future__ import annotations

import csv
import dataclasses
import io
import re
from pathlib import Path

import pytest
from fake_results import WIDE, bench_result, rewritten
from report_pages import check_page

from imagine_bench import statistics
from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.control import Protocol
from imagine_bench.report import bench_page, write_report
from imagine_bench.report.bench import shown, verdict
from imagine_bench.report.data import DIFFERENCE, SCORE, collect
from imagine_bench.report.page import Page, Table, percent
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    return bench_result(tmp_path_factory.mktemp("bench"), protocol=WIDE)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    """With as many seeds as an interval needs."""
    protocol = dataclasses.replace(WIDE, seeds=tuple(range(statistics.FEWEST)))
    return bench_result(tmp_path_factory.mktemp("bench"), protocol=protocol)


@pytest.fixture(scope="module")
def folder(result: BenchResult) -> Path:
    """The report, written with all its figures."""
    return write_report(result).parent


def table(page: Page, name: str) -> Table:
    """A table of a page."""
    (found,) = (each for section in page.sections for each in section.tables if each.name == name)
    return found


def score_of_dqn(page: Page) -> str:
    (row,) = (row for row in table(page, "scores").rows if row[0] == "dqn")
    return row[1]


def test_the_mean_stands_beside_a_mean_that_leaves_seeds_out(many: BenchResult, result: BenchResult) -> None:
    shares = many.success_rates("dqn")[:, 0]
    page = bench_page(many)
    assert score_of_dqn(page).startswith(f"{percent(statistics.iqm(shares))} / {percent(shares.mean())} [")
    assert "(2 of 7 seeds left out) / mean of all" in page.subtitle
    shares = result.success_rates("dqn")[:, 0]
    page = bench_page(result)
    assert score_of_dqn(page) == f"{percent(shares.mean())} ({percent(shares.min())} to {percent(shares.max())})"
    assert "too few for an interval" in page.subtitle


def test_each_part_of_a_wide_table_on_a_terminal_names_its_rows() -> None:
    wide = Table("wide", ["agent", *(f"a long name of a column {place}" for place in range(5))], [["dqn", *"12345"]])
    parts = wide.text.split("\n\n")
    assert len(parts) > 1
    assert {tuple(line.split()[0] for line in part.splitlines()[::2]) for part in parts} == {("agent", "dqn")}


# The verdict -------------------------------------------------------------------------------------------------------


def shifted(result: BenchResult, **shares: list[int]) -> BenchResult:
    """The result with other successes of some agents, a seed each, at every budget."""

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        given = shares.get(run.agent)
        place = result.protocol.seeds.index(run.seed)
        return row if given is None else dataclasses.replace(row, successes=given[place])

    return rewritten(result, change)


@pytest.mark.parametrize(
    ("successes", "sentence"),
    [
        ([150, 152, 152, 152, 152, 152, 154], "imagination: better than dqn at 250, 2,000 and 6,000 (p < .001)."),
        ([50, 52, 52, 52, 52, 52, 54], "imagination: worse than dqn at 250, 2,000 and 6,000 (p < .001)."),
        ([80, 90, 100, 105, 105, 110, 140], "imagination: +0.0 points against dqn at 6,000, undecided with 7 seeds."),
    ],
)
def test_the_verdict_says_which_way_it_went(many: BenchResult, successes: list[int], sentence: str) -> None:
    changed = shifted(many, dqn=[100, 102, 102, 102, 102, 102, 104], imagination=successes)
    assert sentence in verdict(collect(changed))


def test_a_verdict_s_p_is_of_the_budgets_that_it_names(many: BenchResult) -> None:
    solved = {"dqn": [100, 102, 102, 102, 102, 102, 104], "imagination": [150, 152, 152, 152, 152, 152, 154]}
    later = shifted(many, **solved)
    first = shifted(many, dqn=solved["dqn"], imagination=solved["dqn"])

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        return first.of(run.agent)[many.protocol.seeds.index(run.seed)].checkpoints[0] if row.episodes == 250 else row

    assert "imagination: better than dqn at 2,000 and 6,000 (p < .001)." in verdict(collect(rewritten(later, change)))


def test_three_seeds_are_too_few_to_say_whatever_they_solve(result: BenchResult) -> None:
    changed = shifted(result, dqn=[100, 102, 104], imagination=[198, 199, 200])
    (line,) = (line for line in verdict(collect(changed)) if line.startswith("imagination: "))
    assert line.startswith("imagination: +48.5 points against dqn at 6,000, undecided with 3 seeds; about 2 more would")
    environment = {**changed.environment, "command": "imagine-bench bench x --seeds 0-1 7 --workers 1"}
    (other,) = verdict(collect(dataclasses.replace(changed, environment=environment)))[-1:]
    assert "imagine-bench bench x --workers 1 " in other, "the options behind the seeds stay"
    page = bench_page(changed)
    assert table(page, "gains").caption.startswith("Too few seeds to say")
    rows = list(csv.DictReader(io.StringIO(page.files["summary.csv"])))
    assert {row["interval_over"] for row in rows} == {"too few seeds"}
    assert all(row[name] in ("", "nan") for row in rows for name in (*SCORE[1:], *DIFFERENCE[1:], "p_holm"))


LEARNERS = ("dqn", "dqn_more_updates", "imagination")


@pytest.mark.parametrize(
    ("equal", "sentence"),
    [
        (100, "better than dqn_more_updates (as many gradient updates), +24.5 ["),
        (148, "no gain over dqn_more_updates (as many gradient updates) is shown, +0.5 ["),
    ],
)
def test_the_first_line_says_what_equal_updates_leave_of_a_gain(tmp_path: Path, equal: int, sentence: str) -> None:
    pairs = (("imagination", "dqn"), ("imagination", "dqn_more_updates"))
    protocol = dataclasses.replace(WIDE, agents=LEARNERS, seeds=tuple(range(7)), headlines=pairs)
    levels = zip(LEARNERS, (60, equal, 149), strict=True)
    shares = {agent: [level + each for each in (-2, -1, 0, 0, 0, 1, 2)] for agent, level in levels}
    data = collect(shifted(bench_result(tmp_path, protocol=protocol), **shares))
    first = verdict(data)[0]
    assert first.startswith("imagination: better than dqn, +44.5 [") and sentence in first
    raw = [
        statistics.difference(*(data.result.success_rates(agent)[:, -1] for agent in pair), trials=200).p
        for pair in pairs
    ]
    assert [each.found.p for each in data.headlines] == statistics.holm(raw).tolist(), "for one another alone"
    assert data.of("imagination")[-1]["p_holm"] == data.headlines[0].found.p
    others = sum("p" in record for record in data.records) - sum(each.base == "dqn" for each in data.headlines)
    assert data.cells == others, "all other comparisons with DQN, each once"


def test_an_undecided_headline_names_a_command_that_adds_seeds_itself(tmp_path: Path) -> None:
    pairs = (("imagination", "dqn_more_updates"),)
    few = (("imagination", 4),)
    wanted = dataclasses.replace(WIDE, agents=LEARNERS, seeds=tuple(range(7)), headlines=pairs, few_seeds=few)
    levels = [100, 140, 100, 120, 130, 110, 120]
    result = bench_result(tmp_path, protocol=wanted)
    first = verdict(collect(shifted(result, dqn=levels, dqn_more_updates=levels, imagination=[130] * 7)))[0]
    assert "undecided with 5 seeds of imagination and 7 of dqn_more_updates; about " in first
    assert " more would decide: imagine-bench bench --task arrow_puzzle --until-decided;" in first


def test_a_difference_is_shown_only_after_holms_correction(many: BenchResult) -> None:
    changed = shifted(many, dqn=[90, 92, 95, 100, 105, 108, 110], imagination=[103, 105, 108, 113, 118, 121, 123])
    data = collect(changed)
    compared = [record for record in data.records if "gain" in record]
    one = data.of("imagination")[1]
    assert one["p"] < 0.05 < one["p_holm"] <= len(compared) * one["p"] and shown(one) == 0
    for difference in (0.2, -0.2):
        assert shown({**one, "difference_to_dqn": difference, "p_holm": 1.0 - statistics.LEVEL}) == 0
        assert shown({**one, "difference_to_dqn": difference, "p_holm": 0.049}) == (1 if difference > 0 else -1)


def test_agents_that_do_not_learn_are_not_compared(tmp_path: Path) -> None:
    protocol = Protocol(task="arrow_puzzle_hard", preset="quick", agents=("random", "oracle"), budgets=(5,))
    page = bench_page(bench_result(tmp_path, protocol=protocol))
    assert page.answers == ["Nothing is compared, as dqn or another learner is missing; name both with --agents."]
    assert [section.title for section in page.sections] == [
        "Task and agents", "Success against real experience", "Costs and faults",
    ]  # fmt: skip


def test_missing_and_doubled_runs_are_refused(result: BenchResult) -> None:
    for runs in (result.runs[:-1], (*result.runs, result.runs[0])):
        with pytest.raises(ArtefactError, match=r"should hold the runs .* and holds .*'imagination_uncertainty', 1"):
            dataclasses.replace(result, runs=runs)


# The page ----------------------------------------------------------------------------------------------------------


def test_the_page_can_be_read_alone_and_shows_every_figure(folder: Path) -> None:
    text = (folder / "index.html").read_text(encoding="utf-8")
    check_page(text)
    addresses = re.findall(r'\b(?:src|href|data)="([^"]*)"', text)
    for address in addresses:
        assert address.startswith("data:image/png;base64,") or (folder / address).is_file(), address[:80]
    assert not re.search(r"@import|url\(|<script|<link", text)
    assert len(set(re.findall(r'\bid="([^"]+)"', text))) == text.count(' id="')
    pictures = {path.name for path in folder.glob("*.png")}
    assert {"success.png", "open_loop.png", "rollout_imagination_1.png"} <= pictures
    assert len(pictures) == text.count("<img")
    assert all((folder / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
