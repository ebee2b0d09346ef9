"""A bench's report: its tables are its CSV files, its verdict follows the corrected p-values, its page stands alone."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import re
from pathlib import Path
from typing import Any

import pytest
from fake_results import WIDE, bench_result, rewritten
from report_pages import check_page
from whole_outputs import Expected

from imagine_bench import statistics
from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.control import Protocol
from imagine_bench.registry.entries import FIRST, TODAY
from imagine_bench.report.bench import bench_page, shown, verdict
from imagine_bench.report.data import DIFFERENCE, SCORE, collect
from imagine_bench.report.page import Page, Table, mean_std, number, over_seeds, p_level, write_page
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult


@pytest.mark.parametrize(
    ("value", "words"),
    [
        *((0.0, "0.000"), (0.0004, "4.00e\u221204"), (0.9994, "0.999"), (0.9996, "1.00"), (9.994, "9.99")),
        *((9.996, "10.0"), (-9.996, "\u221210.0"), (99.96, "100"), (1234.6, "1235"), (1e5, "1.00e+05")),
        *((math.nan, "–"), (math.inf, "∞")),
    ],
)
def test_a_number_is_printed_to_three_digits(value: float, words: str) -> None:
    assert number(value) == words


def test_a_p_value_is_said_to_be_below_the_next_level() -> None:
    words = ["p < .001", "p < .01", "p < .05", "p < .05", "p < 1.01"]
    assert [p_level(p) for p in (0.0009, 0.001, 0.01, 0.0499, 0.05)] == words


@pytest.mark.parametrize(
    ("values", "words"),
    [
        *(((math.nan,), "–"), ((0.25,), "25.0"), ((0.5, math.nan, 0.7), "60.0 (50.0 to 70.0)")),
        *(((0.5, 0.5, math.nan), "50.0"), ((0.0, 0.6, 0.8, 0.8), "70.0 / 55.0 (0.0 to 80.0)")),
    ],
)
def test_numbers_of_seeds_are_of_those_that_have_one(values: tuple[float, ...], words: str) -> None:
    assert over_seeds(values) == words
    assert [mean_std(each) for each in ([1.0, 2.0], [1.0], [1.0, math.nan])] == ["1.50 (0.71)", "1.00", "–"]


def test_columns_for_a_terminal_are_at_most_80_characters_wide() -> None:
    texts = [Table("wide", ["a" * 10, "b" * 38, "c" * last], [["1", "2", "3"]]).text for last in (28, 29)]
    assert [[len(line) for line in text.splitlines()] for text in texts] == [[80, 80, 80], [50, 50, 50, 0, 41, 41, 41]]


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
    return write_page(result.folder / "report", bench_page(result)).parent


def table(page: Page, name: str) -> Table:
    """A table of a page."""
    (found,) = (each for section in page.sections for each in section.tables if each.name == name)
    return found


# The verdict -------------------------------------------------------------------------------------------------------


def shifted(result: BenchResult, **shares: list[int]) -> BenchResult:
    """The result with other successes of some agents, a seed each, at every budget."""

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        given = shares.get(run.agent)
        place = result.protocol.seeds.index(run.seed)
        return row if given is None else dataclasses.replace(row, successes=given[place])

    return rewritten(result, change)


BASE = [100, 102, 102, 102, 102, 102, 104]
LEARNERS = ("dqn", "dqn_more_updates", "imagination")
PAIRS = (("imagination", "dqn"), ("imagination", "dqn_more_updates"))


def above(least: int) -> list[int]:
    return [least + each for each in BASE]


@pytest.fixture
def headed(tmp_path: Path) -> BenchResult:
    """Whose headlines are imagination against both DQNs."""
    protocol = dataclasses.replace(WIDE, agents=LEARNERS, seeds=tuple(range(7)), headlines=PAIRS)
    return shifted(
        bench_result(tmp_path, protocol=protocol), dqn=above(-40), dqn_more_updates=BASE, imagination=above(49)
    )


def test_verdicts(many: BenchResult, result: BenchResult, headed: BenchResult, expected: Expected) -> None:
    """Which way it went by made-up successes, and what would decide it."""
    better = shifted(many, dqn=BASE, imagination=above(50))
    equal = shifted(many, dqn=BASE, imagination=BASE)
    later = zip(better.runs, equal.runs, strict=True)
    runs = [dataclasses.replace(one, checkpoints=other.checkpoints[:1] + one.checkpoints[1:]) for one, other in later]
    three = shifted(result, dqn=[100, 102, 104], imagination=[198, 199, 200])
    page = bench_page(three)
    assert table(page, "gains").caption.startswith("Too few seeds to say")
    rows = list(csv.DictReader(io.StringIO(page.files["summary.csv"])))
    assert {row["interval_over"] for row in rows} == {"too few seeds"}
    assert all(row[name] in ("", "nan") for row in rows for name in (*SCORE[1:], *DIFFERENCE[1:], "p_holm"))
    typed = {**three.environment, "command": "imagine-bench bench x --seeds 0-1 7 --workers 1"}
    few = dataclasses.replace(headed.protocol, headlines=PAIRS[1:], few_seeds=(("imagination", 4),))
    levels = [100, 140, 100, 120, 130, 110, 120]
    undecided = bench_result(headed.folder, protocol=few)
    scenes = {
        "better": better,
        "worse": shifted(many, dqn=BASE, imagination=above(-50)),
        "undecided": shifted(many, dqn=BASE, imagination=[80, 90, 100, 105, 105, 110, 140]),
        "better from the second budget on": dataclasses.replace(better, runs=tuple(runs)),
        "too few seeds": three,
        "too few seeds, and options behind them": dataclasses.replace(three, environment=typed),
        "a gain over equal updates": headed,
        "no gain over equal updates": shifted(headed, dqn_more_updates=above(48)),
        "an undecided headline": shifted(undecided, dqn=levels, dqn_more_updates=levels, imagination=[130] * 7),
    }
    text = [line for name, scene in scenes.items() for line in (f"== {name}", *verdict(collect(scene)))]
    expected("verdicts", "\n".join(text), exactly=False)
    same = {**three.environment, "command": "imagine-bench bench x --seeds=0-1 7 --workers 1"}
    first, other = (verdict(collect(dataclasses.replace(three, environment=each))) for each in (typed, same))
    assert first == other, "seeds are typed in two ways"
    scene, until = scenes["an undecided headline"], "imagine-bench bench --task arrow_puzzle --until-decided"
    for command in (until, f"{until} --most-seeds 7", f"{until} --workers 1"):
        begun = dataclasses.replace(scene, environment={"command": command})
        own, with_agents = re.findall(r"decide: (imagine-bench [^;]*?)[;.]", verdict(collect(begun))[0])
        assert own.count("--until-decided") == 1 and "decided" not in with_agents and "most" not in with_agents, (
            "which the command refuses beside --agents"
        )
    for command in ("imagine-bench bench x; imagine-bench bench y", "python -c 'import imagine_bench'"):
        merged = dataclasses.replace(three, environment={"command": command})
        assert all(line.endswith("; about 2 more would decide.") for line in verdict(collect(merged))), "no one command"
    worse, *_ = verdict(collect(shifted(headed, dqn=above(49), imagination=BASE)))
    assert worse.startswith("imagination: worse than dqn, \u221224.5 [") and "(p < .001)" in worse
    brief = dataclasses.replace(headed.protocol, seeds=(0, 1, 2))
    first, *_ = verdict(collect(bench_result(headed.folder / "brief", protocol=brief)))
    assert re.match(r"imagination: \S+ points at 6,000 against dqn, undecided with 3 seeds; ", first)


@pytest.mark.parametrize(("sign", "word"), [(1, "better"), (-1, "worse")])
@pytest.mark.parametrize(("least", "p"), [(16, "p < .05"), (28, "p < .01"), (60, "p < .001")])
@pytest.mark.parametrize("budget", [250, 2000, 6000])
def test_a_verdict_on_several_budgets_claims_no_more_than_holds_at_each_of_them(
    many: BenchResult, sign: int, word: str, least: int, p: str, budget: int
) -> None:
    """Successes of 200 differ by the least number at one budget, and by 60 at the two others."""
    base = [90, 92, 95, 100, 105, 108, 110]

    def change(run: RunResult, row: Checkpoint) -> Checkpoint:
        more = sign * (least if row.episodes == budget else 60)
        given = {"dqn": 0, "imagination": more}.get(run.agent)
        place = many.protocol.seeds.index(run.seed)
        return row if given is None else dataclasses.replace(row, successes=base[place] + given)

    assert f"imagination: {word} than dqn at 250, 2,000 and 6,000 ({p})." in verdict(collect(rewritten(many, change)))


def test_one_seed_hides_no_difference_of_others(many: BenchResult) -> None:
    first = collect(many).compared[0]
    protocol = dataclasses.replace(many.protocol, few_seeds=((first, many.protocol.seeds[0]),))
    runs = tuple(run for run in many.runs if run.agent != first or run.seed == many.protocol.seeds[0])
    page = bench_page(dataclasses.replace(many, protocol=protocol, runs=runs))
    caption = table(page, "gains").caption
    last = many.of(first)[0].checkpoints[-1]
    low, high = statistics.wilson(last.successes, last.test_episodes)
    words = f"{last.success_rate:.1%} [{low:.1%}, {high:.1%}]".replace("%", "")
    assert [row[-1] for row in table(page, "scores").rows if row[0] == first] == [words], "over its tests"
    of = {row["agent"]: row["interval_over"] for row in csv.DictReader(io.StringIO(page.files["summary.csv"]))}
    assert of[first] == "episodes" and of["dqn"] == "seeds"
    (said,) = (line for line in page.answers if line.startswith(f"{first}: "))
    assert f"undecided with 1 seed of {first} and 7 of dqn" in said
    assert "The smallest difference that would be shown with probability 80 % is " in caption and "nan" not in caption


def test_headlines_are_corrected_for_one_another_alone(headed: BenchResult) -> None:
    data = collect(headed)
    headline = data.of("imagination")[-1]
    assert headline["p_holm"] == data.headlines[0].found.p
    others = [record for record in data.records if "p" in record and record is not headline]
    assert [record["p_holm"] for record in others] == statistics.holm([record["p"] for record in others]).tolist()
    assert data.cells == sum("p" in record for record in data.records) - 1, "all other comparisons with DQN, each once"
    for pairs, cells in ((PAIRS, data.cells), (PAIRS[1:], data.cells + 1)):
        protocol = dataclasses.replace(headed.protocol, headlines=pairs)
        caption = table(bench_page(dataclasses.replace(headed, protocol=protocol)), "gains").caption
        assert f"for {cells} cells, those of the {len(pairs)} headlines for one another alone" in caption


def test_a_difference_is_shown_only_after_holms_correction(many: BenchResult) -> None:
    changed = shifted(many, dqn=[90, 92, 95, 100, 105, 108, 110], imagination=[103, 105, 108, 113, 118, 121, 123])
    data = collect(changed)
    compared = [record for record in data.records if "gain" in record]
    one = data.of("imagination")[1]
    assert one["p"] < 0.05 < one["p_holm"] <= len(compared) * one["p"] and shown(one) == 0
    for difference in (0.2, -0.2):
        assert shown({**one, "difference_to_dqn": difference, "p_holm": 1.0 - statistics.LEVEL}) == 0
        assert shown({**one, "difference_to_dqn": difference, "p_holm": 0.049}) == (1 if difference > 0 else -1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"demonstrations": 4}, "first training episodes demonstrated: 4"),
        ({"demonstrations": 1_000_000}, "first training episodes demonstrated: 6,000"),
        ({"queries": 2}, "up to 2 oracle queries an episode"),
        ({"feedback": 5.0, "feedback_error": 0.2}, "a teacher's feedback of 5, wrong in 20.0 %"),
        (
            {"after": ("arrow_puzzle_hard", "arrow_puzzle_toward"), "after_episodes": 1500},
            "trained before on arrow_puzzle_hard, arrow_puzzle_toward, 1,500 episodes each",
        ),
        (
            {"after": ("arrow_puzzle_hard",), "unannounced": True},
            "trained before on arrow_puzzle_hard, 100 episodes each, without notice of a change",
        ),
        ({"dataset": "mixed-6@0123456789ab"}, "trained first on dataset mixed-6@0123456789ab"),
        ({"split": "plan_length=2"}, "tests start where training never does, plan_length=2"),
        ({"physics": (("pad_friction", 0.5),)}, "physics execution, pad_friction=0.5"),
    ],
)
def test_the_page_says_what_helps_learners_and_what_changes_the_world(
    result: BenchResult, changes: dict[str, Any], words: str
) -> None:
    protocol = dataclasses.replace(result.protocol, **changes)
    assert f" · {words} · " in bench_page(dataclasses.replace(result, protocol=protocol)).subtitle
    assert words not in bench_page(result).subtitle


@pytest.mark.parametrize(("edition", "then"), [(TODAY, "The same bench command goes on."), (FIRST, "Its agents had")])
def test_an_unfinished_bench_names_four_of_its_runs_and_how_it_goes_on(
    result: BenchResult, edition: int, then: str
) -> None:
    runs = ("a seed 0", "b seed 1", "c seed 2", "d seed 3", "e seed 4")
    whole = dataclasses.replace(result.protocol, agent_names=edition)
    for count, named in ((4, "; ".join(runs[:4])), (5, f"{'; '.join(runs[:4])}; …")):
        first, *_ = verdict(collect(dataclasses.replace(result, missing=runs[:count], whole=whole)))
        assert f" Missing are {named}. {then}" in first


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


@pytest.mark.parametrize(("commit", "words"), [("0123+changes.4567", "git checkout 0123 && "), (None, "")])
def test_the_line_that_repeats_a_bench_begins_at_its_commit(
    result: BenchResult, commit: str | None, words: str
) -> None:
    facts = {**result.environment, "commit": commit}
    made = bench_page(dataclasses.replace(result, environment=facts)).facts
    assert made["reproduce"] == f"{words}{facts['command']}"


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
