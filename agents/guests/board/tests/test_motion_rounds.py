"""Rounds of continuous control: a policy's file is filed, its tests have the starts of the round, forgeries fall."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from unittest import mock

import pytest
from board_forging import AFTER, BEFORE, CLOSES, ROUND, on
from imagine_bench_board import rounds
from imagine_bench_board.check import check
from imagine_bench_board.motion_rows import read_motions
from imagine_bench_board.motions import MotionTests
from imagine_bench_board.rows import ROWS
from imagine_bench_board.submit import file_agents
from test_motions import WORLD, OpenMotions, played

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.seeding import episode_seed

NAME = f"my-policy-{ROUND}"
TESTS = 2
SEED = 505
"""Of the round. Its first test starts in another macrostate than the first open test of this seed and of seed 31."""


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a policy's file, another file, and a board with the policy's row of a round."""
    root = tmp_path_factory.mktemp("round")
    folder = root / "board" / rounds.ROUNDS / ROUND
    (root / "My policy.pt").write_bytes(b"weights")
    (root / "late.pt").write_bytes(b"others")
    with on(BEFORE), mock.patch.object(rounds.secrets, "randbelow", lambda _: SEED):
        rounds.open_round(folder, closes=CLOSES, tests=TESTS, secret=root / "secret.json")
        (filed,) = file_agents(root / "My policy.pt", folder)
    assert filed.stem == NAME
    with pytest.raises(ArtefactError, match=r"There is no .*revealed\.json"):
        MotionTests(WORLD, round_folder=folder, policy=root / "My policy.pt")
    with on(AFTER):
        rounds.reveal(folder, root / "secret.json")
    played(root / "board" / ROWS, NAME, control="joint", round_folder=folder, policy=root / "My policy.pt")
    return root


@pytest.fixture
def root(honest: Path, tmp_path: Path) -> Path:
    return shutil.copytree(honest, tmp_path / "copy")


def test_a_filed_policy_plays_the_starts_of_the_round(root: Path) -> None:
    (found,) = check(root / "board")
    assert found.verdict.complaint == "" and found.verdict.episodes == TESTS
    assert f"; round {ROUND}; " in str(found)
    row = root / "board" / ROWS / NAME
    protocol = read_motions(row).protocol
    assert protocol.seed == json.loads((root / "secret.json").read_text())["seed"] == SEED
    wanted = [episode_seed("board", SEED, test) for test in range(TESTS)]
    assert [protocol.start(test) for test in range(TESTS)] == wanted
    row.rename(row.with_name("not-filed"))
    (found,) = check(root / "board")
    assert found.row is None and "it was not filed in the round winter" in found.verdict.complaint


def test_only_the_filed_file_plays(root: Path) -> None:
    folder = root / "board" / rounds.ROUNDS / ROUND
    with pytest.raises(ArtefactError, match="was not filed in the round winter before its seed was published"):
        MotionTests(WORLD, round_folder=folder, policy=root / "late.pt")
    (root / "My policy.pt").write_bytes(b"trained for these starts")
    with pytest.raises(ArtefactError, match=f"is not the file that was filed as {NAME}"):
        MotionTests(WORLD, round_folder=folder, policy=root / "My policy.pt")
    with pytest.raises(InvalidValueError, match="needs round_folder and policy; give both, or none"):
        MotionTests(WORLD, round_folder=folder)
    (root / "My policy.pt").write_bytes(b"weights")
    env = MotionTests(WORLD, observation="proprio", round_folder=folder, policy=root / "My policy.pt")
    env.motions = list(read_motions(root / "board" / ROWS / NAME).motions)
    with pytest.raises(InvalidValueError, match=f"was filed as {NAME}; give this name"):
        env.write(root / "other", "another", agent="me")


OTHERS = "0" * 64


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"card": {"policy_sha256": OTHERS}}, "its agents are not those that were filed in the round winter"),
        (
            {"card": {"policy_sha256": OTHERS}, "filed": {"policy": OTHERS}},
            "was changed after the seed of the round was published",
        ),
        ({"protocol": {"seed": 5}}, "its seed is not that of the round winter"),
        ({"round": {"tests": TESTS + 1}}, "it has 2 tests, and the round winter has 3"),
        ({"protocol": {"round": ""}}, "test 0: "),
        ({"protocol": {"round": "../winter"}}, "its round is '../winter'"),
    ],
)
def test_forged_rows_of_a_round_are_refused(root: Path, changes: dict[str, dict[str, object]], complaint: str) -> None:
    folder = root / "board" / rounds.ROUNDS / ROUND
    row = OpenMotions(root / "board" / ROWS / NAME)
    row.card |= changes.get("card", {})
    row.protocol.update(changes.get("protocol", {}))
    files = {"filed": folder / "filed" / f"{NAME}.json", "round": folder / "round.json"}
    for name in files.keys() & changes.keys():
        files[name].write_text(json.dumps(json.loads(files[name].read_text()) | changes[name]))
    found = row.check()
    assert found.row is None and complaint in found.verdict.complaint


def test_open_tests_are_not_called_those_of_a_round(root: Path) -> None:
    rows = root / "board" / ROWS
    shutil.rmtree(rows)
    row = OpenMotions(played(rows, NAME, control="joint", tests=TESTS, seed=31))
    filed = json.loads((root / "board" / rounds.ROUNDS / ROUND / "filed" / f"{NAME}.json").read_text())
    row.card["policy_sha256"] = filed["policy"]
    row.protocol.update(seed=SEED, round=ROUND)
    found = row.check()
    assert found.row is None and "test 0: " in found.verdict.complaint
