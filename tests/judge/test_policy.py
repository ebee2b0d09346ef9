"""Where policies lead by the rules: against oracles, against walks step by step, and from a real bench."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_fakes import TableAgent
from fake_agents import FakeAgent
from numpy.typing import NDArray
from small_runs import Inline, small

from imagine_bench import registry
from imagine_bench.bench import bench as benches
from imagine_bench.cli import main
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import Observation, State, TaskSpec
from imagine_bench.judge.policy import (
    FRAMES,
    EvalStates,
    Terminations,
    action_shares,
    eval_states,
    optimal_length,
    terminations,
)
from imagine_bench.protocols.control import protocol
from imagine_bench.report.analysis import Measured
from imagine_bench.report.policy import PolicyAnalysis
from imagine_bench.rules import fewest_actions, greedy
from imagine_bench.store import encoders
from imagine_bench.store.files import lock, sealed
from imagine_bench.store.results import BenchResult
from imagine_bench.store.trained import learners, load_trained

HARD = registry.task("arrow_puzzle_hard")
PICK = registry.task("pick_place")


def bench(root: Path, launcher: Inline, **changes: Any) -> BenchResult:
    wanted = small(**{"budgets": (2, 9), "agents": ("table", "imaginer"), "seeds": (0, 1), **changes})
    result: BenchResult = benches.bench(wanted, {}, root=root, launcher=launcher)
    return result


@pytest.fixture(scope="module")
def hard() -> EvalStates:
    return eval_states(HARD, appearance="clean")


def ends_of(spec: TaskSpec, choose: Callable[[State], int]) -> Terminations:
    """Where a rule of choice leads; what the frames show does not matter to it."""
    states = np.array([state for state in spec.rules.states if not spec.rules.is_terminal(state)])
    shown = EvalStates(macrostates=states, frames=np.zeros((len(states), 1, 64, 64, 3), dtype=np.uint8))
    chosen = np.array([choose(tuple(state)) for state in states.tolist()])
    return terminations(spec, shown, greedy(chosen, spec.n_actions))


def means(ends: Terminations) -> tuple[float, float, float, float]:
    return tuple(float(part.mean()) for part in (ends.success, ends.failure, ends.late_success, ends.endless))  # type: ignore[return-value]


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
    ends = ends_of(HARD, HARD.rules.optimal_action)
    assert means(ends) == (1.0, 0.0, 0.0, 0.0)
    assert np.array_equal(ends.length, optimal_length(HARD))
    assert optimal_length(HARD).tolist() == [fewest_actions(HARD.rules, state) for state in HARD.rules.start_states]


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
    assert (ends.success[index], ends.failure[index], ends.late_success[index], ends.length[index]) == (
        0.0,
        0.0,
        1.0,
        10.0,
    )
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
    states = np.array(HARD.rules.start_states)
    to_and_fro = greedy(np.array([legal(tuple(state))[0] for state in states.tolist()]), 6)
    illegal = greedy(np.array([min(set(range(6)) - set(legal(tuple(state)))) for state in states.tolist()]), 6)
    shown = EvalStates(macrostates=states, frames=np.zeros((len(states), 1, 64, 64, 3), dtype=np.uint8))
    pure, mixed = terminations(HARD, shown, to_and_fro), terminations(HARD, shown, 0.99 * to_and_fro + 0.01 * illegal)
    stuck = pure.endless == 1.0
    assert stuck.any() and mixed.endless == pytest.approx(0.0, abs=1e-4)
    assert mixed.failure[stuck] == pytest.approx(1 - 0.99**HARD.horizon)
    assert mixed.late_failure[stuck] == pytest.approx(0.99**HARD.horizon, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
def test_any_policy_ends_as_the_walk_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
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
    """Half of the frames say one legal turn and half the other: a fair walk on the ring, solved by hand."""
    half = {state: legal(state) for state in HARD.rules.start_states}
    states = np.array(list(half))
    policy = sum(greedy(np.array([half[tuple(s)][way] for s in states.tolist()]), 6) for way in (0, 1)) / 2
    shown = EvalStates(macrostates=states, frames=np.zeros((len(states), 2, 64, 64, 3), dtype=np.uint8))
    ends = terminations(HARD, shown, policy)
    ring = np.zeros(13)  # the goal is at 0 and at 12, one turn a step
    ring[[0, 12]] = 1.0
    for _ in range(HARD.horizon):
        ring[1:12] = (ring[:11] + ring[2:]) / 2
    by_distance = {int(far): ring[int(far)] for far in optimal_length(HARD)}
    assert ends.success == pytest.approx(np.array([by_distance[int(far)] for far in optimal_length(HARD)]))
    assert ends.failure == pytest.approx(0.0) and ends.success + ends.late_success == pytest.approx(
        np.ones(66), abs=1e-4
    )


def test_every_frame_is_seen_once_and_acted_on_greedily(hard: EvalStates) -> None:
    assert len(hard.macrostates) == 66 == len(HARD.rules.start_states)
    assert hard.frames.shape == (66, FRAMES, 64, 64, 3)
    assert not np.array_equal(hard.frames[0, 0], hard.frames[0, 1]), "cubes lie a little otherwise each time"
    again = eval_states(HARD, appearance="clean")
    assert np.array_equal(again.frames, hard.frames)

    class Watched(FakeAgent):
        seen: list[NDArray[np.uint8]] = []  # noqa: RUF012 - one agent only

        def act(self, observation: Observation, *, explore: bool) -> int:
            assert not explore and observation.macrostate is None
            self.seen.append(observation.frame)
            return 5 if len(self.seen) % FRAMES == 1 else 2

    policy = action_shares(Watched(), hard, 6)
    assert np.array_equal(policy[5], np.full(66, 1 / FRAMES)) and np.array_equal(policy[2], np.full(66, 1 - 1 / FRAMES))
    assert np.array_equal(np.stack(Watched.seen), hard.frames.reshape(-1, 64, 64, 3))

    class Told(FakeAgent):
        def act(self, observation: Observation, *, explore: bool) -> int:
            assert observation.macrostate is not None
            return HARD.rules.optimal_action(tuple(observation.macrostate.tolist()))

    best = [HARD.rules.optimal_action(tuple(state)) for state in hard.macrostates.tolist()]
    assert action_shares(Told(), hard, 6, privileged=True).argmax(axis=0).tolist() == best


def test_table_and_files(tmp_path: Path) -> None:
    good, bad = ends_of(HARD, HARD.rules.optimal_action), ends_of(HARD, other_way)
    runs = [
        Measured(agent="dqn", seed=0, episodes=100, value=good),
        Measured(agent="dqn", seed=1, episodes=100, value=bad),
        Measured(agent="imagination", seed=0, episodes=50, value=good),
    ]
    analysis = PolicyAnalysis(HARD, appearance="clean")
    table = analysis.table(runs)
    assert "All 66 starts" in table and "(optimal: 3.27)" in table
    assert f"| DQN | 100 | 2 | {50 + 50 * bad.success.mean():.1f} [" in table
    assert "| imagination | 50 | 1 | 100.0 | 0.0 | 0.0 | 0.0 | 0.0 | 3.27 |" in table
    assert f"Starts that some run does not always solve: {(bad.success < 1).sum()} of 66. Solved least:" in table
    near = [end for end, need in zip(bad.success, optimal_length(HARD), strict=True) if need == 2]
    assert f"| 2 | 12 | {50 + 50 * np.mean(near):.1f} | 100.0 |" in table
    assert table.endswith("| 50.0 | 100.0 |") and table.split("Solved least:")[1].count("| 50.0 | 100.0 |") == 12
    assert "Every run solves every start." in analysis.table(runs[2:])
    seldom = dataclasses.replace(good, success=np.where(np.arange(66) == 5, 0.998, 1.0))
    many = [Measured(agent="dqn", seed=seed, episodes=9, value=seldom if seed == 3 else good) for seed in range(5)]
    assert "does not always solve: 1 of 66." in analysis.table(many), "the mean of five is 99.96 %"
    analysis.write(tmp_path / "out", runs, {"commit": "abc"})
    with (tmp_path / "out" / "starts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 66
    assert sum(float(row["success"]) for row in rows[66:132]) == pytest.approx(bad.success.sum())
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["commit"] == "abc" and summary["runs"][1]["success"] == pytest.approx(bad.success.mean())


def test_an_unfinished_bench_is_analysed_as_it_stands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, Inline(patience=3))  # both agents of seed 0, and one of seed 1, to the end
    (folder,) = tmp_path.glob("*/*/")
    assert [path.relative_to(folder).as_posix() for path in learners(folder)] == [
        "table/seed_0", "imaginer/seed_0", "imaginer/seed_1",
    ]  # fmt: skip
    with lock(folder / ".policy.lock", "This"):
        assert main(["policy", str(folder)]) == 2
    assert "is in use by process" in capsys.readouterr().err
    assert main(["policy", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "| table | 9 | 1 |" in said and "| imaginer | 9 | 2 |" in said and str(folder / "policy") in said
    assert len((folder / "policy" / "starts.csv").read_text().splitlines()) == 1 + 3 * 54


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
    assert main(["policy", folder]) == 2
    assert complaint in capsys.readouterr().err


def test_training_in_the_model_comes_before_an_analysis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = bench(tmp_path, Inline(), agents=("table",), budgets=(2,), seeds=(0,))
    left = [True, True, False]
    monkeypatch.setattr(TableAgent, "train_in_model", lambda agent: left.pop(0), raising=False)
    load_trained(result.runs[0].folder)
    assert left == []


def test_one_encoder_file_is_enough_for_agents_of_two_kinds(tmp_path: Path) -> None:
    own = tmp_path / "own.safetensors"
    shutil.copy(encoders.resolve(HARD, "clean"), own)
    codes = encoders.resolve(HARD, "clean", kind="codes")
    names = {"encoder": encoders.identity(own), "codes": encoders.identity(codes)}
    wanted = protocol("arrow_puzzle_hard", "smoke", agents=("dqn", "factored"), **names)
    config = {"protocol": wanted.as_dict(), "agent": "dqn", "seed": 0, "settings": {}}
    for agent, complaint in (("dqn", "has no checkpoint"), ("factored", "has no checkpoint")):
        (tmp_path / "config.json").write_text(json.dumps(sealed({**config, "agent": agent})))
        with pytest.raises(ArtefactError, match=complaint):  # the encoder was found
            load_trained(tmp_path, encoder=str(own))
    (tmp_path / "config.json").write_text(json.dumps(sealed(config)))
    with pytest.raises(ArtefactError, match=r"own@\w+, which is not here; give its file with --encoder"):
        load_trained(tmp_path)
    with pytest.raises(ArtefactError, match=r"own@\w+, and .*arrow_puzzle-mild.* give the right file"):
        load_trained(tmp_path, encoder="arrow_puzzle-mild")


def test_a_bench_without_learners_says_so(tmp_path: Path) -> None:
    result = bench(tmp_path, Inline(), agents=("random",), budgets=(2,), seeds=(0,))
    with pytest.raises(ArtefactError, match="has a checkpoint of an agent that learns"):
        learners(result.folder)
