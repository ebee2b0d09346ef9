"""Transitions that no training can contain: all of them, scored against the rules."""

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
from imagine_bench.judge import filmstrips
from imagine_bench.judge.generalisation import TransitionSet, consequence
from imagine_bench.report.analysis import Measured
from imagine_bench.report.generalisation import GeneralisationAnalysis
from imagine_bench.seeding import SeedTree


@pytest.fixture(scope="module")
def spec() -> TaskSpec:
    return registry.task("arrow_puzzle")


@pytest.fixture(scope="module")
def analysis(spec: TaskSpec) -> GeneralisationAnalysis:
    return GeneralisationAnalysis(spec, appearance="clean")


@pytest.fixture(scope="module")
def transitions(analysis: GeneralisationAnalysis) -> TransitionSet:
    return analysis.transitions


class Cheat:
    """Knows what comes of the transitions, in their order; wrong and uncertain where it is told to be."""

    def __init__(self, transitions: TransitionSet, wrong: NDArray[np.bool_]) -> None:
        self.transitions, self.wrong, self.predicted = transitions, wrong, 0

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        index, self.predicted = self.predicted, self.predicted + 1
        assert (
            np.array_equal(frame, self.transitions.frames[index])
            and actions == [self.transitions.actions[index]]
            and depth == 1
        )
        wrong = bool(self.wrong[index])
        (truth,) = self.transitions.possible[index]
        told = self.transitions.macrostates[index] if wrong else truth.macrostate
        one = np.zeros(1, dtype=np.float32)
        return ImaginedRollout(
            actions=actions, frames=np.zeros((1, 64, 64), np.float32), start_frame=np.zeros((64, 64), np.float32),
            rewards=one + truth.reward + 2 * wrong, p_terminated=one + (truth.terminated != wrong),
            q_values=np.zeros((1, 6), np.float32), epistemic=one + (1.0 + wrong),
            aleatoric=one, modal=one, accepted=np.ones(1, bool), macrostates=np.array([told]),
        )  # fmt: skip


def test_all_transitions_are_there(spec: TaskSpec, transitions: TransitionSet) -> None:
    assert (int(transitions.terminal.sum()), int((~transitions.terminal).sum())) == (138 * 6, 54 * 6)
    assert int((transitions.terminal & transitions.legal).sum()) == 18 * 6  # the goals
    for state, action, possible in zip(
        transitions.macrostates.tolist(), transitions.actions, transitions.possible, strict=True
    ):
        (following,) = possible
        assert following.macrostate == spec.rules.turned(tuple(state), int(action))  # type: ignore[attr-defined]
        assert sum(a != b for a, b in zip(state, following.macrostate, strict=True)) == 1


@pytest.mark.parametrize(("part", "numbers"), [("terminal", (0.0, 1.0, 1.0)), ("none", (1.0, 1.0, 0.5))])
def test_scores_and_uncertainties_by_hand(
    analysis: GeneralisationAnalysis, transitions: TransitionSet, part: str, numbers: tuple[float, float, float]
) -> None:
    wrong = transitions.terminal if part == "terminal" else np.zeros_like(transitions.terminal)
    _, result = analysis.scored(Cheat(transitions, wrong), SeedTree(0))
    assert (result.unseen.right, result.seen.right, result.auroc) == numbers
    assert result.unseen_legal.right == numbers[0]


@pytest.mark.parametrize("right", [True, False])
def test_the_figure_shows_and_judges_unseen_transitions(
    analysis: GeneralisationAnalysis, transitions: TransitionSet, right: bool
) -> None:
    shown = transitions.shown
    assert len(set(shown.tolist())) == 6 and (transitions.terminal & transitions.legal)[shown].all()
    found = analysis.scored(Cheat(transitions, np.full(len(transitions.actions), not right)), SeedTree(0))
    runs = [Measured(agent="imagination", seed=seed, episodes=9, value=found) for seed in (0, 1)]
    image, _ = analysis.figure(runs)
    left = image.shape[1] - 6 * 140 - 12
    before = image[62:190, left : left + 128]
    assert np.array_equal(before[::2, ::2], transitions.frames[shown[0]])
    colors = {tuple(color) for color in image[-200:].reshape(-1, 3).tolist()}
    assert (filmstrips.RIGHT in colors, filmstrips.WRONG in colors) == (right, not right)


def test_half_wrong_is_half(analysis: GeneralisationAnalysis, transitions: TransitionSet) -> None:
    wrong = np.arange(len(transitions.actions)) % 2 == 0
    _, result = analysis.scored(Cheat(transitions, wrong), SeedTree(0))
    assert result.unseen.right == result.seen.right == result.auroc == 0.5


