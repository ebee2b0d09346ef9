"""Rows of a leaderboard: a written row is read again, the check plays it, and hostile files get one sentence."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bench_fakes  # noqa: F401 - registers its agents
import numpy as np
import pytest
from board_forging import OpenRow, submitted
from imagine_bench_board import submit as submitting
from imagine_bench_board.check import NEVER_SHOWN, NOT_VOUCHED, check
from imagine_bench_board.page import board_page, write_board
from imagine_bench_board.rows import CARD, EPISODES, LARGEST, LONGEST, Row, read_row, world_words
from report_pages import in_words
from small_runs import QUICK, Inline, made_bench, small, written
from whole_outputs import expected_of

from imagine_bench.cli import exit_code
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.exact.certificate import certificate
from imagine_bench.report.page import percent
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.player import played_run, protocol_of_player
from imagine_bench.seeding import TUNING_SEEDS
from imagine_bench.store.bench_folder import bench_facts
from imagine_bench.store.run_folder import load_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a small bench of two agents."""
    wanted = small(agents=("table", "random"), seeds=(0, 1), few_seeds={"random": 1}, evaluation_episodes=6)
    result = made_bench(wanted, tmp_path_factory.mktemp("bench"))
    return result.runs[0].folder


@pytest.fixture
def row(run: Path, tmp_path: Path) -> Path:
    (folder,) = submitted(run, tmp_path / "board" / "rows")
    return folder


