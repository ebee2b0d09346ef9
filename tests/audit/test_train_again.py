"""Runs trained again: forgeries that a replay cannot show are found, and parts that were not compared are said first,
with exit code 3.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import forging
import numpy as np
import pytest
from forger import forged, share_weights
from forging import OpenRun, mixed, rewrite_protocol
from small_runs import QUICK, Inline, made_bench, small, written

from imagine_bench.cli import exit_code as main
from imagine_bench.errors import IncompleteCheckError, InvalidValueError
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.control import plan_control
from imagine_bench.running.retraining import (
    SAME_EPISODES,
    Retraining,
    Verdict,
    chance_to_find,
    drawn,
    train_again,
)
from imagine_bench.seeding import TUNING_SEEDS
from imagine_bench.store.files import read_sealed, sealed
from imagine_bench.tools.audits import conclusion, verify, what_is_shown

Forge = Callable[[Path], object]


def again(nonce: str = "") -> Retraining:
    return Retraining(runs=1, nonce=nonce, launcher=Inline())


def trained(pair: Path, root: Path, *forge: Forge) -> str:
    """The complaint of training again about a forged bench, which playing again has none about."""
    folder = forged(pair, root, lambda folder: [each(folder) for each in forge])
    *replayed, last = verify(folder, again())
    assert not any(each.complaint for each in replayed)
    return last.complaint


def in_runs(change: Callable[[OpenRun], object]) -> Forge:
    """Both runs changed."""

    def forge(folder: Path) -> None:
        for seed in (0, 1):
            run = OpenRun.read(folder / "table" / f"seed_{seed}")
            change(run)
            run.write()

    return forge


def sessions(change: Callable[[dict[str, Any]], object]) -> Forge:
    """The record of a bench's sessions changed."""

    def forge(folder: Path) -> None:
        found = read_sealed(folder / "sessions.json", "sessions")
        change(found)
        (folder / "sessions.json").write_text(json.dumps(sealed(found)))

    return forge


def by_oracle(tests: int) -> Forge:
    """The first tests of every run are played by the oracle."""

    def change(run: OpenRun) -> None:
        oracle = forging.tests_by(forging.oracle())
        for row in (0, 1):
            run.set_tests(row, mixed([oracle] * tests + [run.tests(row)] * (8 - tests)))

    return in_runs(change)


def invented(name: str) -> Forge:
    return in_runs(lambda run: run.rows[-1].update({name: 99.0 + run.seed}))


elsewhere = sessions(lambda found: found["environment"]["machine"].update(cpu="another"))


def test_an_honest_run_repeats_to_the_bit(pair: Path) -> None:
    wanted = small(seeds=(0, 1))
    assert {seed for nonce in "abcdefgh" for _, seed in drawn(wanted, 1, nonce)} == {0, 1}
    assert drawn(wanted, 1, "a") == drawn(wanted, 1, "a")
    found = verify(pair, again("a"))
    assert not found[-1].complaint and "repeats to the bit" in str(found[-1])
    assert "--nonce a" in what_is_shown(pair, found, again("a"))


def test_the_chance_to_find_a_forgery_counts_an_agents_runs(tmp_path: Path) -> None:
    wanted = dataclasses.replace(small(agents=("table", "random")), seeds=(0, 1, 2, 3), few_seeds=(("random", 0),))
    folder = made_bench(wanted, tmp_path).folder
    said = what_is_shown(folder, [Verdict(what="one", of_training=True)], again("a")).splitlines()
    assert "Trained again: 1 runs, 1 of an agent's 1 or 1 of an agent's 4, drawn by --nonce a." in said
    assert str(Verdict(what="one", episodes=1200)) == "one: holds; 1,200 episodes played again"
    assert said[-2] == "Chance that a draw finds a forged run of an agent: 1 of 1 forged: 100.0 %."
    chances = said[-1].partition(" of an agent: ")[2]
    assert chances == "1 of 4 forged: 25.0 %; 2 of 4 forged: 50.0 %; 4 of 4 forged: 100.0 %."


def test_a_dataset_from_which_no_run_learned_is_refused(pair: Path, tmp_path: Path) -> None:
    superfluous = dataclasses.replace(again(), dataset=written(tmp_path / "set").folder)
    with pytest.raises(InvalidValueError, match=r"No run of .* learned from a dataset; leave --dataset out"):
        verify(pair, superfluous)


