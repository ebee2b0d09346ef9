"""The open-loop comparison and its scores, with imaginers whose predictions are known."""

from __future__ import annotations

import dataclasses

import bench_fakes
import gymnasium
import numpy as np
import pytest
from small_runs import context

from imagine_bench import registry
from imagine_bench.interfaces import Observation, Outcome, TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout
from imagine_bench.judge.imagination_quality import (
    EXAMPLES,
    SAMPLED_ROLLOUTS,
    OpenLoopStart,
    examples,
    imagine_sampled_rollouts,
    open_loop,
    open_loop_starts,
)
from imagine_bench.seeding import TUNING_SEEDS, SeedTree, evaluation_split


@pytest.fixture(scope="module")
def spec() -> TaskSpec:
    return registry.task("arrow_puzzle")


@pytest.fixture(scope="module")
def starts(spec: TaskSpec) -> tuple[OpenLoopStart, ...]:
    return open_loop_starts(spec, starts=40, depth=10, appearance="clean")


def only(belief: dict[tuple[int, ...], float]) -> tuple[int, ...]:
    (state,) = belief
    assert belief[state] == pytest.approx(1.0)
    return state


def test_the_rules_keep_every_rollout_alive(spec: TaskSpec, starts: tuple[OpenLoopStart, ...]) -> None:
    assert len(starts) == 40
    for start in starts:
        assert start.actions.shape == start.rewards.shape == (10,)
        assert (start.rewards == -1.0).all()
        before = None
        for action, belief in zip(start.actions, start.beliefs, strict=True):
            state = only(belief)
            assert not spec.rules.is_terminal(state)
            if before is not None:
                assert [outcome.macrostate for outcome in spec.rules.outcomes(before, int(action))] == [state]
            before = state


def test_blind_random_actions_would_not_stay_alive(spec: TaskSpec) -> None:
    """Non-vacuous: without the choice, nearly every rollout of ten would end."""
    rng = np.random.default_rng(0)
    alive = 0
    for start in spec.rules.start_states:
        state, over = start, False
        for _ in range(10):
            (outcome,) = spec.rules.outcomes(state, int(rng.integers(6)))
            state, over = outcome.macrostate, over or outcome.terminated
        alive += not over
    assert alive <= 1


def test_actions_vary_and_starts_repeat(spec: TaskSpec, starts: tuple[OpenLoopStart, ...]) -> None:
    again = open_loop_starts(spec, starts=40, depth=10, appearance="clean")
    assert all(np.array_equal(a.frame, b.frame) for a, b in zip(starts, again, strict=True))
    assert all(np.array_equal(a.actions, b.actions) for a, b in zip(starts, again, strict=True))
    assert len({tuple(start.actions) for start in starts}) > 30


class KnowsTheTruth(bench_fakes.RulesImaginer):
    """Right until ``wrong_from``, then wrong in one coordinate; finds its start by its frame and actions."""

    def __init__(self, starts: tuple[OpenLoopStart, ...]) -> None:
        super().__init__(context())
        self.starts = starts

    def imagine(self, frame, *, actions, depth, rng) -> ImaginedRollout:  # type: ignore[no-untyped-def]
        (start,) = [q for q in self.starts if q.frame is frame and q.actions is actions]
        blank = super().imagine(frame, actions=actions, depth=depth, rng=rng)
        states = np.array([only(belief) for belief in start.beliefs])
        states[self.wrong_from - 1 :, 3] += 1
        return dataclasses.replace(blank, macrostates=states)


def test_scores_by_depth(starts: tuple[OpenLoopStart, ...]) -> None:
    loop = open_loop(KnowsTheTruth(starts), starts, SeedTree(0))
    assert loop.count.tolist() == [40] * 10
    assert loop.correct.tolist() == loop.accepted.tolist() == [1.0] * 3 + [0.0] * 7
    assert loop.correct_accepted[:3].tolist() == [1.0] * 3
    assert np.isnan(loop.correct_accepted[3:]).all()
    assert loop.reward_mae.tolist() == [0.5] * 10  # it says -0.5, the rules say -1
    assert loop.termination_error.tolist() == [0.0] * 3 + [1.0] * 7
    assert (loop.epistemic[0], loop.aleatoric[0], loop.modal[0]) == (0.25, 0.5, 0.75)