def test_a_run_is_submitted_with_all_seeds_and_budgets(
    run: Path, row: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = read_row(row)
    assert [(each.seed, each.episodes) for each in read.vouched] == [(0, 4), (0, 9), (1, 4), (1, 9)]
    kept = load_run(run.with_name("seed_1")).checkpoints[1]
    assert read.checkpoint(3) == dataclasses.replace(kept, eval_cpu_s=0.0, diagnostics={}, open_loop=None)
    assert [read.kept(3).actions_of(test) for test in range(6)] == [kept.kept.actions_of(test) for test in range(6)]
    assert read.claimed.agent == "table" and read.claimed.author == "a founder"
    made = bench_facts(run.parents[1])["environment"]
    assert (read.claimed.commit, read.claimed.machine) == (str(made["commit"]), made["machine"]["cpu"])
    assert {each.agent_sha256 for each in read.claimed.prices} != {""}
    for place, there in (("here", Path()), ("beside", Path("..") / run.name)):
        monkeypatch.chdir(run)
        (again,) = submitted(there, tmp_path / place)
        assert read_row(again) == read, place
        monkeypatch.chdir(again)
        assert exit_code(["board", "check", "."]) == 0


def test_a_bench_is_submitted_agent_by_agent(run: Path, tmp_path: Path) -> None:
    written = submitted(run.parents[1], tmp_path)
    seeds = {row.claimed.agent: row.protocol.seeds for row in map(read_row, written)}
    assert seeds == {"table": (0, 1), "random": (0,)}
    with pytest.raises(InvalidValueError, match="exists; remove it, or give another folder to --out"):
        submitted(run, tmp_path)
    shutil.rmtree(written[0])
    with pytest.raises(InvalidValueError, match=f"{written[1].name} exists"):
        submitted(run.parents[1], tmp_path)
    assert list(tmp_path.iterdir()) == written[1:], "none is written unless all can be"


def test_a_page_that_cannot_be_written_is_said_before_the_check(
    row: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "page").write_text("")
    assert exit_code(["board", "page", str(row), "--out", str(tmp_path / "page")]) == 2
    said = capsys.readouterr()
    assert not said.out and "page" in said.err


@pytest.mark.parametrize(
    ("changes", "frames", "seen"),
    [
        ({}, 0, "nothing"),
        ({"demonstrations": 2}, None, "2 demonstrations"),
        ({"agents": ("pupil",), "queries": 3, "feedback": 1.0}, 0, "3 oracle queries an episode; a teacher's feedback"),
        (
            {"after": ("arrow_puzzle_hard",), "after_episodes": 3, "unannounced": True},
            None,
            "3 episodes of arrow_puzzle_hard",
        ),
        ({"appearance": "mild", "dataset": 6}, None, "dataset mixed-6@"),
        ({"agents": ("oracle",)}, 0, "privileged: true macrostates"),
        ({"agents": ("dqn",)}, 24_000, "encoder arrow_puzzle-clean@"),
    ],
)
def test_all_that_was_seen_beforehand_is_said(
    tmp_path: Path, changes: dict[str, Any], frames: int | None, seen: str
) -> None:
    few = {"agents": ("table",), "budgets": (3,), "evaluation_episodes": 1, "seeds": (0,), **QUICK}
    if "dataset" in changes:
        changes = {**changes, "dataset": written(tmp_path / "set", episodes=changes["dataset"]).folder}
    done = bench(*plan("arrow_puzzle", "smoke", **{**few, **changes}), root=tmp_path / "bench", launcher=Inline())
    folder, *_ = submitted(done.folder, tmp_path / "rows")
    claimed = read_row(folder).claimed
    assert claimed.frames_beforehand == frames and claimed.seen_beforehand.startswith(seen)


def test_rows_of_unlike_tests_stand_in_tables_of_their_own() -> None:
    one = small(agents=("random",), execution="physics")
    unlike = {
        "task": "arrow_puzzle_hard", "execution": "kinematic", "appearance": "mild", "test_appearance": "strong",
        "physics": (("object_mass", 2.0),), "split": "plan_length=2", "observation": "state",
    }  # fmt: skip
    others = [dataclasses.replace(one, **{name: value}) for name, value in unlike.items()]
    assert len({world_words(each) for each in (one, *others)}) == 1 + len(others)
    assert world_words(dataclasses.replace(one, seeds=(5,), budgets=(3,))) == world_words(one)


def test_the_tests_of_tuning_seeds_are_told_from_those_of_others(tmp_path: Path) -> None:
    for seed in (3, TUNING_SEEDS + 3):
        wanted = small(agents=("random",), seeds=(seed,), evaluation_episodes=2)
        folder = made_bench(wanted, tmp_path).folder
        submitted(folder, tmp_path / "rows")
    found = {each.row.protocol.seeds[0]: each.row.starts for each in check(tmp_path) if each.row is not None}
    assert found == {3: "open starts", TUNING_SEEDS + 3: "tuning starts"}


def test_the_chance_beside_a_split_is_that_of_its_tests(tmp_path: Path) -> None:
    wanted = small(split="plan_length=2", agents=("random",), evaluation_episodes=2)
    folder = made_bench(wanted, tmp_path).folder
    submitted(folder, tmp_path / "rows")
    page = write_board(check(tmp_path), tmp_path / "page").read_text()
    exact = certificate(wanted.spec(testing=True)).chance_level
    assert f"Chance solves {percent(exact)} % of its episodes" in in_words(page)
    assert percent(exact) != percent(wanted.spec(testing=False).facts().chance_level)


@pytest.mark.parametrize("training", [None, 1])
def test_the_row_of_a_person_is_one(tmp_path: Path, training: int | None) -> None:
    wanted = protocol_of_player("arrow_puzzle", "person", "anna", tests=1, training=training, execution="kinematic")
    with played_run(wanted, tmp_path) as run:
        while not run.is_done:
            run.reset()
            run.step(0)
    submitted(run.folder, tmp_path / "rows")
    page = write_board(check(tmp_path), tmp_path / "page").read_text()
    assert "person:anna" in page and "no person has played here yet" not in page


def test_a_long_command_is_cut(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = bench_facts(run.parents[1])
    command = f"imagine-bench bench \x1b --set\n{'a=1 ' * 100}"
    monkeypatch.setattr(
        submitting, "bench_facts", lambda _: {"environment": {**facts["environment"], "command": command}}
    )
    (folder,) = submitted(run, tmp_path)
    claimed = read_row(folder).claimed.command
    assert claimed.startswith("imagine-bench bench  --set a=1 a=1") and len(claimed) == LONGEST


def test_the_check_says_each_verdict_in_one_line(row: Path, capsys: pytest.CaptureFixture[str]) -> None:
    opened = OpenRow(row)
    for price, steps in zip(opened.card["claimed"]["prices"], (4, 90, 40, 0), strict=True):
        price["env_steps"] = steps  # all that 4 and 9 episodes can have had, and no training
    opened.write()
    assert exit_code(["board", "check", str(row)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == (
        f"{row.name}: holds in arrow_puzzle, kinematic, clean; open starts; 24 episodes played again; "
        f"not vouched: {', '.join(NOT_VOUCHED)}"
    )
    assert said[1] == NEVER_SHOWN and said[2].startswith("24 episodes; checked in ")
    opened.card["vouched"][2]["successes"] += 1
    opened.write()
    assert exit_code(["board", "check", str(row.parents[1])]) == 1
    refused = capsys.readouterr()
    assert f"{row.name}: refused: seed 1, after 4 episodes: successes is 1, and the file says 2." in refused.out
    assert "1 of 1 rows are refused; see above." in refused.err


def is_refused(row: Path, sentence: str) -> None:
    (found,) = check(row.parents[1])
    assert found.row is None and sentence in found.verdict.complaint
    assert len(str(found).replace(str(row), "")) < 600 and "\n" not in str(found)


def as_link(row: Path) -> None:
    row.joinpath(EPISODES).unlink()
    row.joinpath(EPISODES).symlink_to("/etc/passwd")


def with_episodes(*parts: object) -> Callable[[Path], None]:
    def change(row: Path) -> None:
        opened = OpenRow(row)
        opened.parts = list(parts)
        opened.write()

    return change


def long_number(row: Path) -> None:
    card = (row / CARD).read_text()
    (row / CARD).write_text(card.replace('"successes": ', f'"successes": {"9" * 5000}'))


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "a link": (as_link, "episodes.json is no plain file."),
    "1 GiB": (lambda row: os.truncate(row / EPISODES, 1 << 30), f"at most {LARGEST[EPISODES]:,} are read."),
    "an archive": (
        lambda row: row.joinpath("episodes.zip").write_bytes(b"PK\3\4"),
        "it also holds 'episodes.zip'; a row holds card.json and episodes.json alone.",
    ),
    "a pipe": (lambda row: os.mkfifo(row / "x"), "it also holds 'x'"),
    "5,000 digits": (long_number, "Exceeds the limit"),
    "deep": (lambda row: (row / CARD).write_text("[" * 100_000), "is not the card of a row"),
    "no episodes": (with_episodes(), "it has 0 sets of tests and 4 prices for 4."),
    "texts for episodes": (with_episodes("a", "b", "c", "d"), "is not the episodes of a row"),
    "unknown columns": (with_episodes({"actions": [], "x": 1}), "it has 'x', which is unknown"),
}


@pytest.mark.parametrize("attack", FILES)
def test_a_hostile_file_is_refused_in_one_sentence(row: Path, attack: str) -> None:
    change, sentence = FILES[attack]
    change(row)
    is_refused(row, sentence)


@pytest.mark.parametrize(
    ("part", "name", "value", "sentence"),
    [
        ("figures", "successes", 10**4000, "successes is"),
        ("figures", "successes", "3", "successes was given '3'; it takes a whole number."),
        ("figures", "mean_return", float("nan"), "mean_return is"),
        ("claimed", "agent", "../../etc", "its protocol is of"),
        ("claimed", "author", "a\x1b[2Jb", "The claim 'author' is"),
        ("claimed", "author", "a\u202eb", "The claim 'author' is"),  # from right to left
        ("claimed", "author", "\ud800", "surrogates not allowed"),  # half a character
        ("claimed", "command", "x" * 301, "give at most 300 printable characters"),
        ("claimed", "frames_beforehand", -1, "frames_beforehand is -1; give 0 to 1,000,000,000,000."),
        ("claimed", "frames_beforehand", 10**400, "give 0 to 1,000,000,000,000."),
        ("price", "env_steps", 3, "3 macro-actions cannot be those of 4 training episodes."),
        ("price", "env_steps", 41, "41 macro-actions cannot be those of 4 training episodes."),
        ("protocol", "preset", "\ud800", "surrogates not allowed"),
        ("protocol", "task", "arrows:@/etc/passwd", "its task names a file"),
        ("protocol", "task", "../arrows", "No task '../arrows'"),
        ("protocol", "evaluation_episodes", 10_000_000, "it has 6 tests, and its protocol 10000000."),
        ("card", "round", "..", "its round is"),
        ("card", "round", "a/b", "its round is"),
    ],
)
def test_a_hostile_card_is_refused_in_one_sentence(
    row: Path, part: str, name: str, value: object, sentence: str
) -> None:
    opened = OpenRow(row)
    parts = {"card": opened.card, "figures": opened.card["vouched"][0], **opened.card}
    parts["price"] = opened.card["claimed"]["prices"][0]
    parts[part][name] = value
    opened.write()
    is_refused(row, sentence)


@pytest.mark.parametrize("name", ["<script>alert(1)", ".hidden", "a\nb", "A" * 90, "é", "index"])
def test_a_row_with_a_hostile_name_is_refused(row: Path, tmp_path: Path, name: str) -> None:
    (found,) = check(row.rename(row.with_name(name)).parents[1])
    assert "a row cannot be called" in found.verdict.complaint
    page = write_board([found], tmp_path / "page")
    assert "<script>alert" not in page.read_text()
    assert sorted(path.name for path in page.parent.iterdir()) == ["board.csv", "index.html"]


def test_hostile_claims_are_text_on_the_pages(row: Path, tmp_path: Path) -> None:
    hostile = "<img src=x onerror=alert(1)>\"'</pre><script>alert(2)</script>"
    opened = OpenRow(row)
    opened.card["claimed"] |= dict.fromkeys(("author", "command", "seen_beforehand"), hostile)
    opened.write()
    found = check(row.parents[1])
    assert found[0].row is not None
    for page in write_board(found, tmp_path / "page").parent.glob("*.html"):
        assert "<img src=x" not in page.read_text() and "<script>alert" not in page.read_text()


def test_every_number_of_the_page_leads_to_its_episodes(row: Path, tmp_path: Path, pytestconfig: pytest.Config) -> None:
    page = write_board(check(row.parents[1]), tmp_path / "page")
    text = page.read_text()
    address = f"{row.name}.html#seed-0-after-9"
    assert text.count(f'href="{address}"') == 2
    linked = (page.parent / f"{row.name}.html").read_text()
    words = "\n\n".join(in_words(each).partition("How it was made")[0] for each in (text, linked))
    words = re.sub(r"\S+ \| nothing$", "CPU s | nothing", words.replace(row.name, "ROW"), flags=re.MULTILINE)
    expected_of(pytestconfig)("board", words)
    assert 'id="seed-0-after-9"' in linked
    read = read_row(row)
    for test in range(6):
        kept = read.kept(1)
        start = " ".join(map(str, kept.starts[test].tolist()))
        actions = " ".join(map(str, kept.actions_of(test)))
        assert f"<td>{test}</td><td>{start}</td><td>{actions}</td>" in linked
    assert "no person has played here yet" in text
    assert (page.parent / "board.csv").read_text().count("\n") == 1 + 4


def test_the_row_that_solves_most_after_its_last_budget_comes_first(row: Path) -> None:
    """Figures are means over seeds, in the table and in the curve; rows of one player have a curve each."""
    shutil.copytree(row, row.with_name("a_copy"))
    told = {"a_copy": (6, 0, 6, 3), row.name: (0, 5, 0, 2)}  # of six tests: seed 0 after 4 and 9 episodes, then seed 1
    found = []
    for each in check(row.parents[1]):
        assert isinstance(each.row, Row)
        figures, prices = each.row.vouched, each.row.claimed.prices
        seen = [
            dataclasses.replace(f, successes=n, mean_return=n + 0.5)
            for f, n in zip(figures, told[each.row.name], strict=True)
        ]
        paid = tuple(
            dataclasses.replace(price, env_steps=steps, train_cpu_s=2.0 * steps)
            for price, steps in zip(prices, (4, 20, 4, 40), strict=True)
        )
        claimed = dataclasses.replace(each.row.claimed, prices=paid)
        found.append(dataclasses.replace(each, row=dataclasses.replace(each.row, vouched=tuple(seen), claimed=claimed)))
    section, *_ = board_page(found).sections
    cells = dict(zip(section.tables[0].header, zip(*section.tables[0].rows, strict=True), strict=True))
    assert [re.sub("<.*?>", "", each) for each in cells["return"][:2]] == ["4.00", "2.00"]
    assert cells["macro-actions (claimed)"][:2] == ("30", "30") and cells["CPU s (claimed)"][0] == "60.0"
    draw = section.images[0].draw
    assert draw is not None
    curves = {line.get_label(): np.asarray(line.get_ydata()).tolist() for line in draw().axes[0].lines}
    assert curves == {"table": [100.0, 25.0], row.name: [0.0, pytest.approx(100.0 * 7 / 12)]}


def test_a_row_of_another_folder_is_not_read_as_one(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ArtefactError, match="holds no rows; 'imagine-bench submit RUN --out"):
            check(folder)
