"""Runs trained again: forgeries that a replay cannot show are found, and parts that were not compared are said first,
with exit code 3.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forger import change_checkpoint, forged, mend, rewrite, rewrite_protocol, share_weights
from small_runs import Inline, small

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.protocols.control import context_of
from imagine_bench.protocols.data import RunSpec
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.evaluation import EvaluationCounts, play_test_episode, replay
from imagine_bench.running.retraining import Retraining, chance_to_find, drawn
from imagine_bench.running.run_state import environments
from imagine_bench.seeding import episode_seed
from imagine_bench.store.files import read_sealed, sealed
from imagine_bench.store.run_folder import load_newest, load_run, save_snapshot
from imagine_bench.tools.audits import conclusion, verify, what_is_shown

Forge = Callable[[Path], object]


def planned(root: Path, **changes: Any) -> Path:
    """A bench as a command plans it, without a report."""
    few: dict[str, Any] = {"agents": ("table",), "seeds": (0, 1), "budgets": (4, 9), "evaluation_episodes": 8}
    how: dict[str, Any] = {"execution": "kinematic", "open_loop_starts": 0, "recorded_episodes": 0}
    wanted, paths = plan("arrow_puzzle", "smoke", **{**few, **how, **changes})
    return bench(wanted, paths, root=root, launcher=Inline()).folder


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of two seeds of a learner, without a report."""
    return planned(tmp_path_factory.mktemp("pair"))


def again(nonce: str = "") -> Retraining:
    return Retraining(runs=1, nonce=nonce, launcher=Inline())


def test_an_honest_run_repeats_to_the_bit_and_each_nonce_draws_its_own(pair: Path) -> None:
    drawn_seeds = {seed for nonce in "abcdefgh" for _, seed in drawn(small(seeds=(0, 1)), 1, nonce)}
    assert drawn_seeds == {0, 1} and drawn(small(seeds=(0, 1)), 1, "a") == drawn(small(seeds=(0, 1)), 1, "a")
    found = verify(pair, again("a"))
    assert not found[-1].complaint and "repeats to the bit" in str(found[-1])
    assert "--nonce a" in what_is_shown(pair, found, again("a"))


