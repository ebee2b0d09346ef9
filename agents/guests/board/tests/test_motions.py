"""Rows of continuous control: tests are recorded by any control, played again by joints, and forgeries are refused."""

from __future__ import annotations

import base64
import dataclasses
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_forging import OpenRow
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench_board import motions
from imagine_bench_board.check import NOT_VOUCHED, Checked, check
from imagine_bench_board.commands import board
from imagine_bench_board.motion_rows import MotionRow, PlayedMotion, read_motions
from imagine_bench_board.motions import SLACK_PERIODS, MotionTests
from imagine_bench_board.page import write_board
from imagine_bench_board.rows import LONGEST
from report_pages import in_words

from imagine_bench.arrays import Floats32
from imagine_bench.errors import CheckFailedError, ImagineBenchError, InvalidValueError
from imagine_bench.report.page import decimals

WORLD = "arrows:cubes=1"
TESTS = 4
OTHER = "4.0.0"
"""Another version of MuJoCo."""


def played(root: Path, name: str = "expert-and-nobody", **options: Any) -> Path:
    """A row whose even tests the expert plays and whose odd ones nobody does: there the hand stays where it is."""
    env = MotionTests(WORLD, observation="proprio", **{"tests": TESTS, "seed": 30, **options})
    motion: Any = env.unwrapped
    expert = Expert(motion)
    for test in range(env.protocol.tests):
        env.reset()
        over = False
        while not over:
            if test % 2 == 0 and expert.is_done:
                expert.begin(motion.task.rules.optimal_action(motion.episode.macrostate))
            target = expert.act() if test % 2 == 0 else np.append(motion.servo_targets()[:-1], 1.0)
            _, _, terminated, truncated, _ = env.step(target)
            over = terminated or truncated
    return env.write(root, name, agent="expert", author="a founder")


