"""Where policies lead by the rules: against oracles, against walks step by step, and from a real bench."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_fakes import TableAgent
from numpy.typing import NDArray
from small_runs import Inline, small

from imagine_bench import registry
from imagine_bench.cli import main
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.judge.values import Terminations, optimal_length, terminations
from imagine_bench.protocols.control import protocol
from imagine_bench.report.data import collect
from imagine_bench.report.exact import policies
from imagine_bench.rules import fewest_actions, greedy, states_of
from imagine_bench.running import bench as benches
from imagine_bench.running.trained import learners, load_trained
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.files import lock, sealed
from imagine_bench.store.results import BenchResult, PolicyTable, RunResult

HARD = registry.task("arrow_puzzle_hard")
PICK = registry.task("pick_place")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> BenchResult:
    few: dict[str, Any] = {"budgets": (2,), "evaluation_episodes": 2, "open_loop_starts": 0, "recorded_episodes": 0}
    wanted = protocol(
        "arrow_puzzle_hard", "smoke", agents=("table", "imaginer"), seeds=(0, 1), execution="kinematic", **few
    )
    found = benches.bench(wanted, {}, root=tmp_path_factory.mktemp("bench"), launcher=Inline())
    assert isinstance(found, BenchResult)
    return found


def ends_of(spec: TaskSpec, choose: Callable[[State], int]) -> Terminations:
    """Where a rule of choice leads; what the frames show does not matter to it."""
    return terminations(spec, greedy(everywhere(spec, choose), spec.n_actions), spec.rules.start_states)


def everywhere(spec: TaskSpec, choose: Callable[[State], int]) -> NDArray[np.int64]:
    """What it chooses in each macrostate; anything in terminal ones. Shape (S,)."""
    return np.array([0 if spec.rules.is_terminal(state) else choose(state) for state in states_of(spec.rules)])


def legal(state: State) -> list[int]:
    """Turns that break no rule: one each way round the ring of twelve."""
    return [action for action in range(6) if HARD.rules.is_legal(HARD.rules.outcomes(state, action)[0].macrostate)]


def other_way(state: State) -> int:
    """The legal turn away from the nearest goal."""
    (away,) = set(legal(state)) - {HARD.rules.optimal_action(state)}
    return away


def walked(spec: TaskSpec, choose: Callable[[State], int], start: State, patience: int) -> tuple[bool, bool, int]:
    """Success, end, and length of a walk by deterministic rules."""
    state = start
    for length in range(1, patience + 1):
        (outcome,) = spec.rules.outcomes(state, choose(state))
        if outcome.terminated:
            return outcome.success, True, length
        state = outcome.macrostate
    return False, False, patience


def test_the_optimal_policy_misses_nothing() -> None:
    starts = HARD.rules.start_states
    ends = ends_of(HARD, HARD.rules.optimal_action)
    assert (ends.success == 1.0).all() and (ends.failure == 0.0).all() and (ends.endless == 0.0).all()
    assert ends.length.tolist() == optimal_length(HARD, starts).tolist()
    assert ends.length.tolist() == [fewest_actions(HARD.rules, state) for state in starts]


def test_the_long_way_round_comes_late() -> None:
    """Twelve macrostates make a ring: who is one turn from the goal and goes the other way comes after eleven."""
    astray = next(state for state in HARD.rules.start_states if fewest_actions(HARD.rules, state) == 1)
    policy = {state: HARD.rules.optimal_action(state) for state in HARD.rules.start_states}
    here, previous = astray, None
    while not HARD.rules.is_terminal(here):
        turns = {action: HARD.rules.outcomes(here, action)[0].macrostate for action in legal(here)}
        policy[here] = other_way(here) if previous is None else next(a for a, to in turns.items() if to != previous)
        here, previous = turns[policy[here]], here
    ends = ends_of(HARD, policy.__getitem__)
    index = HARD.rules.start_states.index(astray)
    assert (ends.success[index], ends.failure[index], ends.late_success[index]) == (0.0, 0.0, 1.0)
    assert ends.length[index] == 10.0
    assert walked(HARD, policy.__getitem__, astray, 20) == (True, True, 11)
    assert ends.success.sum() == len(ends.success) - 1, "ten turns are still in time"


def test_who_undoes_what_was_done_never_comes() -> None:
    ends = ends_of(HARD, lambda state: legal(state)[0])
    for index, start in enumerate(HARD.rules.start_states):
        success, _, _ = walked(HARD, lambda state: legal(state)[0], start, 1_000)
        assert (ends.success[index] + ends.late_success[index], ends.endless[index]) == (float(success), 1.0 - success)
    assert 0.0 < ends.endless.mean() < 1.0


def test_late_failures_are_told_from_what_never_ends() -> None:
    """Where one frame in a hundred makes the agent break a rule, going to and fro ends that way, but mostly late."""
    to_and_fro = greedy(everywhere(HARD, lambda state: legal(state)[0]), 6)
    illegal = greedy(everywhere(HARD, lambda state: min(set(range(6)) - set(legal(state)))), 6)
    pure, mixed = (
        terminations(HARD, policy, HARD.rules.start_states)
        for policy in (to_and_fro, 0.99 * to_and_fro + 0.01 * illegal)
    )
    stuck = pure.endless == 1.0
    assert stuck.any() and mixed.endless == pytest.approx(0.0, abs=1e-4)
    assert mixed.failure[stuck] == pytest.approx(1 - 0.99**HARD.horizon)
    assert mixed.late_failure[stuck] == pytest.approx(0.99**HARD.horizon, abs=1e-4)


def test_any_policy_ends_as_the_walk_does() -> None:
    rng = np.random.default_rng(0)
    policy = {state: int(rng.integers(6)) for state in HARD.rules.start_states}
    ends = ends_of(HARD, policy.__getitem__)
    for index, start in enumerate(HARD.rules.start_states):
        success, over, length = walked(HARD, policy.__getitem__, start, HARD.horizon)
        assert (ends.success[index], ends.failure[index]) == (float(success), float(over and not success))
        assert ends.length[index] == length
    assert ends.failure.mean() > 0.5, "most turns break a rule"


def test_chance_in_the_rules_is_kept() -> None:
    ends = ends_of(PICK, PICK.rules.optimal_action)
    assert ends.success.mean() == pytest.approx(PICK.facts().optimum)
    assert ends.length.mean() == pytest.approx(PICK.facts().mean_plan_length)
    assert 0.0 < ends.late_success.max() < 1e-3, "the optimal agent is cut off once in 25,000 episodes"
    idle = ends_of(PICK, lambda state: 0)
    total = idle.success + idle.failure + idle.late_success + idle.late_failure + idle.endless
    assert total == pytest.approx(np.ones(len(total))) and idle.success.mean() < 0.9


def test_wavering_between_two_ways_is_a_walk_by_chance() -> None:
    """One legal turn half of the time and the other else: a fair walk on the ring, solved by hand."""
    ways = [everywhere(HARD, lambda state, way=way: legal(state)[way]) for way in (0, 1)]  # type: ignore[misc]
    starts = HARD.rules.start_states
    ends = terminations(HARD, np.mean([greedy(way, 6) for way in ways], axis=0), starts)
    ring = np.zeros(13)  # the goal is at 0 and at 12, one turn a step
    ring[[0, 12]] = 1.0
    for _ in range(HARD.horizon):
        ring[1:12] = (ring[:11] + ring[2:]) / 2
    assert ends.success == pytest.approx(ring[optimal_length(HARD, starts).astype(int)])
    assert ends.failure == pytest.approx(0.0)
    assert ends.success + ends.late_success == pytest.approx(np.ones(66), abs=1e-4)


def test_a_report_follows_what_was_held_from_every_start(result: BenchResult) -> None:
    """A page of a bench whose agents held the optimal policy, and the wrong way round the ring."""
    optimal = everywhere(HARD, HARD.rules.optimal_action).astype(np.int16)
    astray = everywhere(HARD, other_way).astype(np.int16)

    def holding(run: RunResult, action: NDArray[np.int16]) -> RunResult:
        row = dataclasses.replace(run.checkpoints[-1], beliefs=PolicyTable(action=action, model=None))
        return dataclasses.replace(run, checkpoints=(row,))

    runs = [holding(run, astray if (run.agent, run.seed) == ("imaginer", 1) else optimal) for run in result.runs]
    data = collect(dataclasses.replace(result, runs=tuple(runs)))
    section = policies(data)
    assert section is not None
    whole, by_length, missed = section.tables
    bad = ends_of(HARD, other_way)
    assert "from all 66 starts" in whole.caption and whole.header[-1] == "macro-actions (optimal: 3.27)"
    assert whole.rows[0] == ["table", "100.0 [100.0, 100.0]", *["0.0 [0.0, 0.0]"] * 4, "3.27 [3.27, 3.27]"]
    assert str(whole.rows[1][1]).startswith(f"{50 + 50 * bad.success.mean():.1f} [")
    near = bad.success[optimal_length(HARD, HARD.rules.start_states) == 2].mean()
    assert by_length.rows[1] == ["2", "12", "100.0", f"{50 + 50 * near:.1f}"]
    assert f"{(bad.success < 1).sum()} starts are not always solved" in missed.caption and len(missed.rows) == 12
    assert all(row[2:] == ["100.0", "50.0"] for row in missed.rows)
    alone = dataclasses.replace(result, runs=tuple(holding(run, optimal) for run in result.runs))
    section = policies(collect(alone))
    assert section is not None and len(section.tables) == 2, "none is missed"
    rows = [tuple(dataclasses.replace(row, beliefs=None) for row in run.checkpoints) for run in result.runs]
    runs = [dataclasses.replace(run, checkpoints=row) for run, row in zip(result.runs, rows, strict=True)]
    assert policies(collect(dataclasses.replace(result, runs=tuple(runs)))) is None


def test_starts_of_tests_alone_are_followed() -> None:
    """Of rules that list no macrostates, whose order begins with the starts."""
    task = registry.task("arrows:cubes=2")
    policy = greedy(everywhere(task, task.rules.optimal_action), task.n_actions)
    some = task.rules.start_states[::-2]
    found, every = terminations(task, policy, some), terminations(task, policy, task.rules.start_states)
    assert found.length.tolist() == every.length[::-2].tolist() == optimal_length(task, some).tolist()


def test_an_analysis_is_made_by_one_process_at_a_time(result: BenchResult, capsys: pytest.CaptureFixture[str]) -> None:
    with lock(result.folder / ".why.lock", "This"):
        assert main(["why", str(result.folder)]) == 2
    assert "is in use by process" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("folder", "complaint"),
    [
        ("docs/results/arrow_puzzle_hard-thesis", "holds kept results and no agents; give a bench's own folder"),
        ("docs/results/toy_regression-thesis", "is of a regression task, in which no agent acts"),
        ("docs", "There is no docs/protocol.json"),
    ],
)
def test_folders_without_agents_are_named(
    folder: str, complaint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])
    assert main(["why", folder]) == 2
    assert complaint in capsys.readouterr().err


def test_training_in_the_model_comes_before_an_analysis(result: BenchResult, monkeypatch: pytest.MonkeyPatch) -> None:
    left = [True, True, False]
    monkeypatch.setattr(TableAgent, "train_in_model", lambda agent: left.pop(0), raising=False)
    load_trained(result.runs[0].folder)
    assert left == []


def test_one_encoder_file_is_enough_for_agents_of_two_kinds(tmp_path: Path) -> None:
    own = tmp_path / "own.safetensors"
    shutil.copy(encoders.resolve(HARD, "clean"), own)
    codes = encoders.resolve(HARD, "clean", kind="codes")
    names = {"encoder": encoders.identity(own), "codes": encoders.identity(codes)}
    wanted = protocol("arrow_puzzle_hard", "smoke", agents=("dqn", "factored:given"), **names)
    config = {"format": run_folder.FORMAT, "protocol": wanted.as_dict(), "agent": "dqn", "seed": 0, "settings": {}}
    for agent, complaint in (("dqn", "has no checkpoint"), ("factored:given", "has no checkpoint")):
        (tmp_path / "config.json").write_text(json.dumps(sealed({**config, "agent": agent})))
        with pytest.raises(ArtefactError, match=complaint):  # the encoder was found
            load_trained(tmp_path, encoder=str(own))
    (tmp_path / "config.json").write_text(json.dumps(sealed(config)))
    with pytest.raises(ArtefactError, match=r"own@\w+, which is not here; give its file with --encoder"):
        load_trained(tmp_path)
    with pytest.raises(ArtefactError, match=r"own@\w+, and .*arrow_puzzle-mild.* give the right file"):
        load_trained(tmp_path, encoder="arrow_puzzle-mild")


def test_a_bench_without_learners_says_so(tmp_path: Path) -> None:
    wanted = small(agents=("random",), budgets=(2,), evaluation_episodes=1)
    with pytest.raises(ArtefactError, match="has a checkpoint of an agent that learns"):
        learners(benches.bench(wanted, {}, root=tmp_path, launcher=Inline()).folder)