def test_scores_by_what_comes_of_it(analysis: GeneralisationAnalysis, transitions: TransitionSet) -> None:
    fails = np.array([outcome.terminated and not outcome.success for (outcome,) in transitions.possible])
    _, found = analysis.scored(Cheat(transitions, fails), SeedTree(0))
    scores = found.consequences
    assert sum(one.count for one in scores.values()) == int((~transitions.terminal).sum())
    assert scores["failure"].count == int((fails & ~transitions.terminal).sum()) > 0
    assert (scores["failure"].right, scores["failure"].end_right) == (0.0, 0.0)
    assert scores["failure"].reward_error == pytest.approx(2.0)
    for name in ("success", "the episode goes on"):
        assert (scores[name].right, scores[name].end_right, scores[name].reward_error) == (1.0, 1.0, pytest.approx(0.0))


class Expert(Cheat):
    """Also says what it holds likeliest, which is right where it visited the transition, and its visits."""

    def __init__(self, transitions: TransitionSet, wrong: NDArray[np.bool_], visits: NDArray[np.int64]) -> None:
        super().__init__(transitions, wrong)
        self.visits = visits

    def predict_map(self, frames: Frame, actions: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        assert np.array_equal(frames, self.transitions.frames) and np.array_equal(actions, self.transitions.actions)
        truths = np.array([truth.macrostate for (truth,) in self.transitions.possible])
        return np.where(self.visits[:, None] > 0, truths, self.transitions.macrostates)

    def replayed(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return self.transitions.macrostates.repeat(self.visits, axis=0), self.transitions.actions.repeat(self.visits)


def test_scores_by_visit_count(analysis: GeneralisationAnalysis, transitions: TransitionSet) -> None:
    seen = np.flatnonzero(~transitions.terminal)
    visits = np.zeros(len(transitions.actions), dtype=np.int64)
    visits[seen[:100]], visits[seen[100:200]], visits[seen[200:203]] = 1, 9, 10
    wrong = np.isin(np.arange(len(visits)), [*seen[:50], *seen[200:202]])
    predictions, found = analysis.scored(Expert(transitions, wrong, visits), SeedTree(0))
    assert np.array_equal(predictions.visit_count, visits)
    assert (found.unseen.likeliest_right, found.seen.likeliest_right) == (0.0, pytest.approx(203 / 324))
    assert (found.unseen.right, found.seen.right) == (1.0, pytest.approx(272 / 324))
    assert [(part.count, part.right, part.likeliest_right) for part in found.visit_counts.values()] == [
        (121, 1.0, 0.0), (200, 0.75, 1.0), (3, pytest.approx(1 / 3), 1.0),
    ]  # fmt: skip
    table = analysis.table([Measured(agent="imagination", seed=0, episodes=9, value=(predictions, found))])
    assert "| imagination, 9 episodes | 1 to 9 times | 200 | 75.0 | 100.0 |" in table
    assert "of all these by what the model holds likeliest, instead of what it samples, % | 0.0 | – |" in table


def test_rules_that_leave_it_open() -> None:
    end = Outcome(probability=0.5, macrostate=(0,), reward=0.0, terminated=True, success=False)
    on = dataclasses.replace(end, terminated=False)
    assert (consequence([end]), consequence([on]), consequence([end, on])) == ("failure", "the episode goes on", "open")


def test_a_task_without_terminal_macrostates_says_so(spec: TaskSpec) -> None:
    class Endless:
        n_actions = 1
        states = ((0,), (1,))

        def is_terminal(self, macrostate: tuple[int, ...]) -> bool:
            return False

    endless = dataclasses.replace(spec, id="endless", rules=Endless())  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="'endless' has no terminal macrostates in its rules"):
        GeneralisationAnalysis(endless, appearance="clean")


def test_table_and_files(analysis: GeneralisationAnalysis, transitions: TransitionSet, tmp_path: Path) -> None:
    found = analysis.scored(Cheat(transitions, transitions.terminal & transitions.legal), SeedTree(0))
    runs = [Measured(agent="imagination", seed=seed, episodes=9, value=found) for seed in (0, 1)]
    table = analysis.table(runs)
    assert "828 transitions out of terminal macrostates, 324 others; mean over seeds" in table
    assert "| imagination, 9 episodes (2 seed(s)) | thesis |" in table
    assert "remembers" not in table and "likeliest" not in table  # what this agent cannot say
    assert "| 87.0 [87.0, 87.0] | 75 (of 20) |" in table  # 720 of 828
    analysis.write(tmp_path / "out", runs, {})
    kept = json.loads((tmp_path / "out" / "summary.json").read_text(), parse_constant=pytest.fail)["runs"]
    assert [(run["seed"], run["unseen_likeliest"], run["seen"]) for run in kept] == [(0, None, 1.0), (1, None, 1.0)]
    rows = (tmp_path / "out" / "transitions.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * 192 * 6