def test_runs_that_do_not_hold_are_not_said_to_be_trained_again(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = forged(pair, tmp_path, share_weights)
    assert main(["verify", str(folder), "--train", "1"]) == 1
    said = capsys.readouterr().out
    assert "Training again: no run was" in said and "Trained again" not in said and "Chance" not in said


def test_the_chance_to_find_a_forged_run_is_that_of_drawing_one() -> None:
    wanted = small(seeds=(0, 1, 2, 3, 4))
    draws = [{seed for _, seed in drawn(wanted, 2, str(nonce))} for nonce in range(2000)]
    for n_forged in (1, 2, 3, 4):
        found = np.mean([bool(seeds & {*range(n_forged)}) for seeds in draws])
        assert found == pytest.approx(chance_to_find(5, n_forged, 2), abs=0.05)


def play_as_oracle(folder: Path, tests: int = 8) -> None:
    """The first tests of every run are played by the oracle; all that follows from the macro-actions is mended."""
    with environments(small(), observation="state") as (_, env):
        oracle = registry.make_agent("oracle", context_of(RunSpec(protocol=small(), agent="oracle", seed=0)))
        for seed in (0, 1):
            run = load_run(folder / "table" / f"seed_{seed}")
            rows = []
            for row in run.checkpoints:
                assert row.kept is not None
                counts = EvaluationCounts()
                for test in range(8):
                    at = episode_seed("evaluation", 0, test)
                    own = replay(env, at, row.kept.actions_of(test))[0]
                    counts.add(play_test_episode(env, oracle, seed=at, privileged=True) if test < tests else own)
                rows.append(dataclasses.replace(row, kept=counts.kept(), **counts.figures()))
            rewrite(run.folder, rows)


def invent_prices(folder: Path, name: str) -> None:
    for seed in (0, 1):
        run = load_run(folder / "table" / f"seed_{seed}")
        *rows, last = run.checkpoints
        rewrite(run.folder, [*rows, dataclasses.replace(last, **{name: 99.0 + seed})])


@pytest.mark.parametrize(
    ("forge", "found"),
    [
        (play_as_oracle, "does not repeat"),
        (partial(invent_prices, name="train_cpu_s"), "CPU s of training were kept"),
        (partial(invent_prices, name="eval_cpu_s"), "CPU s of tests were kept"),
    ],
)
def test_what_a_replay_cannot_show_training_again_does(
    pair: Path, tmp_path: Path, forge: Callable[[Path], None], found: str
) -> None:
    folder = forged(pair, tmp_path, forge)
    *replayed, trained = verify(folder, again())
    assert not any(each.complaint for each in replayed) and found in trained.complaint


def change_sessions(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    sessions = read_sealed(folder / "sessions.json", "sessions")
    change(sessions)
    (folder / "sessions.json").write_text(json.dumps(sealed(sessions)))


def elsewhere(folder: Path) -> None:
    change_sessions(folder, lambda found: found["environment"]["machine"].update(cpu="another"))


def elsewhere_in_between(folder: Path) -> None:
    """Begun here, resumed on another processor, and ended here."""
    session = {"changed": {"cpu": ["this", "another"]}, "wall_s": 0.0}
    change_sessions(folder, lambda found: found["sessions"].insert(0, {**found["sessions"][0], **session}))


def lose_weights(folder: Path) -> None:
    elsewhere_in_between(folder)
    for seed in (0, 1):
        run = folder / "table" / f"seed_{seed}"
        snapshot = load_newest(run / "checkpoints")
        assert snapshot is not None
        other = {name: array + 1 + seed for name, array in snapshot.agent.arrays.items()}
        agent = dataclasses.replace(snapshot.agent, arrays=other)
        save_snapshot(run / "checkpoints", dataclasses.replace(snapshot, agent=agent))
        mend(run)


def test_what_was_made_on_another_processor_holds_in_part(pair: Path, tmp_path: Path) -> None:
    found = verify(forged(pair, tmp_path, lose_weights), again())
    error = conclusion(found)
    assert error is not None and error.exit_code == 3
    assert str(error).startswith("Holds as far as it was compared. Not compared: bits, for its cpu is said to have")
    assert "its first 9 training episodes repeat" in str(found[-1])


def test_on_another_processor_tests_repeat_where_training_does(pair: Path, tmp_path: Path) -> None:
    folder = forged(pair, tmp_path, elsewhere)
    play_as_oracle(folder, tests=2)
    *_, trained = verify(folder, again())
    assert "2 of 8 tests went otherwise, though training was the same" in trained.complaint


def test_on_another_processor_all_but_the_costs_may_hold(pair: Path, tmp_path: Path) -> None:
    found = verify(forged(pair, tmp_path, elsewhere), again())
    error = conclusion(found)
    assert error is not None and error.exit_code == 3 and "repeats to the bit" in str(found[-1])
    assert str(error).endswith("Not compared: CPU seconds, for its cpu is said to have been another.")


def test_another_commit_is_no_reason_for_other_costs(pair: Path, tmp_path: Path) -> None:
    folder = forged(pair, tmp_path, partial(invent_prices, name="train_cpu_s"))
    change_sessions(folder, lambda found: found["environment"].update(commit="f" * 40))
    assert "CPU s of training were kept" in verify(folder, again())[-1].complaint


@pytest.mark.parametrize(
    ("claim", "code", "first"),
    [
        (lambda folder: None, 0, "Holds."),
        (share_weights, 1, "Does not hold. 1 of 2 verdicts are complaints."),
        (
            lambda folder: change_checkpoint(folder / "table" / "seed_1", lambda values, _: values.update(before=7)),
            1,
            "Does not hold.",
        ),
        (
            lambda folder: change_sessions(folder, lambda found: found["certificate"].update(chance_level=0.5)),
            1,
            "Does not hold. 1 of 3 verdicts",
        ),
        (
            lambda folder: change_sessions(
                folder, lambda found: found["sessions"][0].update(command="imagine-bench bench x --seeds 0 1 2 --out y")
            ),
            1,
            "Does not hold. 1 of 3 verdicts",
        ),
        (
            lambda folder: change_sessions(
                folder, lambda found: found["sessions"][0].update(command="imagine-bench bench x --seeds 0-1 --out y")
            ),
            0,
            "Holds.",
        ),
    ],
)
def test_the_first_line_and_the_exit_code_say_what_was_found(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], claim: Forge, code: int, first: str
) -> None:
    assert main(["verify", str(forged(pair, tmp_path, claim))]) == code
    said = capsys.readouterr()
    assert said.out.startswith(first)
    assert bool(said.err) == bool(code)


@pytest.mark.parametrize("left", [(0,), (1,)])
def test_seeds_that_may_have_been_left_out_are_said(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], left: tuple[int, ...]
) -> None:
    """Seed 1 of 0 and 1 alone; and seed 0 alone of a preset of three seeds."""
    folder = forged(pair, tmp_path, lambda folder: None)
    for seed in {0, 1} - {*left}:
        shutil.rmtree(folder / "table" / f"seed_{seed}")
    preset = "quick" if left == (0,) else "smoke"
    folder = rewrite_protocol(folder, seeds=list(left), preset=preset)
    assert main(["verify", str(folder)]) == 3
    assert "Not compared: whether seeds were left out: it has " in capsys.readouterr().out.splitlines()[0]
