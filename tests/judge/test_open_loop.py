"""The open-loop comparison and rollouts beside reality, with imaginers whose predictions are known."""

from __future__ import annotations

import dataclasses
from typing import Any

import bench_fakes
import gymnasium
import numpy as np
import pytest
from judged import labelled, shown
from numpy.typing import NDArray
from small_runs import context

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Frame, Outcome, State, TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout
from imagine_bench.judge.models import AgentModel
from imagine_bench.judge.open_loop import (
    EXAMPLES,
    SAMPLED_ROLLOUTS,
    Moment,
    examples,
    imagine_sampled_rollouts,
    open_loop,
    surviving_actions,
)
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.truth import shares
from imagine_bench.seeding import TUNING_SEEDS, SeedTree, evaluation_split

PUZZLE, PICK_PLACE = labelled("arrow_puzzle"), labelled("pick_place")
START = (0, 0, 0, 0)
"""The human points at the left object."""
ASKS_MIDDLE, ASKS_RIGHT, IMPOSSIBLE = (1, 0, 0, 1), (1, 0, 0, 2), (1, 1, 0, 2)


def asked(spec: TaskSpec, starts: int, depth: int) -> EvalSet:
    found = surviving_actions(spec, starts=starts, depth=depth, appearance="clean")
    assert found is not None
    return found


@pytest.fixture(scope="module")
def puzzle() -> EvalSet:
    return asked(PUZZLE, 40, 10)


def test_the_rules_keep_every_rollout_alive(puzzle: EvalSet) -> None:
    assert puzzle.asked.shape == (40, 10)
    for start, actions, steps in zip(puzzle.states, puzzle.asked.tolist(), puzzle.truth, strict=True):
        state = start
        for action, outcomes in zip(actions, steps, strict=True):
            (outcome,) = PUZZLE.rules.outcomes(state, action)
            state = outcome.macrostate
            assert not outcome.terminated and outcomes == {(state, False): (1.0, -1.0)}
    assert len(set(map(tuple, puzzle.asked.tolist()))) > 30, "actions vary"
    again = asked(PUZZLE, 40, 10)
    assert np.array_equal(again.frames, puzzle.frames) and np.array_equal(again.actions, puzzle.actions)


class Told(bench_fakes.RulesImaginer):
    """Imagines the truth of a set, one question after another, but for ``wrong``: (question, depth) pairs."""

    def __init__(self, known: EvalSet, wrong: NDArray[np.bool_]) -> None:
        super().__init__(context())
        self.known, self.wrong, self.question = known, wrong, 0

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        truth, wrong = self.known.truth[self.question], self.wrong[self.question]
        self.question += 1
        states = np.array([next(iter(shares(outcomes))) for outcomes in truth])
        states[wrong, 3] += 1
        unsure = {"epistemic": np.where(wrong, 0.8, 0.1), "modal": np.where(wrong, 0.2, 0.9)}
        rollout = super().imagine(frame, actions=actions, depth=depth, rng=rng)
        return dataclasses.replace(rollout, macrostates=states, accepted=rollout.accepted & ~wrong, **unsure)


def test_scores_by_depth(puzzle: EvalSet) -> None:
    """Uncertainty is held to the errors that it should find."""
    loop = open_loop(Told(puzzle, np.broadcast_to(np.arange(10) >= 3, (40, 10))), puzzle, SeedTree(0))
    assert loop.count.tolist() == [40] * 10
    assert loop.correct.tolist() == loop.accepted.tolist() == [1.0] * 3 + [0.0] * 7
    assert loop.correct_accepted[:3].tolist() == [1.0] * 3
    assert np.isnan(loop.correct_accepted[3:]).all()
    assert loop.reward_mae.tolist() == [0.5] * 10  # it says -0.5, the rules say -1
    assert loop.termination_error.tolist() == [0.0] * 3 + [1.0] * 7
    assert (loop.epistemic[0], loop.aleatoric[0], loop.modal[0]) == pytest.approx((0.1, 0.5, 0.9))
    wrong = np.zeros((40, 10), dtype=np.bool_)
    wrong[1::2, 2] = True  # every other rollout, at depth 3
    loop = open_loop(Told(puzzle, wrong), puzzle, SeedTree(0))
    assert loop.judged.tolist() == [40] * 3 + [20] + [40] * 6  # a transition that begins wrong is not judged
    assert (loop.auroc_epistemic[2], loop.auroc_modal[2], loop.auroc_aleatoric[2]) == (1.0, 0.0, 0.5)
    assert np.isnan(loop.auroc_epistemic[[0, 1, 3, 9]]).all()  # nothing is wrong there
    assert (loop.correct[2], loop.accepted[2], loop.correct_accepted[2]) == (0.5, 0.5, 1.0)