def test_runs_of_a_dataset_that_is_not_given_are_not_compared(tmp_path: Path) -> None:
    few: dict[str, Any] = {"agents": ("table", "random"), "appearance": "mild", "evaluation_episodes": 2, **QUICK}
    given = written(tmp_path / "set").folder
    folder = bench(*plan("arrow_puzzle", "smoke", dataset=given, **few), root=tmp_path, launcher=Inline()).folder
    *_, last, blind = found = verify(folder, again())
    assert not last.complaint and "it learned from the dataset" in last.unshown[0]
    assert "random" in blind.what and "repeats to the bit" in str(blind), "it learned nothing"
    assert isinstance(conclusion(found), IncompleteCheckError)
    assert "repeats to the bit" in str(verify(folder, dataclasses.replace(again(), dataset=given))[-1])
    other = dataclasses.replace(again(), dataset=written(tmp_path / "other", seed=9).folder)
    with pytest.raises(InvalidValueError, match="learned from mixed-6@"):
        verify(folder, other)


def through_encoder(pair: Path, root: Path, used: str) -> Path:
    """A bench whose one learner is said to have seen through an encoder."""
    whole = forged(pair, root)
    return rewrite_protocol(whole, agents=["dqn"], seeds=[0], encoder=used)


def test_a_missing_encoder_is_not_compared_and_a_damaged_one_a_complaint(
    pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Damaged in the cache, where its name is known, and as the file that is given."""
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path / "cache"))
    folder = through_encoder(pair, tmp_path, "mine@0123456789ab")
    (found,) = train_again(folder, again())
    assert not found.complaint and "through encoder mine@0123456789ab, which is not here" in found.unshown[0]
    for damaged in (tmp_path / "given.safetensors", tmp_path / "cache" / "encoders" / "looks" / "mine.safetensors"):
        damaged.parent.mkdir(parents=True, exist_ok=True)
        damaged.write_bytes(b"half an encoder")
        given = str(damaged) if damaged.parent == tmp_path else None
        (found,) = train_again(folder, dataclasses.replace(again(), encoder=given))
        assert found.complaint.startswith(f"it cannot be: {damaged} is not an encoder with a card")


def test_an_absent_agent_is_not_compared_and_one_that_fails_a_complaint(pair: Path, tmp_path: Path) -> None:
    """An agent of a script, a prefix without its argument, and an agent whose training ends in an error."""
    for agent, complaint, unshown in (
        ("of_a_script", "", "No agent 'of_a_script'"),
        ("person", "it cannot be: person alone is no name", ""),
        ("failing", "it cannot be: this agent breaks on purpose", ""),
    ):
        whole = forged(pair, tmp_path / agent)
        (found,) = train_again(rewrite_protocol(whole, agents=[agent], seeds=[1]), again())
        assert found.complaint.startswith(complaint) and bool(found.complaint) == bool(complaint)
        assert unshown in "".join(found.unshown)


def test_runs_that_do_not_hold_are_not_said_to_be_trained_again(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(forged(pair, tmp_path, share_weights)), "--train", "1"]) == 1
    said = capsys.readouterr().out
    assert "Training again: no run was" in said and "Trained again" not in said and "Chance" not in said


def test_the_chance_to_find_a_forged_run_is_that_of_drawing_one() -> None:
    wanted = small(seeds=(0, 1, 2, 3, 4))
    draws = [{seed for _, seed in drawn(wanted, 2, str(nonce))} for nonce in range(2000)]
    for n_forged in (1, 2, 3, 4):
        found = np.mean([bool(seeds & {*range(n_forged)}) for seeds in draws])
        assert found == pytest.approx(chance_to_find(5, n_forged, 2), abs=0.05)


def test_draws_of_agents_and_of_benches_are_independent() -> None:
    """So one run of each agent, even of equal seeds, is found as often as by draws that know nothing of each other."""
    wanted = small(agents=("table", "random", "oracle"), seeds=(0, 1, 2, 3, 4))
    other = dataclasses.replace(wanted, evaluation_episodes=7)
    nonces = [str(nonce) for nonce in range(1000)]
    draws = np.array([[seed for each in (wanted, other) for _, seed in drawn(each, 1, nonce)] for nonce in nonces])
    assert draws.shape == (1000, 6)
    for one, two in combinations(draws.T, 2):
        assert np.mean(one == two) == pytest.approx(1 / 5, abs=0.06)
    of_bench = draws[:, :3]
    assert np.mean((of_bench == 0).any(axis=1)) == pytest.approx(1 - (1 - chance_to_find(5, 1, 1)) ** 3, abs=0.06)


def test_an_episode_after_a_dataset_is_named_by_its_number_in_training(tmp_path: Path) -> None:
    """Where it is played again, and where it is trained again on another processor: six of a dataset come before.

    These do not count among the ten that must repeat there.
    """
    few = {"agents": ("table",), "seeds": (0,), "budgets": (12,), "evaluation_episodes": 2, **QUICK}
    given = written(tmp_path / "set")
    wanted, paths = plan_control("arrow_puzzle", "smoke", appearance="mild", dataset=given.folder, **few)
    honest = bench(wanted, paths, root=tmp_path / "honest", launcher=Inline()).folder

    def change(name: str) -> Forge:
        def forge(folder: Path) -> None:
            run = OpenRun.read(folder / "table" / "seed_0")
            fifth = int(run.arrays["training/lengths"][:4].sum()) if name == "actions" else 4
            run.arrays[f"training/{name}"][fifth] = (run.arrays[f"training/{name}"][fifth] + 1) % 6
            run.write()

        return forge

    for name, word in {"returns": "return", "starts": "start", "fingerprints": "fingerprint"}.items():
        first, *_ = verify(forged(honest, tmp_path / name, change(name)))
        assert first.complaint.startswith(f"training episode 10: the {word} is ")
    elsewhere(folder := forged(honest, tmp_path / "actions", change("actions")))
    (found,) = train_again(folder, dataclasses.replace(again(), dataset=given.folder))
    assert found.complaint.startswith("training episode 10 took other macro-actions")


def test_a_rounding_of_another_processor_may_decide_late_and_not_early(tmp_path: Path) -> None:
    honest = made_bench(small(budgets=(12,)), tmp_path).folder
    for episode, complaint in ((SAME_EPISODES - 1, "training episode 9 took other macro-actions"), (SAME_EPISODES, "")):
        elsewhere(folder := forged(honest, tmp_path / str(episode)))
        run = OpenRun.read(folder / "table" / "seed_0")
        first = run.arrays["training/lengths"][:episode].sum()
        run.arrays["training/actions"][first] = (run.arrays["training/actions"][first] + 1) % 6
        run.write()
        (found,) = train_again(folder, again())
        assert found.complaint.startswith(complaint) and bool(found.complaint) == bool(complaint)
    assert found.holds == "its first 10 training episodes repeat" and found.unshown[0].startswith("bits, for its cpu")


def test_what_a_replay_cannot_show_training_again_does(pair: Path, tmp_path: Path) -> None:
    """On another processor too where training repeats there; another commit is no reason for other costs."""
    another = sessions(lambda found: found["environment"].update(commit="f" * 40))
    for number, (found, *forge) in enumerate((
        ("does not repeat", by_oracle(8)),
        ("of the tests are let pass", elsewhere, by_oracle(8)),
        ("2 of 8 tests went otherwise, though training was the same", elsewhere, by_oracle(2)),
        ("CPU s of training were kept", invented("train_cpu_s")),
        ("CPU s of training were kept", invented("train_cpu_s"), another),
        ("CPU s of tests were kept", invented("eval_cpu_s")),
    )):  # fmt: skip
        assert found in trained(pair, tmp_path / str(number), *forge)
    assert not trained(pair, tmp_path / "one", elsewhere, by_oracle(1)), "1 of 8 tests may go otherwise there"


def test_cpu_seconds_that_are_far_too_small_are_found(
    pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the second that a run may always take more."""
    monkeypatch.setattr("imagine_bench.running.retraining.SAME_COST", (4.0, 0.0))
    less = in_runs(lambda run: [row.update(train_cpu_s=1e-6 * row["train_cpu_s"]) for row in run.rows])
    assert "0.0 CPU s of training were kept" in trained(pair, tmp_path, less)


def test_what_was_made_on_another_processor_holds_in_part(pair: Path, tmp_path: Path) -> None:
    """Begun here, resumed on another processor, and ended here, with other weights in the end."""
    session = {"changed": {"cpu": ["this", "another"]}, "wall_s": 0.0}
    resumed = sessions(lambda found: found["sessions"].insert(0, {**found["sessions"][0], **session}))

    def lose_weights(run: OpenRun) -> None:
        run.agent.arrays.update({name: array + 1 + run.seed for name, array in run.agent.arrays.items()})

    bits, costs = tmp_path / "bits", tmp_path / "costs"
    folder = forged(pair, bits, resumed)
    in_runs(lose_weights)(folder)
    found = verify(folder, again())
    error = conclusion(found)
    assert error is not None and error.exit_code == 3
    assert str(error).startswith("Holds as far as it was compared. Not compared: bits, for its cpu is said to have")
    assert "its first 9 training episodes repeat" in str(found[-1])
    found = verify(forged(pair, costs, elsewhere), again())
    error = conclusion(found)
    assert error is not None and error.exit_code == 3 and "repeats to the bit" in str(found[-1])
    assert str(error).endswith("Not compared: CPU seconds, for its cpu is said to have been another.")
    there = rewrite_protocol(forged(pair, tmp_path / "device"), device="cuda")
    assert "for its device is said to have been another" in str(train_again(there, again())[0])


def commanded(seeds: str) -> Forge:
    """The session's command names these seeds."""
    command = f"imagine-bench bench x --seeds{seeds} --out y"
    return sessions(lambda found: found["sessions"][0].update(command=command))


@pytest.mark.parametrize(
    ("claim", "code", "first"),
    [
        (lambda folder: None, 0, "Holds."),
        (commanded(" 0-1"), 0, "Holds."),
        (commanded("=0-1"), 0, "Holds."),
        (commanded(" 0 1 2"), 1, "Does not hold. 1 of 3 verdicts"),
        (commanded("=0-2"), 1, "Does not hold. 1 of 3 verdicts"),
        (commanded(" 4 5 --until-decided"), 0, "Holds."),  # of a later stage
        (share_weights, 1, "Does not hold. 1 of 2 verdicts are complaints."),
        (in_runs(lambda run: run.values.update(before=7)), 1, "Does not hold. 2 of 2"),
        (sessions(lambda found: found["certificate"].update(chance_level=0.5)), 1, "Does not hold. 1 of 3 verdicts"),
    ],
)
def test_the_first_line_and_the_exit_code_say_what_was_found(
    pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], claim: Forge, code: int, first: str
) -> None:
    assert main(["verify", str(forged(pair, tmp_path, claim))]) == code
    said = capsys.readouterr()
    assert said.out.startswith(first)
    assert bool(said.err) == bool(code)


