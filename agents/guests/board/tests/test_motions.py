"""Rows of continuous control: tests are recorded by any control, played again by joints, and forgeries are refused."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench_board import motions
from imagine_bench_board.check import NOT_VOUCHED, check
from imagine_bench_board.commands import board
from imagine_bench_board.motion_rows import Motion, MotionRow, read_motions
from imagine_bench_board.motions import SLACK_PERIODS, MotionTests
from imagine_bench_board.page import write_board
from imagine_bench_board.rows import CARD, EPISODES, LONGEST

from imagine_bench.arrays import Floats32
from imagine_bench.errors import CheckFailedError, InvalidValueError, UnknownNameError

WORLD = "arrows:cubes=1"
TESTS = 4


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


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return played(tmp_path_factory.mktemp("board") / "rows", control="joint")


@pytest.fixture
def row(honest: Path, tmp_path: Path) -> Path:
    return shutil.copytree(honest, tmp_path / "rows" / honest.name)


def test_an_honest_row_holds_and_says_what_happened(row: Path, tmp_path: Path) -> None:
    read = read_motions(row)
    assert [each.solved for each in read.motions] == [True, False, True, False]
    assert read.vouched.successes == 2 and read.vouched.faults == 0
    assert all(each.reproducible for each in read.motions)
    assert [each.periods for each in read.motions][1::2] == [750, 750]  # 3 s for each of ten macro-actions
    (found,) = check(row.parents[1] / "rows" / row.name)
    assert str(found) == (
        f"{row.name}: holds in {WORLD}, continuous control at 25 Hz, clean; open starts; 4 episodes played again; "
        f"not vouched: {', '.join(NOT_VOUCHED)}"
    )
    page = write_board([found], tmp_path / "page").read_text()
    assert "continuous control at 25 Hz" in page
    assert page.count(f'href="{row.name}.html#tests"') == 5, "each number that is vouched for leads to its episodes"
    assert "2 of 4 tests solved" in (tmp_path / "page" / f"{row.name}.html").read_text()


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
    written = env.write(tmp_path, "whole", agent="nobody")
    assert len(read_motions(written).claimed.command) == LONGEST, "a long command is cut"
    assert [each.periods for each in read_motions(written).motions] == [750]
    with pytest.raises(InvalidValueError, match="exists; remove it, or give another name"):
        env.write(tmp_path, "whole", agent="nobody")


def test_a_library_s_own_loop_plays_the_tests(tmp_path: Path) -> None:
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")

    class Still:
        def predict(self, observation: Any, state: Any = None, **more: Any) -> tuple[Any, None]:
            return np.zeros((len(observation), 7), np.float32), None

    env = MotionTests(WORLD, observation="proprio", tests=2, seed=3)
    with pytest.warns(UserWarning, match="not wrapped with a ``Monitor``"):
        mean, _ = evaluation.evaluate_policy(Still(), env, n_eval_episodes=2)
    assert mean == 0.0
    (found,) = check(env.write(tmp_path, "still", agent="still"))
    assert found.verdict.episodes == 2 and not found.verdict.complaint


def commands_of(part: dict[str, Any]) -> Any:
    return np.frombuffer(base64.b64decode(part["commands"]), "<f4").reshape(-1, 8).copy()


def put(part: dict[str, Any], commands: Any) -> None:
    part["commands"] = base64.b64encode(commands.astype("<f4").tobytes()).decode()


def solved_everywhere(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[1] |= {"solved": True, "total_reward": 50.0}


def dearer(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[0]["total_reward"] += 1.0


def other_fingerprint(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[1]["fingerprint"] ^= 1


def swapped(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[0], parts[1] = parts[1], parts[0]


def copied(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[1] = dict(parts[0])


def dropped(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    del parts[1]
    card["protocol"]["tests"] -= 1


def cut(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    put(parts[1], commands_of(parts[1])[:300])


def longer(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    commands = commands_of(parts[0])
    put(parts[0], np.concatenate([commands, np.repeat(commands[-1:], SLACK_PERIODS + 1, axis=0)]))


def another_seed(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    card["protocol"]["seed"] += 1


def another_world(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    card["protocol"]["task"] = "arrows:cubes=2"


def no_numbers(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    commands = commands_of(parts[1])
    commands[5, 3] = np.nan
    put(parts[1], commands)


def no_commands(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[1]["commands"] = "not base64!"


def a_file_s_world(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    card["protocol"]["task"] = "arrows:@/etc/passwd"


def no_flag(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    parts[0]["solved"] = "yes"


def too_many(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    card["protocol"]["tests"] = 10**9


def hidden(card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    """A failure said to be a success that depends on rounding."""
    solved_everywhere(card, parts)
    parts[1]["reproducible"] = False


FORGERIES = [
    solved_everywhere, dearer, other_fingerprint, swapped, copied, dropped, cut, longer, another_seed, another_world,
    no_numbers, no_commands, a_file_s_world, no_flag, too_many, hidden,
]  # fmt: skip


def seal(row: Path, card: dict[str, Any], parts: list[dict[str, Any]]) -> None:
    """Write a row with digest and figures brought up to date."""
    content = json.dumps(parts).encode()
    card["episodes_sha256"] = hashlib.sha256(content).hexdigest()
    sure = [part for part in parts if part["reproducible"]]
    failed = [min(part["total_reward"], -5.0) for part in parts if not part["reproducible"]]
    card["vouched"] = {
        "successes": sum(part["solved"] is True for part in sure),
        "faults": sum(part["fault"] for part in sure),
        "mean_return": float(np.mean([part["total_reward"] for part in sure] + failed)),
        "mean_periods": float(np.mean([len(part["commands"]) * 3 // 4 // 32 for part in parts])),
        "not_reproducible": len(failed),
    }
    (row / EPISODES).write_bytes(content)
    (row / CARD).write_text(json.dumps(card))


@pytest.mark.parametrize("forgery", FORGERIES)
def test_forged_rows_are_refused_in_one_line(
    row: Path, forgery: Callable[[dict[str, Any], list[dict[str, Any]]], None]
) -> None:
    """The forger brings digest and figures up to date."""
    card = json.loads((row / CARD).read_text())
    parts = json.loads((row / EPISODES).read_text())
    forgery(card, parts)
    seal(row, card, parts)
    (found,) = check(row)
    assert found.row is None and found.verdict.complaint
    assert "\n" not in str(found) and "Traceback" not in str(found)


def test_a_row_sealed_again_without_a_change_holds(row: Path) -> None:
    """So the refusals above are for the forged parts."""
    seal(row, json.loads((row / CARD).read_text()), json.loads((row / EPISODES).read_text()))
    assert "holds" in str(check(row)[0])


CHAOS_RAD = 0.05
"""A disturbance so large that the expert's commands do not end as before, in place of one like rounding."""


