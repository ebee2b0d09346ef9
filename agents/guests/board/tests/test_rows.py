"""Rows of a leaderboard: a written row is read again, the check plays it, and hostile files get one sentence."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import bench_fakes  # noqa: F401 - registers its agents
import pytest
from board_forging import OpenRow
from imagine_bench_board import submit as submitting
from imagine_bench_board.check import NEVER_SHOWN, NOT_VOUCHED, check
from imagine_bench_board.page import write_board
from imagine_bench_board.rows import CARD, EPISODES, LARGEST, LONGEST, read_row, world_words
from imagine_bench_board.submit import submit
from report_pages import in_words
from small_runs import Inline, small
from whole_outputs import expected_of

from imagine_bench.cli import exit_code
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.running.bench import bench
from imagine_bench.store.bench_folder import bench_facts
from imagine_bench.store.run_folder import load_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a small bench of two agents."""
    wanted = small(agents=("table", "random"), seeds=(0, 1), evaluation_episodes=6)
    result = bench(wanted, {}, root=tmp_path_factory.mktemp("bench"), launcher=Inline())
    return result.runs[0].folder


@pytest.fixture
def row(run: Path, tmp_path: Path) -> Path:
    (folder,) = submit(run, tmp_path / "board" / "rows", author="a founder", round_folder=None, encoder=None)
    return folder


def test_a_run_is_submitted_with_all_seeds_and_budgets(run: Path, row: Path) -> None:
    read = read_row(row)
    assert [(each.seed, each.episodes) for each in read.vouched] == [(0, 4), (0, 9), (1, 4), (1, 9)]
    kept = load_run(run.with_name("seed_1")).checkpoints[1]
    assert read.checkpoint(3) == dataclasses.replace(kept, eval_cpu_s=0.0, diagnostics={}, open_loop=None)
    assert [read.kept(3).actions_of(test) for test in range(6)] == [kept.kept.actions_of(test) for test in range(6)]
    assert read.claimed.agent == "table" and read.claimed.author == "a founder"
    assert {each.agent_sha256 for each in read.claimed.prices} != {""}


def test_a_bench_is_submitted_agent_by_agent(run: Path, tmp_path: Path) -> None:
    written = submit(run.parents[1], tmp_path, author="", round_folder=None, encoder=None)
    assert [read_row(folder).claimed.agent for folder in written] == ["table", "random"]
    with pytest.raises(InvalidValueError, match="exists; remove it, or give another folder to --out"):
        submit(run, tmp_path, author="", round_folder=None, encoder=None)


def test_rows_of_unlike_tests_stand_in_tables_of_their_own() -> None:
    one = small(agents=("random",), execution="physics")
    unlike = {
        "task": "arrow_puzzle_hard", "execution": "kinematic", "appearance": "mild", "test_appearance": "strong",
        "physics": (("object_mass", 2.0),), "split": "plan_length=2", "observation": "state",
    }  # fmt: skip
    others = [dataclasses.replace(one, **{name: value}) for name, value in unlike.items()]
    assert len({world_words(each) for each in (one, *others)}) == 1 + len(others)
    assert world_words(dataclasses.replace(one, seeds=(5,), budgets=(3,))) == world_words(one)