class OpenMotions(OpenRow):
    """A row of continuous control, open for changes."""

    def commands(self, test: int) -> Any:
        return np.frombuffer(base64.b64decode(self.parts[test]["commands"]), "<f4").reshape(-1, 8).copy()

    def put(self, test: int, commands: Any) -> None:
        self.parts[test]["commands"] = base64.b64encode(commands.astype("<f4").tobytes()).decode()

    def check(self) -> Checked:
        """The finding about the row as it is now."""
        self.write()
        (found,) = check(self.folder)
        return found

    def judged(self, mujoco: str = "") -> Checked:
        """The finding once the figures were brought up to date, by which version of MuJoCo is said."""
        sure = [part for part in self.parts if part["reproducible"]]
        failed = [min(part["total_reward"], -5.0) for part in self.parts if not part["reproducible"]]
        self.card["mujoco"] = mujoco or self.card["mujoco"]
        self.card["vouched"] = {
            "successes": sum(part["solved"] is True for part in sure),
            "faults": sum(part["fault"] for part in sure),
            "mean_return": float(np.mean([part["total_reward"] for part in sure] + failed)),
            "mean_periods": float(np.mean([len(part["commands"]) * 3 // 4 // 32 for part in self.parts])),
            "not_reproducible": len(failed),
        }
        return self.check()


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played(tmp_path_factory.mktemp("board") / "rows", control="joint")


@pytest.fixture
def row(honest: Path, tmp_path: Path) -> OpenMotions:
    return OpenMotions(shutil.copytree(honest, tmp_path / "rows" / honest.name))


@pytest.fixture
def few_replays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two disturbed replays of a test in place of sixteen, where their number does not matter."""
    monkeypatch.setattr(motions, "DISTURBED", 2)


def test_an_honest_row_holds_and_says_what_happened(row: OpenMotions, tmp_path: Path) -> None:
    read = read_motions(row.folder)
    assert [each.solved for each in read.motions] == [True, False, True, False]
    assert read.vouched.successes == 2 and read.vouched.faults == 0
    assert all(each.reproducible for each in read.motions)
    assert [each.periods for each in read.motions][1::2] == [750, 750]  # 3 s for each of ten macro-actions
    assert len(row.parts[1]["commands"]) < 750 * 43, "as long as a row allows for"
    found = row.judged()
    assert str(found) == (
        f"{read.name}: holds in {WORLD}, continuous control at 25 Hz, clean; open starts; 4 episodes played again; "
        f"not vouched: {', '.join(NOT_VOUCHED)}"
    )
    assert isinstance(found.row, MotionRow)
    worse = dataclasses.replace(found.row, name="worse", vouched=dataclasses.replace(read.vouched, mean_return=-1.0))
    page = write_board([dataclasses.replace(found, row=worse), found], tmp_path / "page").read_text()
    assert page.count(f'href="{read.name}.html#tests"') == 5, "each number that is vouched for leads to its episodes"
    shown = in_words(page)
    seconds = sum(len(each.commands) for each in read.motions) / TESTS / 25
    rest = f"{decimals(seconds)} | 0 | 0 | 4 | open starts |"
    best, other = (f"expert | 50.0 | {number} | {rest}" for number in (decimals(read.vouched.mean_return), "−1.00"))
    assert 0 < shown.index(best) < shown.index(other), shown
    linked = in_words((tmp_path / "page" / f"{read.name}.html").read_text())
    assert "2 of 4 tests solved" in linked
    assert f"\n1 | {read.protocol.start(1)} | 30.00 | 0 | no | no | yes\n" in linked, linked
    row.protocol.update(task=f"{WORLD},slip=0", appearance="light=0")
    assert "holds" in str(row.check()) and read_motions(row.folder).world == read.world, "the same world in other words"


@pytest.mark.usefixtures("few_replays")
@pytest.mark.parametrize("control", ["twist", "joint_delta", "pose"])
def test_whatever_control_a_policy_has_its_joint_commands_play_again(tmp_path: Path, control: str) -> None:
    mild = {"light": 0.5, "pose": 0.5, "hand": 0.5}
    env = MotionTests(WORLD, control=control, observation="proprio", tests=2, seed=3, appearance=mild, placement=0.02)
    rng = np.random.default_rng(7)
    low, high = env.action_space.low, env.action_space.high
    for _ in range(2):
        env.reset()
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(rng.uniform(low, high).astype(np.float32))
            over = terminated or truncated
    (found,) = check(env.write(tmp_path, "random", agent="random"))
    assert "holds" in str(found) and f"{WORLD}, continuous control at 25 Hz, mild, objects up to 2 cm off" in str(found)


def test_every_test_is_played_whole_and_no_more_than_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = MotionTests(WORLD, control="joint", observation="proprio", tests=1, seed=3)
    env.reset(seed=99)
    rest = np.append(env.unwrapped.servo_targets()[:-1], 1.0)  # type: ignore[attr-defined]
    env.step(rest)
    with pytest.raises(InvalidValueError, match=r"Test 0 was left before its end\. Make a new MotionTests"):
        env.reset()
    with pytest.raises(InvalidValueError, match="0 of 1 tests were played; play all"):
        env.write(tmp_path, "early", agent="nobody")
    while not env.step(rest)[3]:
        pass
    env.reset()  # as loops of libraries do once more
    env.step(rest)
    env.reset()
    monkeypatch.setattr(sys, "argv", ["play.py", "a" * 400])
    for name in ("../out", "a/b", "", "Upper", "index"):
        with pytest.raises(InvalidValueError, match="A row cannot be called"):
            env.write(tmp_path / "rows", name, agent="nobody")
    assert not list(tmp_path.iterdir())
    written = read_motions(env.write(tmp_path, "whole", agent="nobody"))
    assert len(written.claimed.command) == LONGEST, "a long command is cut"
    assert [each.periods for each in written.motions] == [750]
    with pytest.raises(InvalidValueError, match="exists; remove it, or give another name"):
        env.write(tmp_path, "whole", agent="nobody")


def dropped(row: OpenMotions) -> None:
    row.parts.pop(1)
    row.protocol["tests"] -= 1


def longer(row: OpenMotions) -> None:
    commands = row.commands(0)
    row.put(0, np.concatenate([commands, np.repeat(commands[-1:], SLACK_PERIODS + 1, axis=0)]))


def no_numbers(row: OpenMotions) -> None:
    commands = row.commands(1)
    commands[5, 3] = np.nan
    row.put(1, commands)


def other_fingerprint(row: OpenMotions, test: int = 1) -> None:
    row.parts[test]["fingerprint"] ^= 1


FORGERIES: dict[str, Callable[[OpenMotions], object]] = {
    "a failure called solved": lambda row: row.parts[1].update(solved=True, total_reward=50.0),
    "a higher return": lambda row: row.parts[0].update(total_reward=row.parts[0]["total_reward"] + 1.0),
    "another fingerprint": other_fingerprint,
    "swapped tests": lambda row: row.parts.insert(0, row.parts.pop(1)),
    "a copied test": lambda row: row.parts[1].update(row.parts[0]),
    "a dropped test": dropped,
    "cut commands": lambda row: row.put(1, row.commands(1)[:300]),
    "longer commands": longer,
    "another seed": lambda row: row.protocol.update(seed=31),
    "another world": lambda row: row.protocol.update(task="arrows:cubes=2"),
    "commands that are no numbers": no_numbers,
    "no commands": lambda row: row.parts[1].update(commands="not base64!"),
    "a world in a file": lambda row: row.protocol.update(task="arrows:@/etc/passwd"),
    "a text for a flag": lambda row: row.parts[0].update(solved="yes"),
    "too many tests": lambda row: row.protocol.update(tests=10**9),
}


@pytest.mark.usefixtures("few_replays")
@pytest.mark.parametrize("mujoco", ["", "999.0.0"])
@pytest.mark.parametrize("forgery", FORGERIES)
def test_forged_rows_never_hold_whatever_mujoco_they_name(row: OpenMotions, forgery: str, mujoco: str) -> None:
    """The forger brings digest and figures up to date."""
    FORGERIES[forgery](row)
    found = row.judged(mujoco)
    assert found.row is None and found.verdict.complaint and "holds" not in str(found)
    assert found.is_refused or mujoco
    assert "\n" not in str(found) and "Traceback" not in str(found)


CHAOS_RAD = 0.05
"""A disturbance so large that the expert's commands do not end as before, in place of one like rounding."""


def test_a_test_that_depends_on_rounding_is_marked_by_its_author(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of the replays is not disturbed here, and agrees; that is not enough."""
    monkeypatch.setattr(motions, "DISTURBANCE", CHAOS_RAD)
    periods = motions.control_periods
    monkeypatch.setattr(
        motions, "control_periods", lambda env, commands, number: periods(env, commands, number or None)
    )
    folder = played(tmp_path, control="joint")
    read = read_motions(folder)
    assert [each.reproducible for each in read.motions] == [False] * TESTS
    assert [each.solved for each in read.motions] == [True, False, True, False]
    assert (read.vouched.successes, read.vouched.not_reproducible) == (0, TESTS)
    assert read.vouched.mean_return == -5.0
    monkeypatch.undo()
    (found,) = check(folder)
    assert "holds" in str(found) and "4 episodes played again, 4 not reproducible and counted as failed;" in str(found)
    page = write_board([found], tmp_path / "page").with_name(f"{folder.name}.html").read_text()
    assert page.count("no, so it counts as failed") == TESTS


def marked(found: Checked) -> MotionRow:
    """A row that holds with one test that is not reproducible."""
    assert isinstance(found.row, MotionRow)
    assert "4 episodes played again, 1 not reproducible and counted as failed;" in str(found)
    return found.row


def test_another_end_is_excused_only_if_disturbed_replays_vary(
    row: OpenMotions, monkeypatch: pytest.MonkeyPatch
) -> None:
    other_fingerprint(row, 2)  # of a test that the expert solves
    assert "refused: test 2: its fingerprint is" in str(row.judged())
    monkeypatch.setattr(motions, "DISTURBANCE", CHAOS_RAD)
    found = marked(row.check())
    assert [each.reproducible for each in found.motions] == [True, True, False, True]
    assert found.vouched.successes == row.card["vouched"]["successes"] - 1 == 1


@pytest.mark.usefixtures("few_replays")
def test_a_row_of_another_mujoco_is_not_vouched_for_and_never_holds(
    row: OpenMotions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether the card tells the truth, lies, or names a version that does not exist."""
    here = row.card["mujoco"]
    assert "holds" in str(row.judged(OTHER)), "another version alone is no reason"
    other_fingerprint(row)
    found = row.judged()
    assert found.row is None
    assert str(found) == (
        f"{row.folder.name}: not vouched: made with MuJoCo {OTHER}, checked with {here}, where it does not play again; "
        f"check it with {OTHER} (pip install mujoco=={OTHER})."
    )
    page = write_board([found], tmp_path / "page")
    assert "0 of 1 rows hold" in page.read_text() and not page.with_name(f"{row.folder.name}.html").exists()
    with pytest.raises(CheckFailedError, match="0 of 1 rows are refused, and 1 cannot be vouched for with this MuJoCo"):
        board(action="check", path=row.folder, out=tmp_path, closes=None, tests=1, secret=tmp_path, round=None)
    assert "not vouched: made with" in capsys.readouterr().out
    monkeypatch.setattr("imagine_bench_board.check.installed_mujoco", lambda: OTHER)
    found = row.check()
    assert found.is_refused and ": refused: test 1: its fingerprint is" in str(found), "as before, with its version"


@pytest.mark.usefixtures("few_replays")
@pytest.mark.parametrize(("total_reward", "least"), [(50.0, -5.0), (-40.0, -40.0)])
def test_a_marked_test_has_failed_and_may_end_otherwise(row: OpenMotions, total_reward: float, least: float) -> None:
    """With the MuJoCo of the card the same row is refused. Nobody gains: a policy that does nothing has 0, not -5."""
    honest = read_motions(row.folder).vouched
    row.parts[1] |= {"solved": True, "total_reward": total_reward, "reproducible": False}
    assert ": refused: test 1: its total reward is" in str(row.judged())
    found = marked(row.judged(OTHER))
    assert found.vouched.successes == honest.successes
    assert found.vouched.mean_return == honest.mean_return + least / TESTS, "test 1 had a return of 0"
    FORGERIES["cut commands"](row)
    assert marked(row.judged()).vouched.mean_return == honest.mean_return + least / TESTS
    row.parts[1]["reproducible"] = True
    assert ": not vouched: made with" in str(row.judged()), "a test that is not marked must end with its commands"


def test_the_return_of_a_test_that_ends_otherwise_is_the_lower_one(
    row: OpenMotions, monkeypatch: pytest.MonkeyPatch
) -> None:
    replayed = motions.replayed

    def worse(env: MotionEnv, seed: int, commands: Floats32) -> PlayedMotion | None:
        found = replayed(env, seed, commands)
        return found and dataclasses.replace(found, total_reward=found.total_reward - 40.0)

    for part in row.parts:
        part["reproducible"] = False
    monkeypatch.setattr(motions, "replayed", worse)
    found = row.judged(OTHER).row
    assert isinstance(found, MotionRow)
    assert [each.total_reward for each in found.motions] == [part["total_reward"] - 40.0 for part in row.parts]


NO_VERSION = "and no version such as 3.17.0."


@pytest.mark.parametrize(
    ("mujoco", "figures", "sentence"),
    [
        *((version, {}, NO_VERSION) for version in ("4.0", "3.017.0", "4.0.0; rm -r .", "4.0.0\n", "v4.0.0", None)),
        (OTHER, {"successes": 3}, ": refused: successes is 2, and 3 was kept."),
        (OTHER, {"faults": False}, "faults was given False; it takes a whole number."),
    ],
)
def test_what_needs_no_replay_is_refused_whatever_mujoco_made_it(
    row: OpenMotions, mujoco: str | None, figures: dict[str, object], sentence: str
) -> None:
    row.card["mujoco"] = mujoco
    row.card["vouched"] |= figures
    found = row.check()
    assert found.is_refused and sentence in str(found)


def test_a_copied_row_is_said_to_be_one(row: OpenMotions) -> None:
    shutil.copytree(row.folder, row.folder.with_name("z-copy"))
    first, second = check(row.folder.parents[1])
    assert "another player" not in str(first)
    assert str(second).endswith(f", whether it is another player than that of {row.folder.name}")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"task": "pick_place", "tests": 104}, "tests is 104; a row holds 103 tests of pick_place, however long"),
        ({"tests": 0}, "give 1 to 1,000 tests and a seed"),
        ({"control": "twits"}, "twits"),
    ],
)
def test_wrong_values_are_one_error(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ImagineBenchError, match=sentence):
        MotionTests(**{"task": WORLD, "observation": "proprio", **options})
