"""Rounds: a promised seed, agents that are filed before it is published, and tests that they play at its starts."""

from __future__ import annotations

import dataclasses
import json
from datetime import date
from pathlib import Path

import bench_fakes  # noqa: F401 - registers its agents
import pytest
from board_forging import AFTER, BEFORE, CLOSES, ROUND, TESTS, OpenRow, on, submitted, with_round
from imagine_bench_board import rounds
from imagine_bench_board.check import check
from imagine_bench_board.rows import NAME, read_row, row_name
from imagine_bench_board.submit import file_agents, submit
from small_runs import made_bench, small

from imagine_bench import registry
from imagine_bench.cli import exit_code
from imagine_bench.errors import ArtefactError, InvalidValueError


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    wanted = small(agents=("table",), seeds=(0, 1))
    return made_bench(wanted, tmp_path_factory.mktemp("bench")).folder


def opened(tmp_path: Path) -> tuple[Path, Path]:
    folder = tmp_path / "board" / "rounds" / ROUND
    secret = tmp_path / "secret.json"
    with on(BEFORE):
        rounds.open_round(folder, closes=CLOSES, tests=TESTS, secret=secret)
    return folder, secret


def test_a_round_from_promise_to_rows(finished: Path, tmp_path: Path) -> None:
    board = tmp_path / "board"
    with_round(finished, board, tmp_path / "secret.json")
    (found,) = check(board)
    assert found.verdict.complaint == "" and "; round winter; " in str(found)
    assert found.verdict.episodes == 2 * TESTS
    seed = json.loads((tmp_path / "secret.json").read_text())["seed"]
    assert json.loads((board / "rounds/winter/revealed.json").read_text())["seed"] == seed
    (other,) = submitted(finished, tmp_path / "open")
    own = read_row(next((board / "rows").iterdir()))
    fingerprints = own.kept(0).fingerprints.tolist()
    assert not set(fingerprints) & set(read_row(other).kept(1).fingerprints.tolist())
    both = OpenRow(board / "rows" / own.name)
    both.keep_places([0, 0, 1, 1])
    both.protocol["budgets"] = [4, 9]
    both.card["vouched"] = [
        {**each, "episodes": budget} for each, budget in zip(both.card["vouched"], (4, 9, 4, 9), strict=True)
    ]
    for price in both.card["claimed"]["prices"]:
        price["env_steps"] = 0
    both.write()
    (found,) = check(board)
    assert "a row of a round has the tests of one budget, the last." in found.verdict.complaint


@pytest.mark.parametrize("player", ["imagination:" + "deep" * 20, "_best", "__"])
@pytest.mark.parametrize("ending", ["0123456789ab", "0123456789ab-" + "w" * rounds.LONGEST_ROUND])
def test_whatever_a_player_is_called_a_row_can_have_its_name(player: str, ending: str) -> None:
    name = row_name(player, ending)
    assert NAME.fullmatch(name) and name.endswith(f"-{ending}")
    assert name != row_name(player + "er", ending), "another player's"


def test_a_name_that_leaves_its_rows_no_room_is_none_of_a_round(tmp_path: Path) -> None:
    with on(BEFORE), pytest.raises(InvalidValueError, match=r"^A round cannot be called 'w+'; give at most 40 of a-z"):
        rounds.open_round(tmp_path / ("w" * 41), closes=CLOSES, tests=TESTS, secret=tmp_path / "secret.json")
    assert not list(tmp_path.iterdir())


def test_a_round_is_known_from_within_its_folder(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = opened(tmp_path)
    monkeypatch.chdir(folder)
    with on(BEFORE):
        assert exit_code(["board", "file", str(finished), "--round", "."]) == 0
    (filed,) = (folder / "filed").iterdir()
    assert filed.stem.endswith(f"-{ROUND}")


def test_the_promise_does_not_show_the_seed(tmp_path: Path) -> None:
    folder, secret = opened(tmp_path)
    promised = json.loads((folder / "round.json").read_text())
    values = json.loads(secret.read_text())
    assert promised == {"closes": CLOSES, "tests": TESTS, "sha256": rounds.promise(**values)}
    assert len(values["salt"]) == 64  # 256 bits, so that nobody can try all seeds
    assert rounds.promise(values["seed"], "0" * 64) != promised["sha256"]


def test_days_decide_what_may_be_done(finished: Path, tmp_path: Path) -> None:
    folder, secret = opened(tmp_path)
    with on(BEFORE), pytest.raises(InvalidValueError, match="closes on 2026-12-24; reveal its seed from then on"):
        rounds.reveal(folder, secret)
    with on(AFTER), pytest.raises(InvalidValueError, match="2026-12-24 is not after today, 2026-12-24"):
        rounds.open_round(tmp_path / "late", closes=CLOSES, tests=TESTS, secret=tmp_path / "other.json")
    with on(AFTER), pytest.raises(InvalidValueError, match="closed on 2026-12-24; file in a later one"):
        file_agents(finished, folder)
    with on(date(2026, 12, 23)):
        file_agents(finished, folder)
        with pytest.raises(InvalidValueError, match="these agents are filed already"):
            file_agents(finished, folder)


def test_all_that_can_be_wrong_with_a_row_is_said_before_its_tests_are_played(finished: Path, tmp_path: Path) -> None:
    folder, _ = opened(tmp_path)
    with on(BEFORE):
        (filed,) = file_agents(finished, folder)
    out = tmp_path / "rows"
    given = {"round_folder": folder, "encoder": None}
    with pytest.raises(InvalidValueError, match=r"The claim 'author' is 'aaa.*give at most 300 printable"):
        submit(finished, out, author="a" * 301, **given)
    (out / filed.stem).mkdir(parents=True)
    with pytest.raises(InvalidValueError, match="exists; remove it, or give another folder to --out"):
        submit(finished, out, author="", **given)
    with pytest.raises(ArtefactError, match=r"There is no .*revealed\.json"):
        submit(finished, tmp_path / "others", author="", **given)


@pytest.mark.parametrize("kind", ["external_training_loop", "is_player"])
def test_who_cannot_play_in_a_round_is_not_filed(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    folder, _ = opened(tmp_path)
    changed = dataclasses.replace(registry.AGENTS["table"], **{kind: True})
    monkeypatch.setitem(registry.AGENTS, "table", changed)
    with on(BEFORE), pytest.raises(InvalidValueError, match="table cannot be taken up again; submit the tests of its"):
        file_agents(finished, folder)
    assert [each.name for each in folder.iterdir()] == ["round.json"]


def test_only_what_was_filed_and_promised_is_published(finished: Path, tmp_path: Path) -> None:
    folder, secret = opened(tmp_path)
    values = json.loads(secret.read_text())
    other = tmp_path / "other.json"
    other.write_text(json.dumps({**values, "seed": (values["seed"] + 1) % 2**24}))
    with on(AFTER):
        with pytest.raises(ArtefactError, match=r"other.json is not of winter"):
            rounds.reveal(folder, other)
        rounds.reveal(folder, secret)
    with pytest.raises(ArtefactError, match="was not filed in the round winter before its seed was published"):
        submit(finished, tmp_path / "rows", author="", round_folder=folder, encoder=None)