def test_a_long_command_is_cut(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = bench_facts(run.parents[1])
    command = f"imagine-bench bench \x1b --set\n{'a=1 ' * 100}"
    monkeypatch.setattr(
        submitting, "bench_facts", lambda _: {"environment": {**facts["environment"], "command": command}}
    )
    (folder,) = submit(run, tmp_path, author="", round_folder=None, encoder=None)
    claimed = read_row(folder).claimed.command
    assert claimed.startswith("imagine-bench bench  --set a=1 a=1") and len(claimed) == LONGEST


def test_a_run_is_found_from_its_own_folder(
    run: Path, row: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    (again,) = submit(Path(), tmp_path, author="a founder", round_folder=None, encoder=None)
    assert read_row(again) == read_row(row)


def test_the_check_says_the_verdict_in_one_line(row: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["board", "check", str(row)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == (
        f"{row.name}: holds in arrow_puzzle, kinematic, clean; open starts; 24 episodes played again; "
        f"not vouched: {', '.join(NOT_VOUCHED)}"
    )
    assert said[1] == NEVER_SHOWN and said[2].startswith("24 episodes; checked in ")


def test_a_refused_row_ends_with_exit_code_1(row: Path, capsys: pytest.CaptureFixture[str]) -> None:
    opened = OpenRow(row)
    opened.card["vouched"][2]["successes"] += 1
    opened.write()
    assert exit_code(["board", "check", str(row.parents[1])]) == 1
    said = capsys.readouterr()
    assert f"{row.name}: refused: seed 1, after 4 episodes: successes is 1, and the file says 2." in said.out
    assert "1 of 1 rows are refused; see above." in said.err


def as_link(row: Path) -> None:
    row.joinpath(EPISODES).unlink()
    row.joinpath(EPISODES).symlink_to("/etc/passwd")


def too_large(row: Path) -> None:
    with row.joinpath(EPISODES).open("wb") as file:
        file.truncate(1 << 30)  # 1 GiB, none of it on the disk


def of_archive(row: Path) -> None:
    row.joinpath("episodes.zip").write_bytes(b"PK\3\4")


def with_number(name: str, value: str) -> Callable[[Path], None]:
    """A number of the card, written as it stands."""

    def change(row: Path) -> None:
        card = json.loads((row / CARD).read_text())
        card["vouched"][0][name] = "HERE"
        (row / CARD).write_text(json.dumps(card).replace('"HERE"', value))

    return change


def with_claim(name: str, value: object) -> Callable[[Path], None]:
    def change(row: Path) -> None:
        opened = OpenRow(row)
        opened.card["claimed"][name] = value
        opened.write()

    return change


def with_protocol(**changes: object) -> Callable[[Path], None]:
    def change(row: Path) -> None:
        opened = OpenRow(row)
        opened.protocol.update(changes)
        opened.write()

    return change


def with_episodes(text: str) -> Callable[[Path], None]:
    def change(row: Path) -> None:
        opened = OpenRow(row)
        opened.parts = json.loads(text)
        opened.write()

    return change


def deep(row: Path) -> None:
    (row / CARD).write_text("[" * 100_000)


HOSTILE: dict[str, tuple[Callable[[Path], None], str]] = {
    "a link": (as_link, "episodes.json is no plain file."),
    "1 GiB": (too_large, f"has 1,073,741,824 bytes; at most {LARGEST[EPISODES]:,} are read."),
    "an archive": (of_archive, "it also holds 'episodes.zip'; a row holds card.json and episodes.json alone."),
    "a pipe": (lambda row: os.mkfifo(row / "x"), "it also holds 'x'"),
    "5,000 digits": (with_number("successes", "9" * 5000), "Exceeds the limit"),
    "4,000 digits": (with_number("successes", "9" * 4000), "successes is"),
    "not a number": (with_number("mean_return", "NaN"), "mean_return is"),
    "a text for a number": (with_number("successes", '"3"'), "successes was given '3'; it takes a whole number."),
    "deep": (deep, "is not the card of a row"),
    "a path for a round": (with_claim("agent", "../../etc"), "its protocol is of"),
    "control characters": (with_claim("author", "a\x1b[2Jb"), "The claim 'author' is"),
    "a long claim": (with_claim("command", "x" * 301), "give at most 300 printable characters"),
    "half a character": (with_claim("author", "\ud800"), "surrogates not allowed"),
    "half a character elsewhere": (with_protocol(preset="\ud800"), "surrogates not allowed"),
    "from right to left": (with_claim("author", "a\u202eb"), "The claim 'author' is"),
    "frames below zero": (with_claim("frames_beforehand", -1), "frames_beforehand is -1; give 0 to 1,000,000,000,000."),
    "frames of 400 digits": (with_claim("frames_beforehand", 10**400), "give 0 to 1,000,000,000,000."),
    "a world in a file": (with_protocol(task="arrows:@/etc/passwd"), "its task names a file"),
    "no such task": (with_protocol(task="../arrows"), "No task '../arrows'"),
    "ten million tests": (with_protocol(evaluation_episodes=10_000_000), "it has 6 tests, and its protocol 10000000."),
    "no episodes": (with_episodes("[]"), "it has 0 sets of tests and 4 prices for 4."),
    "texts for episodes": (with_episodes('["a", "b", "c", "d"]'), "is not the episodes of a row"),
    "unknown columns": (with_episodes('[{"actions": [], "x": 1}]'), "it has 'x', which is unknown"),
}


@pytest.mark.parametrize("attack", HOSTILE)
def test_a_hostile_row_is_refused_in_one_sentence(row: Path, attack: str) -> None:
    change, sentence = HOSTILE[attack]
    change(row)
    (found,) = check(row.parents[1])
    assert found.row is None and sentence in found.verdict.complaint
    assert len(str(found).replace(str(row), "")) < 600 and "\n" not in str(found)


def test_a_round_cannot_lead_out_of_the_board(row: Path) -> None:
    opened = OpenRow(row)
    for name in ("../rows", "..", "/etc", "a/b"):
        opened.card["round"] = name
        opened.write()
        with pytest.raises(ArtefactError, match="its round is"):
            read_row(row)


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "x y", ".hidden", "a\nb", "A" * 90, "é", "index"])
def test_a_row_with_a_hostile_name_is_refused(row: Path, tmp_path: Path, name: str) -> None:
    try:
        there = row.rename(row.with_name(name.replace("/", "-")))
    except OSError:
        return
    (found,) = check(there.parents[1])
    assert "a row cannot be called" in found.verdict.complaint
    page = write_board([found], tmp_path / "page")
    assert "<script>alert" not in page.read_text()
    assert sorted(path.name for path in page.parent.iterdir()) == ["board.csv", "index.html"]


def test_hostile_claims_are_text_on_the_pages(row: Path, tmp_path: Path) -> None:
    hostile = "<img src=x onerror=alert(1)>\"'</pre><script>alert(2)</script>"
    for name in ("author", "command", "seen_beforehand"):
        with_claim(name, hostile)(row)
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


def test_a_row_of_another_folder_is_not_read_as_one(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="holds no rows; 'imagine-bench submit RUN --out"):
        check(tmp_path)
    shutil.rmtree(tmp_path)
    with pytest.raises(ArtefactError, match="holds no rows"):
        check(tmp_path)