class Perfect(bench_fakes.RulesImaginer):
    """Imagines the environment's own frames, from a start that its first frame cannot tell from the real one."""

    def __init__(self, spec: TaskSpec) -> None:
        super().__init__(context())
        self.spec, self.env = spec, gymnasium.make(spec.env_id, execution="kinematic", disable_env_checker=True)

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        actions, seen = np.zeros(depth, dtype=np.int64) if actions is None else actions, shown(frame, self.spec)
        alike = [state for state in self.spec.rules.start_states if ((seen == state) | (seen < 0)).all()]
        start = alike[int(rng.integers(len(alike)))]
        looks = (self.env.reset(seed=int(rng.integers(2**31)), options={"macrostate": start})[1] for _ in range(100))
        next(info for info in looks if np.array_equal(info.get("shown", info["macrostate"]), seen))
        steps = [self.env.step(action) for action in actions]
        read = [self.spec.as_observed(info.get("shown", info["macrostate"])) for *_, info in steps]
        rollout = super().imagine(frame, actions=actions, depth=depth, rng=rng)
        rewards, ended = (np.array([float(step[part]) for step in steps]) for part in (1, 2))
        return dataclasses.replace(rollout, macrostates=np.array(read), rewards=rewards, p_terminated=ended)


@pytest.mark.parametrize(
    ("task", "depth"),
    [
        ("pick_place:gesture=first", 1),
        ("pick_place:lag=1", 1),
        ("arrows:cubes=2,gesture=0.5,lag=2", 4),
        ("arrows:cubes=2,gesture=0.0", 4),
    ],
)
def test_who_imagines_what_frames_will_show_is_right(task: str, depth: int) -> None:
    """Rewards and ends are those of the latest macro-action, however old the frame is."""
    spec = labelled(task)
    agent, found = Perfect(spec), asked(spec, 6, 4)
    loop = open_loop(agent, found, SeedTree(0))
    assert (loop.correct.tolist(), loop.reward_mae.tolist()) == ([1.0] * depth, [0.0] * depth)
    assert loop.termination_error.tolist() == [0.0] * depth


def test_examples_and_samples_go_as_imagined() -> None:
    spec = labelled("pick_place:gesture=first")
    agent = Perfect(spec)
    none, sampled = (
        imagine_sampled_rollouts(who, each, appearance="clean", seeds=SeedTree(0))
        for who, each in ((IMAGINER, PUZZLE), (agent, spec))
    )
    assert (len(none), len(sampled)) == (0, SAMPLED_ROLLOUTS), "only a task with chance has some"
    assert len({(each.start_frame.tobytes(), tuple(each.start_macrostate.tolist())) for each in sampled}) == 1
    for each in (*examples(agent, spec, appearance="clean", seeds=SeedTree(0)), *sampled):
        # chance goes as was imagined, as far as frames tell
        until = int(each.real_terminated.argmax()) if each.real_terminated.any() else len(each.real_terminated)
        assert np.array_equal(each.real_macrostates[:until], each.rollout.macrostates[:until])


IMAGINER = bench_fakes.RulesImaginer(context())


def test_examples_stand_beside_the_truth() -> None:
    first, again, tuning = (
        examples(IMAGINER, PUZZLE, appearance="clean", seeds=SeedTree(0), purpose=purpose)
        for purpose in ("evaluation", evaluation_split(0), evaluation_split(TUNING_SEEDS))
    )
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.rollout.frames, other.rollout.frames)
        assert np.array_equal(one.real_frames, other.real_frames)
        assert np.array_equal([shown(frame, PUZZLE) for frame in one.real_frames], one.real_macrostates)
        assert one.real_terminated[-1]  # always turning the left cube ends in two arrows alike
    starts = [[each.start_macrostate.tolist() for each in found] for found in (first, tuning)]
    assert starts[0] != starts[1], "a run that tunes begins elsewhere"
    few = examples(IMAGINER, PICK_PLACE, appearance="clean", seeds=SeedTree(0))
    assert len(PICK_PLACE.rules.start_states) < EXAMPLES == len(few) == len(first), "few starts have examples too"


