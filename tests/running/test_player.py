"""Episodes of a person are kept as a run: nothing is lost, left out or played twice, and a bench's commands take it."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_runs import Inline, do, made_bench, measured

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import BusyError, ImagineBenchError, InvalidValueError
from imagine_bench.exact.certificate import certificate
from imagine_bench.judge.verify import verify_runs
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.running.player import FinishedError, PlayedRun, played_run, protocol_of_player
from imagine_bench.running.retraining import Retraining, train_again
from imagine_bench.store import run_folder
from imagine_bench.store.files import write_json
from imagine_bench.store.loading import load_so_far, merge
from imagine_bench.tools import play
from imagine_bench.tools.audits import why_report

SPEC = registry.task("arrow_puzzle")


def wanted(name: str = "anna", **options: object) -> Protocol:
    values: dict[str, object] = {"tests": 4, "execution": "kinematic", **options}
    return protocol_of_player("arrow_puzzle", "person", name, **values)  # type: ignore[arg-type]


def like(bench: Path, **options: Any) -> Protocol:
    """As a bench has it."""
    return protocol_of_player(None, "person", "anna", like=bench, **options)


def lasting(macrostate: tuple[int, ...], number: int, moves: int) -> int:
    """In every second episode the best macro-action. In the others two that end nothing, then one that loses."""
    if number % 2:
        return SPEC.rules.optimal_action(macrostate)
    outcomes = [SPEC.rules.outcomes(macrostate, action)[0] for action in range(SPEC.n_actions)]
    quiet = [action for action, each in enumerate(outcomes) if not each.terminated]
    losing = [action for action, each in enumerate(outcomes) if each.terminated and not each.success]
    return (quiet if moves < 2 else [*losing, *quiet])[0]


def play_one(run: PlayedRun, most: int = 99) -> None:
    """Play the next episode, or as many macro-actions of it."""
    _, info = run.reset()
    over = False
    while not over and most:
        macrostate = tuple(np.asarray(info["macrostate"]).tolist())
        _, _, terminated, truncated, info = run.step(lasting(macrostate, run.number, run.moves))
        over = terminated or truncated
        most -= 1


def play_all(protocol: Protocol, root: Path) -> Path:
    with played_run(protocol, root) as run:
        while not run.is_done:
            play_one(run)
        return run.folder


def content(folder: Path) -> list[dict[str, Any]]:
    return measured(run_folder.load_run(folder))


@pytest.fixture(scope="module")
def anna(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return play_all(wanted(), tmp_path_factory.mktemp("runs"))


def test_a_players_episodes_begin_where_those_of_agents_do(tmp_path: Path) -> None:
    protocol = wanted(training=2, tests=2, seed=3)
    with played_run(protocol, tmp_path, camera="far") as run:
        assert run.unwrapped.camera_for_people == "far"  # type: ignore[attr-defined]
        while not run.is_done:
            play_one(run)
    result = run_folder.load_run(run.folder)
    agents = do(tmp_path / "agent", "table", 3, seeds=(3,), budgets=(2,), evaluation_episodes=2)
    for mine, theirs in ((result.training, agents.training), (result.checkpoints[0].kept, agents.checkpoints[0].kept)):
        assert mine is not None and theirs is not None and mine.starts.tolist() == theirs.starts.tolist()
    assert result.seed == 3 and result.checkpoints[0].env_steps == result.training_length.sum() > 2
    assert not (run.folder / "moves.txt").exists()


def test_a_persons_run_is_verified_explained_and_reported(anna: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs" / anna.parents[1].name
    shutil.copytree(anna.parents[1], folder)
    row = run_folder.load_run(anna).checkpoints[0]
    assert (row.test_episodes, row.solved, row.env_steps) == (4, "0101", 0)
    assert not any(verdict.unshown for verdict in verify_runs(folder))
    said = why_report(folder, root=tmp_path, task=None, encoder=None)
    assert "2 of 4" in said and "decision" in said
    assert main(["report", str(folder)]) == 0
    page = (folder / "report" / "index.html").read_text()
    assert "person:anna" in page and "A person at the keyboard" in page
    assert main(["verify", str(folder)]) == 0
    (again,) = train_again(folder, Retraining(runs=1, nonce="", launcher=Inline()))
    assert not again.complaint and "cannot be trained here" in again.unshown[0]


@pytest.mark.parametrize("training", [None, 3])
def test_an_interrupted_run_ends_in_the_same_bits(training: int | None, tmp_path: Path) -> None:
    """It is left in the middle of an episode, at an end before the next begins, and killed at any moment."""
    chosen = wanted(training=training)
    whole = play_all(chosen, tmp_path / "whole")
    root = tmp_path / "parts"
    with played_run(chosen, root) as run:
        play_one(run, most=2)
    with played_run(chosen, root) as run:
        assert run.words == (f"training episode 1 of {training}" if training else "test 1 of 4") and run.moves == 0
        run.reset()
        assert run.moves == 2, "the episode that was left goes on"
        play_one(run)
        shutil.copytree(root, tmp_path / "killed")  # as a kill would leave it: over, and the next one not begun
    with played_run(chosen, tmp_path / "killed") as run:
        run.reset()
        assert (run.number, run.moves) == (1, 0)
        assert run.words == (f"training episode 2 of {training}" if training else "test 2 of 4")
        play_one(run, most=1)
    parts = [play_all(chosen, each) for each in (root, tmp_path / "killed")]
    with played_run(chosen, root) as run:
        assert run.words == f"all {4 + (training or 0)} episodes are played"
    assert content(parts[0]) == content(parts[1]) == content(whole)
    verdicts = verify_runs(parts[1].parents[1])
    assert not any(verdict.complaint for verdict in verdicts)
    assert verdicts[0].episodes == (7 if training else 4 * len(chosen.budgets))


def test_a_line_that_was_cut_off_is_no_move(tmp_path: Path) -> None:
    with played_run(wanted(), tmp_path) as run:
        play_one(run, most=2)
        moves = run.folder / "moves.txt"
    before = moves.read_text()
    assert before.count("\n") == 2
    moves.write_text(f"{before}0 5")
    with played_run(wanted(), tmp_path) as run:
        run.reset()
        assert run.moves == 2
        run.step(5)
    assert moves.read_text() == f"{before}0 5\n"


def test_a_kill_before_the_mark_loses_nothing(tmp_path: Path) -> None:
    folder = play_all(wanted(), tmp_path)
    before = content(folder)
    (folder / "DONE").unlink()
    (folder / "metrics.csv").unlink()
    with played_run(wanted(), tmp_path) as run:
        assert run.is_done
    assert before == content(folder)


def test_one_process_at_a_time_and_no_episode_more(tmp_path: Path) -> None:
    with played_run(wanted(), tmp_path) as run:
        with pytest.raises(BusyError, match="is in use by process"), played_run(wanted(), tmp_path):
            pass
        first = run.reset()[1]["macrostate"].tolist()
        assert run.reset(seed=9)[1]["macrostate"].tolist() == first, "nobody draws another start"
        play_one(run)
        with pytest.raises(InvalidValueError, match="No episode goes on; reset begins the next one"):
            run.step(0)
        while not run.is_done:
            play_one(run)
        with pytest.raises(FinishedError, match="person:anna: all 4 episodes are played; give another name"):
            run.reset()


def test_an_appearance_that_is_asked_for_is_that_of_the_tests(tmp_path: Path) -> None:
    there = protocol("arrow_puzzle", "smoke", agents=("random",), test_appearance="strong")
    write_json(tmp_path / "protocol.json", there.as_dict())
    for asked, found in ((None, "strong"), ("mild", "mild")):
        wanted = like(tmp_path, appearance=asked)
        assert wanted.appearance_in_tests == found


def test_no_player_trains_otherwise_than_it_is_tested(tmp_path: Path) -> None:
    assert wanted(appearance="patched").appearance_in_tests == "photo_held_out"
    with pytest.raises(InvalidValueError, match=r"The appearance patched .* trains otherwise than it tests"):
        wanted(appearance="patched", training=1)
    for change in ({"split": "plan_length=2"}, {"queries": 1}, {"test_appearance": "mild"}):
        there = protocol("arrow_puzzle", "smoke", **{"agents": ("factored:given",), **change})
        write_json(tmp_path / "protocol.json", there.as_dict())
        assert like(tmp_path)
        with pytest.raises(InvalidValueError, match=f"{tmp_path} shows more than frames, or trains otherwise"):
            like(tmp_path, training=1)


def test_a_person_is_told_the_chance_of_the_starts_of_the_tests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = protocol("arrow_puzzle", "smoke", agents=("random",), split="plan_length=2", execution="kinematic")
    write_json(tmp_path / "protocol.json", there.as_dict())
    cameras: list[str] = []
    keyboard = lambda game, **options: cameras.append(game.unwrapped.camera_for_people)  # noqa: E731
    monkeypatch.setattr(play, "keyboard_player", lambda: keyboard)
    said = play.keep_playing(like(tmp_path), tmp_path / "runs", camera="far")
    assert cameras == ["far"]
    chance = certificate(there.spec(testing=True)).chance_level
    assert f"chance {chance:.1%}, optimum 100.0%" in said and f"{SPEC.facts().chance_level:.1%}" not in said


def test_nothing_of_the_learners_of_a_bench_is_said_of_a_player(tmp_path: Path) -> None:
    plain = protocol("arrow_puzzle", "smoke", agents=("dqn",))
    made = {"encoder": "a@0123456789ab", "codes": "c@ba9876543210", "code": (("dqn", "1"),), "settings_digest": "one"}
    players = []
    for changes in ({}, made, {"agents": ("dqn", "oracle"), "few_seeds": (("oracle", 0),), "seeds": (0, 1)}):
        there = dataclasses.replace(plain, **changes)
        write_json(tmp_path / "protocol.json", there.as_dict())
        players.append(like(tmp_path))
    assert players[0] == players[1] == players[2]


def test_a_person_stands_in_the_table_of_a_bench(tmp_path: Path) -> None:
    """Its tests are the bench's first ones, and the bench's row with as many tests is that of its first ones."""
    planned = protocol(
        "arrow_puzzle", "smoke", agents=("random", "oracle"), seeds=(3, 5), evaluation_episodes=9,
        execution="kinematic", overrides=(("controller.discount", 0.9),),
    )  # fmt: skip
    there = made_bench(planned, tmp_path)
    played = like(there.folder, tests=4)
    mine = load_so_far(play_all(played, tmp_path).parents[1])
    table = merge([there, mine], tmp_path)
    assert table.protocol.evaluation_episodes == 4
    both = ("random", "oracle")
    runs = [(agent, 3) for agent in (*both, "person:anna")] + [(agent, 5) for agent in both]
    assert [(run.agent, run.seed) for run in table.runs] == runs
    whole = {(run.agent, run.seed): run.checkpoints[0] for run in there.runs}
    anna = table.runs[2].checkpoints[0]
    for run in table.runs[:2]:
        row = run.checkpoints[0]
        before = whole[run.agent, run.seed]
        lengths = before.kept.lengths[:4]
        assert (row.solved, row.successes) == (before.solved[:4], before.solved[:4].count("1"))
        assert (row.mean_return, row.mean_length) == pytest.approx((before.kept.returns[:4].mean(), lengths.mean()))
        assert row.kept.actions.tolist() == before.kept.actions[: lengths.sum()].tolist()
        assert row.kept.starts.tolist() == anna.kept.starts.tolist()
    without = dataclasses.replace(there.runs[0].checkpoints[0], kept=None)
    with pytest.raises(ImagineBenchError, match="are not kept, so the first ones cannot be taken alone"):
        without.of_first(4)
