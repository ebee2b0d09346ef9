"""Where policies lead by the rules: against oracles, against walks step by step, and on a report's page."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from fake_results import bench_result
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.cli import main
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.judge.values import Terminations, optimal_length, terminations
from imagine_bench.protocols.control import protocol
from imagine_bench.report.data import collect
from imagine_bench.report.page import Table
from imagine_bench.report.sections import policies
from imagine_bench.rules import fewest_actions, greedy, states_of
from imagine_bench.store.results import PolicyTable, RunResult

HARD = registry.task("arrow_puzzle_hard")
PICK = registry.task("pick_place")
RULES = HARD.rules
STARTS = RULES.start_states
LEGAL = {
    state: [action for action in range(6) if RULES.is_legal(RULES.outcomes(state, action)[0].macrostate)]
    for state in STARTS
}
"""Turns that break no rule: one each way round the ring of twelve."""
FIRST = {state: actions[0] for state, actions in LEGAL.items()}


def ends_of(spec: TaskSpec, choose: Callable[[State], int]) -> Terminations:
    """Where a rule of choice leads; what the frames show does not matter to it."""
    return terminations(spec, greedy(everywhere(spec, choose), spec.n_actions), spec.rules.start_states)


def everywhere(spec: TaskSpec, choose: Callable[[State], int]) -> NDArray[np.int64]:
    """What it chooses in each macrostate; anything in terminal ones. Shape (S,)."""
    return np.array([0 if spec.rules.is_terminal(state) else choose(state) for state in states_of(spec.rules)])


def other_way(state: State) -> int:
    """The legal turn away from the nearest goal."""
    (away,) = set(LEGAL[state]) - {RULES.optimal_action(state)}
    return away


def walked(choose: Callable[[State], int], start: State, patience: int) -> tuple[bool, bool, int]:
    """Success, end, and length of a walk by deterministic rules."""
    state = start
    for length in range(1, patience + 1):
        (outcome,) = RULES.outcomes(state, choose(state))
        if outcome.terminated:
            return outcome.success, True, length
        state = outcome.macrostate
    return False, False, patience


@pytest.mark.parametrize("which", ["optimal", "the other way", "to and fro", "random"])
def test_a_policy_ends_as_its_walks_do(which: str) -> None:
    """In success, otherwise, late or never, after as many macro-actions, from every start."""
    drawn = dict(zip(STARTS, np.random.default_rng(0).integers(6, size=len(STARTS)).tolist(), strict=True))
    choose = {"optimal": RULES.optimal_action, "the other way": other_way, "to and fro": FIRST.__getitem__}
    policy = choose.get(which, drawn.__getitem__)
    ends = ends_of(HARD, policy)
    for index, start in enumerate(STARTS):
        success, over, length = walked(policy, start, HARD.horizon)
        later, ever, _ = walked(policy, start, 100)
        assert (ends.success[index], ends.failure[index], ends.length[index]) == (success, over and not success, length)
        assert (ends.late_success[index], ends.endless[index]) == (later and not success, not ever)
    optimal = [fewest_actions(RULES, state) for state in STARTS]
    assert optimal_length(HARD, STARTS).tolist() == optimal
    assert (ends.length.tolist() == optimal) == (which == "optimal")


def test_late_failures_are_told_from_what_never_ends() -> None:
    """Where one frame in a hundred makes the agent break a rule, going to and fro ends that way, but mostly late."""
    to_and_fro = greedy(everywhere(HARD, FIRST.__getitem__), 6)
    illegal = greedy(everywhere(HARD, lambda state: min(set(range(6)) - set(LEGAL[state]))), 6)
    stuck = terminations(HARD, to_and_fro, STARTS).endless == 1.0
    mixed = terminations(HARD, 0.99 * to_and_fro + 0.01 * illegal, STARTS)
    assert stuck.any() and mixed.endless == pytest.approx(0.0, abs=1e-4)
    assert mixed.failure[stuck] == pytest.approx(1 - 0.99**HARD.horizon)
    assert mixed.late_failure[stuck] == pytest.approx(0.99**HARD.horizon, abs=1e-4)


def test_chance_in_the_rules_is_kept() -> None:
    ends = ends_of(PICK, PICK.rules.optimal_action)
    assert ends.success.mean() == pytest.approx(PICK.facts().optimum)
    assert ends.length.mean() == pytest.approx(PICK.facts().mean_plan_length)
    assert 0.0 < ends.late_success.max() < 1e-3, "the optimal agent is cut off once in 25,000 episodes"
    idle = ends_of(PICK, lambda state: 0)
    total = idle.success + idle.failure + idle.late_success + idle.late_failure + idle.endless
    assert total == pytest.approx(np.ones(len(total))) and idle.success.mean() < 0.9


def test_starts_of_tests_alone_are_followed() -> None:
    """Of rules that list no macrostates, whose order begins with the starts."""
    task = registry.task("arrows:cubes=2")
    policy = greedy(everywhere(task, task.rules.optimal_action), task.n_actions)
    some = task.rules.start_states[::-2]
    found, every = (terminations(task, policy, starts) for starts in (some, task.rules.start_states))
    assert found.length.tolist() == every.length[::-2].tolist() == optimal_length(task, some).tolist()


def test_a_report_follows_what_was_held_from_every_start(tmp_path: Path) -> None:
    """A page of a bench whose agents held the optimal policy, and the wrong way round the ring."""
    wanted = protocol("arrow_puzzle_hard", "smoke", agents=("dqn", "imagination"), seeds=(0, 1), budgets=(2,))
    result = bench_result(tmp_path, protocol=wanted)
    right, astray = (everywhere(HARD, choose).astype(np.int16) for choose in (RULES.optimal_action, other_way))

    def page_of(held: Callable[[RunResult], PolicyTable | None]) -> Sequence[Table]:
        def holding(run: RunResult) -> RunResult:
            row = dataclasses.replace(run.checkpoints[-1], beliefs=held(run))
            return dataclasses.replace(run, checkpoints=(row,))

        section = policies(collect(dataclasses.replace(result, runs=tuple(map(holding, result.runs)))))
        return () if section is None else section.tables

    def one_astray(run: RunResult) -> PolicyTable:
        wrong = (run.agent, run.seed) == ("imagination", 1)
        return PolicyTable(action=astray if wrong else right, model=None)

    (whole,) = page_of(one_astray)
    bad = ends_of(HARD, other_way)
    rows = [dict(zip(whole.header, row, strict=True)) for row in whole.rows]
    assert whole.rows[0][1:6] == ["100.0", *["0.0"] * 4]
    near = bad.success[optimal_length(HARD, STARTS) == 2].mean()
    assert [row["solved from 2 away"] for row in rows] == ["100.0", f"{50 + 50 * near:.1f}"]
    assert rows[0]["macro-actions"] == "3.27"
    assert str(whole.rows[1][1]).startswith(f"{50 + 50 * bad.success.mean():.1f} [")
    assert page_of(lambda run: None) == ()


@pytest.mark.parametrize(
    ("folder", "complaint"),
    [
        ("docs/results/arrow_puzzle_hard-thesis", "holds kept results and no agents; give a bench's own folder"),
        ("docs/results/toy_regression-thesis", "in which no agent acts"),
        ("docs", "There is no docs/protocol.json"),
    ],
)
def test_folders_without_agents_are_named(
    folder: str, complaint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])
    assert main(["why", folder]) == 2
    assert complaint in capsys.readouterr().err