class Unsure(bench_fakes.RulesImaginer):
    """Wrong at depth 3 in every other rollout, where its epistemic uncertainty is high; modal is high where right."""

    def __init__(self, starts: tuple[OpenLoopStart, ...]) -> None:
        super().__init__(context())
        self.starts = starts

    def imagine(self, frame, *, actions, depth, rng) -> ImaginedRollout:  # type: ignore[no-untyped-def]
        (index,) = [i for i, q in enumerate(self.starts) if q.frame is frame and q.actions is actions]
        blank = super().imagine(frame, actions=actions, depth=depth, rng=rng)
        states = np.array([only(belief) for belief in self.starts[index].beliefs])
        epistemic, modal = np.full(depth, 0.1, np.float32), np.full(depth, 0.9, np.float32)
        if index % 2:
            states[2:, 3] += 1
            epistemic[2], modal[2] = 0.8, 0.2
        return dataclasses.replace(blank, macrostates=states, epistemic=epistemic, modal=modal)


def test_uncertainty_is_held_to_the_errors_it_should_find(starts: tuple[OpenLoopStart, ...]) -> None:
    loop = open_loop(Unsure(starts), starts, SeedTree(0))
    half = len(starts) // 2
    assert loop.judged.tolist() == [len(starts)] * 3 + [len(starts) - half] * 7  # after an error nobody is judged
    assert loop.auroc_epistemic[2] == 1.0 and loop.auroc_modal[2] == 0.0 and loop.auroc_aleatoric[2] == 0.5
    assert np.isnan(loop.auroc_epistemic[[0, 1, 3, 9]]).all()  # nothing is wrong there


def test_examples_stand_beside_the_truth(spec: TaskSpec) -> None:
    agent = bench_fakes.RulesImaginer(context())
    first = examples(agent, spec, appearance="clean", seeds=SeedTree(0))
    again = examples(agent, spec, appearance="clean", seeds=SeedTree(0))
    assert len(first) == EXAMPLES
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.rollout.frames, other.rollout.frames)
        assert np.array_equal(one.real_frames, other.real_frames)
        assert one.real_frames.shape == (10, 64, 64, 3) and one.real_macrostates.shape == (10, 4)
        assert one.real_terminated[-1]  # always turning the left cube ends in two arrows alike


def test_examples_of_a_run_that_tunes_begin_elsewhere(spec: TaskSpec) -> None:
    agent = bench_fakes.RulesImaginer(context())
    reported, tuning = (
        examples(agent, spec, appearance="clean", seeds=SeedTree(0), purpose=evaluation_split(seed))
        for seed in (0, TUNING_SEEDS)
    )
    assert [e.start_macrostate.tolist() for e in reported] != [e.start_macrostate.tolist() for e in tuning]


class _Coin:
    """Two safe states and a pit; action 1 always falls, action 0 falls from state 1 half the time."""

    states = ((0,), (1,), (2,))
    start_states = ((0,), (1,))

    def outcomes(self, macrostate: tuple[int, ...], action: int) -> tuple[Outcome, ...]:
        pit = Outcome(0.5, (2,), -5.0, True, False)
        safe = Outcome(0.5, (0,), -1.0, False, False)
        if action == 1:
            return (dataclasses.replace(pit, probability=1.0),)
        return (pit, safe) if macrostate == (1,) else (dataclasses.replace(safe, probability=1.0),)


