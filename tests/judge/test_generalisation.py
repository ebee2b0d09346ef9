"""Transitions that no training can contain: all of them, marked against the rules."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.capabilities import ImaginedRollout
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Frame, Outcome, TaskSpec
from imagine_bench.judge.generalisation import Probing, answer, consequence, probing, summarise
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


class Expert(Cheat):
    """Also says what it holds likeliest, which is right where it had the transition, and what it had."""

    def __init__(self, probe: Probing, wrong: NDArray[np.bool_], times: NDArray[np.int64]) -> None:
        super().__init__(probe, wrong)
        self.times = times

    def predict_map(self, frames: Frame, actions: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        assert np.array_equal(frames, self.probe.frames) and np.array_equal(actions, self.probe.actions)
        truths = np.array([truth.macrostate for (truth,) in self.probe.possible])
        return np.where(self.times[:, None] > 0, truths, self.probe.macrostates)

    def replayed(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return self.probe.macrostates.repeat(self.times, axis=0), self.probe.actions.repeat(self.times)


def test_marks_by_how_often_a_transition_was_had(spec: TaskSpec, probe: Probing) -> None:
    seen = np.flatnonzero(~probe.terminal)
    times = np.zeros(len(probe.actions), dtype=np.int64)
    times[seen[:100]], times[seen[100:200]], times[seen[200:203]] = 1, 9, 10
    wrong = np.isin(np.arange(len(times)), [*seen[:50], *seen[200:202]])
    answers = answer(Expert(probe, wrong, times), probe, SeedTree(0))
    assert np.array_equal(answers.times, times)
    found = summarise(probe, answers)
    assert (found.unseen_likeliest, found.seen_likeliest) == (0.0, pytest.approx(203 / 324))
    assert (found.unseen, found.seen) == (1.0, pytest.approx(272 / 324))
    assert [dataclasses.astuple(part) for part in found.experience.values()] == [
        (121, 1.0, 0.0), (200, 0.75, 1.0), (3, pytest.approx(1 / 3), 1.0),
    ]  # fmt: skip
    asked = [Asked(agent="imagination", seed=0, episodes=9, answers=answers, summary=found)]
    table = generalisation_table(asked, probe, spec)
    assert "| imagination, 9 episodes | 1 to 9 times | 200 | 75.0 | 100.0 |" in table
    assert "of all these by what the model holds likeliest, instead of what it draws, % | 0.0 | – |" in table


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
        Asked(agent="imagination", seed=seed, episodes=9, answers=answers, summary=summarise(probe, answers))
        for seed in (0, 1)
    ]
    table = generalisation_table(asked, probe, spec)
    assert "828 transitions out of terminal macrostates, 324 others; mean over seeds" in table
    assert "| imagination, 9 episodes (2 seed(s)) | thesis |" in table
    assert "remembers" not in table and "likeliest" not in table  # what this agent cannot say
    assert "| 87.0 [87.0, 87.0] | 75 (of 20) |" in table  # 720 of 828
    write_generalisation(tmp_path / "out", asked, probe, spec, {})
    runs = json.loads((tmp_path / "out" / "summary.json").read_text(), parse_constant=pytest.fail)["runs"]
    assert [(run["seed"], run["unseen_likeliest"], run["seen"]) for run in runs] == [(0, None, 1.0), (1, None, 1.0)]
    rows = (tmp_path / "out" / "transitions.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 192 * 6