@pytest.mark.parametrize("name", ["frames", "start_frame"])
@pytest.mark.parametrize("value", [255.0, -0.1, np.nan])
def test_images_out_of_range_are_refused_by_their_name(name: str, value: float) -> None:
    class Loud(bench_fakes.RulesImaginer):
        def imagine(self, *args: Any, **kwargs: Any) -> ImaginedRollout:
            rollout = super().imagine(*args, **kwargs)
            return dataclasses.replace(rollout, **{name: np.full_like(getattr(rollout, name), value)})

    said = rf"imagine\(\) gave {name} from {value:g} to {value:g}; give values from 0 to 1\."
    with pytest.raises(InvalidValueError, match=said):
        examples(Loud(context()), PUZZLE, appearance="clean", seeds=SeedTree(0))


@pytest.mark.parametrize(("value", "byte"), [(1.0005, 255), (-0.0005, 0), (0.5, 128)])
def test_images_that_rounding_put_out_of_range_are_shown(value: float, byte: int) -> None:
    class Rounded(bench_fakes.RulesImaginer):
        def imagine(self, *args: Any, **kwargs: Any) -> ImaginedRollout:
            rollout = super().imagine(*args, **kwargs)
            return dataclasses.replace(rollout, frames=np.full_like(rollout.frames, value))

    frames, actions = np.zeros((1, 1, 64, 64, 3), dtype=np.uint8), np.zeros((1, 2), dtype=np.int64)
    pictures = AgentModel(Rounded(context())).imagine(frames, actions, 1, np.random.default_rng(0)).pictures
    assert (pictures == byte).all()


@pytest.mark.parametrize("lag", [0, 1])
def test_reality_goes_as_was_imagined_where_it_may(lag: int) -> None:
    """Picking the left object, which late frames show late. By luck, ten draws would not all be the imagined one."""
    frame = np.zeros((64, 64, 3), dtype=np.uint8)
    spec = labelled("pick_place:lag=1") if lag else PICK_PLACE
    moment = Moment(spec=spec, appearance="clean", frame=frame, macrostate=START)

    def reached(wish: State, draws: int) -> set[State]:
        found = set()
        for rng in map(np.random.default_rng, range(draws)):
            rollout = IMAGINER.imagine(frame, actions=np.zeros(1 + lag, dtype=np.int64), depth=9, rng=rng)
            imagined = np.array([START, wish][1 - lag :])
            real = moment.beside(dataclasses.replace(rollout, macrostates=imagined), rng).real_macrostates
            assert real[:lag].tolist() == [list(START)] * lag
            found.add(tuple(real[lag]))
        return found

    for wish in (ASKS_MIDDLE, ASKS_RIGHT):
        assert reached(wish, 10) == {wish}
    assert reached(IMPOSSIBLE, 30) == {outcome.macrostate for outcome in PICK_PLACE.rules.outcomes(START, 0)}


class _Coin:
    """Two safe states and a pit; action 1 always falls, action 0 falls from state 1 half the time."""

    states = ((0,), (1,), (2,))
    start_states = ((0,), (1,))

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        falls = 1.0 if action else 0.5 * macrostate[0]
        possible = (Outcome(falls, (2,), -5.0, True, False), Outcome(1.0 - falls, (0,), -1.0, False, False))
        return tuple(outcome for outcome in possible if outcome.probability)


def test_random_rules_give_only_starts_that_surely_stay_alive() -> None:
    coin = dataclasses.replace(PUZZLE, rules=_Coin(), action_names=("stay", "jump"))  # type: ignore[arg-type]
    found = asked(coin, 8, 3)
    assert found.states == ((0,),) * 8 and (found.asked == 0).all()
    assert surviving_actions(coin, starts=0, depth=3, appearance="clean") is None