def test_random_rules_give_only_starts_that_surely_stay_alive(spec: TaskSpec) -> None:
    coin = dataclasses.replace(
        spec,
        rules=_Coin(),  # type: ignore[arg-type]
        action_names=("stay", "jump"),
        render_macrostates=lambda states, appearance, rng: np.zeros((len(states), 64, 64, 3), np.uint8),
    )
    found = open_loop_starts(coin, starts=8, depth=3, appearance="clean")
    assert len(found) == 8
    assert all(start.actions.tolist() == [0, 0, 0] for start in found)  # from (0,) alone, staying


def labelled(task: str) -> TaskSpec:
    """A task whose frames show what they show as numbers: one more than each coordinate, 0 for a hidden one."""

    def render(states: np.ndarray, appearance: str, rng: np.random.Generator) -> np.ndarray:
        frames = np.zeros((len(states), 64, 64, 3), dtype=np.uint8)
        frames[:, 0, : states.shape[1], 0] = states + 1
        return frames

    return dataclasses.replace(registry.task(task), render_macrostates=render)


class Perfect(bench_fakes.RulesImaginer):
    """Imagines what the environment itself shows, from a start that its first frame cannot tell from the real one."""

    fresh = False

    def __init__(self, spec: TaskSpec) -> None:
        super().__init__(context())
        self.spec, self.env = spec, gymnasium.make(spec.env_id, execution="kinematic", disable_env_checker=True)

    def begin_episode(self) -> None:
        self.fresh = True

    def act(self, observation: Observation, *, explore: bool) -> int:
        self.fresh = False
        return 0

    def imagine(self, frame, *, actions, depth, rng) -> ImaginedRollout:  # type: ignore[no-untyped-def]
        assert self.fresh, "it is asked in the middle of an episode"
        actions = np.zeros(depth, dtype=np.int64) if actions is None else actions
        shown = frame[0, : len(self.spec.macrostate_names), 0].astype(int) - 1
        alike = [state for state in self.spec.rules.start_states if ((shown == state) | (shown < 0)).all()]
        start = alike[int(rng.integers(len(alike)))]
        looks = (self.env.reset(seed=int(rng.integers(2**31)), options={"macrostate": start})[1] for _ in range(100))
        next(info for info in looks if np.array_equal(info.get("shown", info["macrostate"]), shown))
        infos = [self.env.step(action)[4] for action in actions]
        blank = super().imagine(frame, actions=actions, depth=depth, rng=rng)
        read = [self.spec.as_observed(info.get("shown", info["macrostate"])) for info in infos]
        return dataclasses.replace(blank, macrostates=np.array(read))


@pytest.mark.parametrize(
    ("task", "depth"),
    [("pick_place:gesture=first", 1), ("arrows:cubes=3,gesture=0.5,lag=2", 5), ("arrows:cubes=3,gesture=0.0", 5)],
)
def test_who_imagines_what_frames_will_show_is_right(task: str, depth: int) -> None:
    spec = labelled(task)
    starts = open_loop_starts(spec, starts=12, depth=5, appearance="clean")
    agent = Perfect(spec)
    agent.act(Observation(frame=starts[0].frame), explore=False)  # the last frame of a test episode
    loop = open_loop(agent, starts, SeedTree(0))
    assert loop.correct.tolist() == [1.0] * depth


def test_examples_and_samples_begin_an_episode() -> None:
    spec = labelled("pick_place:gesture=first")
    agent = Perfect(spec)
    agent.act(Observation(frame=np.zeros((64, 64, 3), np.uint8)), explore=False)
    found = examples(agent, spec, appearance="clean", seeds=SeedTree(0))
    agent.fresh = False
    found += imagine_sampled_rollouts(agent, spec, appearance="clean", seeds=SeedTree(0))
    assert len(found) == EXAMPLES + SAMPLED_ROLLOUTS
    for each in found:  # chance goes as was imagined, as far as frames tell
        until = int(each.real_terminated.argmax()) if each.real_terminated.any() else len(each.real_terminated)
        assert np.array_equal(each.real_macrostates[:until], each.rollout.macrostates[:until])
