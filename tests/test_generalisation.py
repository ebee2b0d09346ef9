"""Transitions that no training can contain: all of them, marked against the rules."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.capabilities import ImaginedRollout
from imagine_bench.errors import InvalidValueError
from imagine_bench.generalisation import Probing, answer, consequence, probing, summarise
from imagine_bench.interfaces import Frame, Outcome, TaskSpec
from imagine_bench.report.generalisation import Asked, generalisation_table, write_generalisation
from imagine_bench.seeding import SeedTree


@pytest.fixture(scope="module")
def spec() -> TaskSpec:
    return registry.task("arrow_puzzle")


@pytest.fixture(scope="module")
def probe(spec: TaskSpec) -> Probing:
    return probing(spec, appearance="clean")


class Cheat:
    """Knows the answers, in the order they are asked; wrong and doubtful where it is told to be."""

    def __init__(self, probe: Probing, wrong: NDArray[np.bool_]) -> None:
        self.probe, self.wrong, self.asked = probe, wrong, 0

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        index, self.asked = self.asked, self.asked + 1
        assert np.array_equal(frame, self.probe.frames[index]) and actions == [self.probe.actions[index]] and depth == 1
        wrong = bool(self.wrong[index])
        (truth,) = self.probe.possible[index]
        told = self.probe.macrostates[index] if wrong else truth.macrostate
        one = np.zeros(1, dtype=np.float32)
        return ImaginedRollout(
            actions=actions, frames=np.zeros((1, 64, 64), np.float32), start_frame=np.zeros((64, 64), np.float32),
            rewards=one + truth.reward + 2 * wrong, p_terminated=one + (truth.terminated != wrong),
            q_values=np.zeros((1, 6), np.float32), epistemic=one + (1.0 + wrong),
            aleatoric=one, modal=one, accepted=np.ones(1, bool), macrostates=np.array([told]),
        )  # fmt: skip


def test_all_of_them_are_asked(spec: TaskSpec, probe: Probing) -> None:
    assert (int(probe.terminal.sum()), int((~probe.terminal).sum())) == (138 * 6, 54 * 6)
    assert int((probe.terminal & probe.legal).sum()) == 18 * 6  # the goals
    for state, action, possible in zip(probe.macrostates.tolist(), probe.actions, probe.possible, strict=True):
        (following,) = possible
        assert following.macrostate == spec.rules.turned(tuple(state), int(action))  # type: ignore[attr-defined]
        assert sum(a != b for a, b in zip(state, following.macrostate, strict=True)) == 1


@pytest.mark.parametrize(("part", "numbers"), [("terminal", (0.0, 1.0, 1.0)), ("none", (1.0, 1.0, 0.5))])
def test_marks_and_doubts_by_hand(probe: Probing, part: str, numbers: tuple[float, float, float]) -> None:
    wrong = probe.terminal if part == "terminal" else np.zeros_like(probe.terminal)
    result = summarise(probe, answer(Cheat(probe, wrong), probe, SeedTree(0)))
    assert (result.unseen, result.seen, result.auroc) == numbers
    assert result.unseen_legal == numbers[0]


def test_half_wrong_is_half(probe: Probing) -> None:
    wrong = np.arange(len(probe.actions)) % 2 == 0
    result = summarise(probe, answer(Cheat(probe, wrong), probe, SeedTree(0)))
    assert result.unseen == result.seen == result.auroc == 0.5


def test_marks_by_what_comes_of_it(spec: TaskSpec, probe: Probing) -> None:
    fails = np.array([outcome.terminated and not outcome.success for (outcome,) in probe.possible])
    marks = summarise(probe, answer(Cheat(probe, fails), probe, SeedTree(0))).consequences
    assert sum(one.count for one in marks.values()) == int((~probe.terminal).sum())
    assert marks["failure"].count == int((fails & ~probe.terminal).sum()) > 0
    assert (marks["failure"].right, marks["failure"].end_right) == (0.0, 0.0)
    assert marks["failure"].reward_error == pytest.approx(2.0)
    for name in ("success", "the episode goes on"):
        assert (marks[name].right, marks[name].end_right, marks[name].reward_error) == (1.0, 1.0, pytest.approx(0.0))


def test_rules_that_leave_it_open() -> None:
    end = Outcome(probability=0.5, macrostate=(0,), reward=0.0, terminated=True, success=False)
    on = dataclasses.replace(end, terminated=False)
    assert (consequence([end]), consequence([on]), consequence([end, on])) == ("failure", "the episode goes on", None)


def test_a_task_without_terminal_macrostates_says_so(spec: TaskSpec) -> None:
    class Endless:
        n_actions = 1
        states = ((0,), (1,))

        def is_terminal(self, macrostate: tuple[int, ...]) -> bool:
            return False

    endless = dataclasses.replace(spec, id="endless", rules=Endless())  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="'endless' has no terminal macrostates in its rules"):
        probing(endless, appearance="clean")


def test_table_and_files(spec: TaskSpec, probe: Probing, tmp_path: Path) -> None:
    answers = answer(Cheat(probe, probe.terminal & probe.legal), probe, SeedTree(0))
    asked = [
        Asked(agent="imagination", seed=seed, answers=answers, summary=summarise(probe, answers)) for seed in (0, 1)
    ]
    table = generalisation_table(asked, probe, spec)
    assert "828 transitions out of terminal macrostates, 324 others; mean of 2 seed(s)" in table
    assert "| 87.0 [87.0, 87.0] | 75 (of 20) |" in table  # 720 of 828
    write_generalisation(tmp_path / "out", asked, probe, spec, {})
    rows = (tmp_path / "out" / "transitions.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 192 * 6