def test_a_test_that_depends_on_rounding_is_marked_by_its_author(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of the replays is not disturbed here, and agrees; that is not enough."""
    monkeypatch.setattr(motions, "DISTURBANCE", CHAOS_RAD)
    periods = motions._periods
    monkeypatch.setattr(motions, "_periods", lambda env, commands, number: periods(env, commands, number or None))
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


def test_a_test_that_ends_in_another_way_is_excused_only_if_disturbed_replays_do_so_too(
    row: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = json.loads((row / CARD).read_text())
    parts = json.loads((row / EPISODES).read_text())
    other_fingerprint(card, parts[1:])  # test 2, which the expert solves
    seal(row, card, parts)
    (found,) = check(row)
    assert "refused: test 2: its fingerprint is" in str(found)
    monkeypatch.setattr(motions, "DISTURBANCE", CHAOS_RAD)
    (found,) = check(row)
    assert "4 episodes played again, 1 not reproducible and counted as failed;" in str(found)
    assert isinstance(found.row, MotionRow)
    assert [each.reproducible for each in found.row.motions] == [True, True, False, True]
    assert found.row.vouched.successes == card["vouched"]["successes"] - 1 == 1


@pytest.mark.parametrize("version", ["4.0.0", "3.16.0", "3.17.1", "999.0.0"])
def test_a_row_of_another_mujoco_is_not_vouched_for_and_never_holds(
    row: Path, version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whether the card tells the truth, lies, or names a version that does not exist."""
    card = json.loads((row / CARD).read_text())
    parts = json.loads((row / EPISODES).read_text())
    here = card["mujoco"]
    seal(row, {**card, "mujoco": version}, parts)
    assert "holds" in str(check(row)[0]), "another version alone is no reason"
    other_fingerprint(card, parts)
    seal(row, {**card, "mujoco": version}, parts)
    (found,) = check(row)
    assert found.row is None
    assert str(found) == (
        f"{row.name}: not vouched: made with MuJoCo {version}, checked with {here}, where it does not play again; "
        f"check it with {version} (pip install mujoco=={version})."
    )
    page = write_board([found], tmp_path / "page")
    assert "0 of 1 rows hold" in page.read_text() and not page.with_name(f"{row.name}.html").exists()
    with pytest.raises(CheckFailedError, match="0 of 1 rows are refused, and 1 cannot be vouched for with this MuJoCo"):
        board(action="check", path=row, out=tmp_path, closes=None, tests=1, secret=tmp_path, round=None)
    assert "not vouched: made with" in capsys.readouterr().out
    monkeypatch.setattr("imagine_bench_board.check.installed_mujoco", lambda: version)
    (found,) = check(row)
    assert found.is_refused and ": refused: test 1: its fingerprint is" in str(found), "as before, with its version"


@pytest.mark.parametrize("version", ["4.0.0", "999.0.0"])
@pytest.mark.parametrize("forgery", [each for each in FORGERIES if each is not hidden])
def test_a_forger_gains_nothing_by_naming_another_mujoco(
    row: Path, forgery: Callable[[dict[str, Any], list[dict[str, Any]]], None], version: str
) -> None:
    card = json.loads((row / CARD).read_text()) | {"mujoco": version}
    parts = json.loads((row / EPISODES).read_text())
    forgery(card, parts)
    seal(row, card, parts)
    (found,) = check(row)
    assert found.row is None and "holds" not in str(found)


@pytest.mark.parametrize(("total_reward", "least"), [(50.0, -5.0), (-40.0, -40.0)])
def test_a_marked_test_may_end_otherwise_with_another_mujoco_and_has_failed(
    row: Path, total_reward: float, least: float
) -> None:
    """With the MuJoCo of the card the same row is refused. Nobody gains: a policy that does nothing has 0, not -5."""
    card = json.loads((row / CARD).read_text())
    parts = json.loads((row / EPISODES).read_text())
    honest = read_motions(row).vouched
    hidden(card, parts)
    parts[1]["total_reward"] = total_reward
    seal(row, card, parts)
    assert ": refused: test 1: its total reward is" in str(check(row)[0])
    seal(row, card | {"mujoco": "4.0.0"}, parts)
    (found,) = check(row)
    assert isinstance(found.row, MotionRow) and "1 not reproducible and counted as failed" in str(found)
    assert found.row.vouched.successes == honest.successes
    assert found.row.vouched.mean_return == honest.mean_return + least / TESTS, "test 1 had a return of 0"
    cut(card, parts)
    seal(row, card | {"mujoco": "4.0.0"}, parts)
    (found,) = check(row)
    assert isinstance(found.row, MotionRow) and "1 not reproducible and counted as failed" in str(found)
    assert found.row.vouched.mean_return == honest.mean_return + least / TESTS
    parts[1]["reproducible"] = True
    seal(row, card | {"mujoco": "4.0.0"}, parts)
    assert ": not vouched: made with" in str(check(row)[0]), "a test that is not marked must end with its commands"


def test_the_return_of_a_test_that_ends_otherwise_is_the_lower_one(row: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played = motions._played

    def worse(env: MotionEnv, seed: int, commands: Floats32) -> Motion | None:
        found = played(env, seed, commands)
        return found and dataclasses.replace(found, total_reward=found.total_reward - 40.0)

    card = json.loads((row / CARD).read_text()) | {"mujoco": "4.0.0"}
    parts = json.loads((row / EPISODES).read_text())
    for part in parts:
        part["reproducible"] = False
    seal(row, card, parts)
    monkeypatch.setattr(motions, "_played", worse)
    (found,) = check(row)
    assert isinstance(found.row, MotionRow)
    assert [each.total_reward for each in found.row.motions] == [each["total_reward"] - 40.0 for each in parts]


def test_what_needs_no_replay_is_refused_whatever_mujoco_made_it(row: Path) -> None:
    card = json.loads((row / CARD).read_text()) | {"mujoco": "4.0.0"}
    card["vouched"]["successes"] += 1
    (row / CARD).write_text(json.dumps(card))
    assert ": refused: successes is 2, and 3 was kept." in str(check(row)[0])


@pytest.mark.parametrize(
    "version", ["", "4", "4.0", "3.017.0", "3.17.0.0", "4.0.0; rm -r .", "4.0.0\n", "v4.0.0", None]
)
def test_a_version_is_written_as_pip_writes_it(row: Path, version: str | None) -> None:
    card = json.loads((row / CARD).read_text()) | {"mujoco": version}
    (row / CARD).write_text(json.dumps(card))
    (found,) = check(row)
    assert found.is_refused and "and no version such as 3.17.0." in str(found)


def test_a_copied_row_is_said_to_be_one(row: Path) -> None:
    shutil.copytree(row, row.with_name("z-copy"))
    first, second = check(row.parents[1])
    assert "another player" not in str(first)
    assert str(second).endswith(f", whether it is another player than that of {row.name}")


@pytest.mark.parametrize("value", ["0", False])
def test_a_figure_of_another_type_is_named(row: Path, value: object) -> None:
    card = json.loads((row / CARD).read_text())
    card["vouched"]["faults"] = value
    (row / CARD).write_text(json.dumps(card))
    (found,) = check(row)
    assert f"faults was given {value!r}; it takes a whole number." in found.verdict.complaint


def test_one_world_in_other_words_stands_in_the_same_table(row: Path) -> None:
    card = json.loads((row / CARD).read_text())
    card["protocol"] |= {"task": f"{WORLD},slip=0", "appearance": "light=0"}
    (row / CARD).write_text(json.dumps(card))
    assert read_motions(row).world == f"{WORLD}, continuous control at 25 Hz, clean"


def test_no_row_is_begun_that_its_file_could_not_hold(row: Path) -> None:
    commands = json.loads((row / EPISODES).read_text())[1]["commands"]
    assert len(commands) < 750 * 43
    assert MotionTests("pick_place", observation="proprio").protocol.tests == 100
    with pytest.raises(InvalidValueError, match="tests is 104; a row holds 103 tests of pick_place, however long"):
        MotionTests("pick_place", observation="proprio", tests=104)


def test_wrong_values_are_one_error() -> None:
    with pytest.raises(InvalidValueError, match="give 1 to 1,000 tests and a seed"):
        MotionTests(WORLD, tests=0)
    with pytest.raises(UnknownNameError, match="twits"):
        MotionTests(WORLD, control="twits")