@pytest.mark.parametrize(
    ("preset", "seeds", "few", "said"),
    [
        ("quick", range(6), 0, ""),  # as many as the preset has, of random one
        ("quick", range(TUNING_SEEDS, TUNING_SEEDS + 6), TUNING_SEEDS, ""),
        ("quick", range(6), 1, "it has (0, 1, 2, 3, 4, 5), fewer of random; its preset quick (0, 1, 2, 3, 4, 5)"),
        ("quick", range(5), 0, "it has (0, 1, 2, 3, 4), fewer of random; its preset quick (0, 1, 2, 3, 4, 5)"),
        ("smoke", [1], 1, "it has (1,); its preset smoke (0,)"),
    ],
)
def test_seeds_that_may_have_been_left_out_are_said(
    tmp_path: Path, preset: str, seeds: Sequence[int], few: int, said: str
) -> None:
    fewer = (("random", few),) if len(seeds) > 1 else ()
    wanted = small(agents=("table", "random"), budgets=(1,), evaluation_episodes=1)
    wanted = dataclasses.replace(wanted, preset=preset, seeds=tuple(seeds), few_seeds=fewer)
    *_, found = verify(made_bench(wanted, tmp_path).folder)
    claims = [claim.partition("whether seeds were left out: ")[2] for claim in found.unshown]
    assert [*filter(None, claims)] == [said] * bool(said) and not found.complaint
