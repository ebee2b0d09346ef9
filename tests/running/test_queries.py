"""The teaching of learners: demonstrations, answers, and earlier tasks of the same world."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_runs
from bench_fakes import Pupil
from imagine_bench.tasks.arrows.rules import ArrowRules
from small_runs import KilledError, final_arrays, measured, run_observed, small

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation, Transition
from imagine_bench.interfaces.capabilities import Label
from imagine_bench.protocols.data import RunSpec
from imagine_bench.rules import fewest_actions
from imagine_bench.running import runner
from imagine_bench.running.evaluation import LabelOracle, QueryBudget, Teacher, as_seen
from imagine_bench.store import encoders
from imagine_bench.store.results import RunResult
from imagine_bench.store.run_folder import load_newest


@pytest.fixture(autouse=True)
def pupils() -> list[Pupil]:
    Pupil.made.clear()
    return Pupil.made


def do(folder: Path, **changes: Any) -> RunResult:
    few = {"agents": ("pupil",), "budgets": (6,), "evaluation_episodes": 1}
    return small_runs.do(folder, "pupil", **{**few, **changes})


# --- demonstrations ----------------------------------------------------------------------------------------------


def test_a_demonstration_keeps_its_images_and_hides_the_truth() -> None:
    state = np.array([1, 2, 0, 1])
    images = [np.full((64, 64, 3), shade, np.uint8) for shade in (1, 2)]
    before, after = (Observation(frame=image, macrostate=state, shown=state) for image in images)
    ends = {"terminated": True, "truncated": False}
    seen = as_seen(Transition(observation=before, action=3, reward=50.0, next_observation=after, **ends))
    for real, given in ((before, seen.observation), (after, seen.next_observation)):
        assert np.array_equal(given.frame, real.frame)
        assert given.macrostate is None and given.shown is None
    assert (seen.action, seen.reward, seen.terminated, seen.truncated) == (3, 50.0, True, False)


def test_demonstrations_are_optimal_and_seen_as_frames(tmp_path: Path) -> None:
    plain, shown = do(tmp_path / "plain"), do(tmp_path / "shown", demonstrations=4, feedback=3.0)
    assert shown.training_success[:4].all() and not plain.training_success.all()
    assert shown.training is not None
    fewest = [fewest_actions(registry.task("arrow_puzzle").rules, tuple(s)) for s in shown.training.starts[:4].tolist()]
    assert shown.training_length[:4].tolist() == fewest, "shortest plans"
    taught = Pupil.made[1]
    starts = [{e: each.observation.frame.tobytes() for e, each in reversed(pupil.shown)} for pupil in Pupil.made]
    assert starts[0] == starts[1], "the same six starts, whoever acts"
    for episode, transition in taught.shown:
        assert transition.observation.macrostate is None and transition.next_observation.macrostate is None
        assert (transition.reward in (-5.0, -1.0, 50.0)) == (episode < 4), "a teacher says nothing of another's action"
        assert episode >= 4 or transition.reward == (50.0 if transition.terminated else -1.0)
    assert sum(episode < 4 for episode, _ in taught.shown) == shown.training_length[:4].sum()


# --- queries -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", registry.TASKS)
def test_answers_are_the_rules_and_chance_has_none(task: str) -> None:
    """They are about the last action, and go through ends."""
    rules = registry.task(task).rules
    oracle, answered, refused = LabelOracle(rules), 0, 0
    for state in rules.states:
        for first in range(rules.n_actions):
            single = {Label(each.reward, each.terminated) for each in rules.outcomes(state, first)}
            answer = oracle.label(state, np.array([first]))
            assert answer == (single.pop() if len(single) == 1 else None)
            for second in range(rules.n_actions):
                possible = {
                    Label(after.reward, after.terminated)
                    for each in rules.outcomes(state, first)
                    for after in rules.outcomes(each.macrostate, second)
                }
                answer = oracle.label(state, np.array([first, second]))
                assert answer == (next(iter(possible)) if len(possible) == 1 else None)
                answered, refused = answered + (answer is not None), refused + (answer is None)
    by_chance = any(len(rules.outcomes(state, a)) > 1 for state in rules.states for a in range(rules.n_actions))
    assert answered > 0 and (refused > 0) == by_chance


def test_an_answer_is_of_where_the_scene_is_however_late_its_frame() -> None:
    learner, oracle, here, before = Pupil(small_runs.context()), LabelOracle(ArrowRules()), (3, 1, 2, 0), (2, 1, 3, 0)
    QueryBudget(learner, oracle, 30)(
        Observation(frame=np.zeros((64, 64, 3), np.uint8)), {"macrostate": np.array(here), "shown": np.array(before)}
    )
    assert [label for _, label in learner.answers] == [oracle.label(here, actions) for actions, _ in learner.answers]
    assert any(label != oracle.label(before, actions) for actions, label in learner.answers)
    for actions in ([], [6], [0, -1]):
        with pytest.raises(InvalidValueError, match="give at least one, each from 0 to 5"):
            oracle.label(here, np.array(actions))


def test_no_more_queries_than_allowed_and_no_macrostate(tmp_path: Path) -> None:
    do(tmp_path / "run", queries=3, demonstrations=2)
    (pupil,) = Pupil.made
    last = load_newest(tmp_path / "run" / "checkpoints")
    assert last is not None and last.values["queries"] == [0, 0, 3, 3, 3, 3], "a watching learner does not ask"
    assert len(pupil.answers) == 12
    assert all(answer is not None for _, answer in pupil.answers), "this puzzle leaves nothing to chance"
    assert len({answer for _, answer in pupil.answers}) > 1
    assert all(observation.macrostate is None for observation in pupil.seen)


# --- feedback ----------------------------------------------------------------------------------------------------


def feedback_of(folder: Path, seed: int = 0, **changes: Any) -> list[list[tuple[bool, bool]]]:
    """Per training episode and macro-action: whether it was optimal, by counting plans, and whether it was praised."""
    played = do(folder, seed=seed, seeds=(seed,), feedback=3.0, budgets=(30,), **changes).training
    assert played is not None
    shown = iter(Pupil.made[-1].shown)
    rules, found = registry.task("arrow_puzzle").rules, []
    for episode, start in enumerate(played.starts.tolist()):
        state = tuple(start)
        found.append(list[tuple[bool, bool]]())
        for action in played.actions_of(episode):
            ((outcome,), (number, seen)) = rules.outcomes(state, action), next(shown)
            goes_on = 1 + fewest_actions(rules, outcome.macrostate) if not outcome.terminated else 999
            assert (number, seen.action, seen.observation.macrostate) == (episode, action, None)
            assert abs(seen.reward - outcome.reward) == 3.0
            optimal = (1 if outcome.success else goes_on) == fewest_actions(rules, state)
            found[-1].append((optimal, seen.reward > outcome.reward))
            state = outcome.macrostate
    assert next(shown, None) is None
    return found


def test_feedback_is_reward_for_optimal_actions(tmp_path: Path) -> None:
    """An action is optimal where it leads to a goal by as few actions as any."""
    found = [each for episode in feedback_of(tmp_path / "run") for each in episode]
    assert all(optimal == praised for optimal, praised in found)
    assert 5 < sum(optimal for optimal, _ in found) < len(found) - 5


def test_a_noisy_teacher_errs_elsewhere_in_each_episode_and_run(tmp_path: Path) -> None:
    """At an error of 0.5 the first macro-actions of 30 episodes are all judged alike with probability 2e-9."""
    firsts = []
    for seed in (0, 1):
        found = feedback_of(tmp_path / str(seed), seed, feedback_error=0.5)
        firsts.append([optimal != praised for optimal, praised in (episode[0] for episode in found)])
        assert len(set(firsts[-1])) == 2
    assert firsts[0] != firsts[1]


def test_a_noisy_teacher_errs_as_often_as_said() -> None:
    rules = registry.task("arrow_puzzle").rules
    teacher = Teacher(rules, 1.0, 0.2)
    start = (3, 1, 2, 0)
    seen = Observation(frame=np.zeros((64, 64, 3), np.uint8))
    lived = Transition(
        observation=seen, action=rules.optimal_action(start), reward=-1.0, next_observation=seen, terminated=False,
        truncated=False,
    )  # fmt: skip

    def told(episode: int) -> list[float]:
        teacher.begin(episode)
        teacher(seen, {"macrostate": np.array(start)})
        return [teacher.told(lived).reward for _ in range(4_000)]

    rewards = told(0)
    others = told(1)
    assert set(rewards) == {0.0, -2.0} and rewards != others and told(0) == rewards
    wrong = np.mean(np.array(rewards + others) == -2.0)
    assert abs(wrong - 0.2) < 4 * np.sqrt(0.2 * 0.8 / 8_000)


# --- earlier tasks -----------------------------------------------------------------------------------------------


def test_earlier_tasks_come_first_on_episodes_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, real = [], runner.play

    def watching(env: Any, agent: Any, *, seed: int, **options: Any) -> Any:
        seeds.append((env.spec.id.partition("/")[2], seed))
        return real(env, agent, seed=seed, **options)

    monkeypatch.setattr(runner, "play", watching)
    earlier = ("arrow_puzzle_hard", "arrow_puzzle_toward")
    result = do(tmp_path / "run", after=earlier, after_episodes=3)
    (pupil,) = Pupil.made
    assert pupil.carried == [3, 3], "once after each earlier task, on its own episodes"
    assert {episode for episode, _ in pupil.shown} == set(range(6)), "episodes are counted from 0 on each task"
    names = ["ArrowPuzzleHard-v0"] * 3 + ["ArrowPuzzleToward-v0"] * 3 + ["ArrowPuzzle-v0"] * 6
    assert [name for name, _ in seeds] == names
    assert len({seed for _, seed in seeds}) == 12
    alone = do(tmp_path / "alone")
    assert [seed for _, seed in seeds[6:12]] == [seed for _, seed in seeds[12:18]], "pairs: the same starts"
    assert result.checkpoints[0].env_steps == result.training_length.sum()
    assert len(result.training_length) == len(alone.training_length) == 6
    do(tmp_path / "other", seed=1, seeds=(1,), after=earlier, after_episodes=3)
    assert {seed for _, seed in seeds[18:]}.isdisjoint(seed for _, seed in seeds[:18]), "of another seed others"


def test_an_unannounced_change_stays_hidden(tmp_path: Path) -> None:
    result = do(
        tmp_path / "run",
        after=("arrow_puzzle_hard", "arrow_puzzle_toward"),
        after_episodes=3,
        unannounced=True,
        demonstrations=2,
    )
    (pupil,) = Pupil.made
    assert pupil.carried == []
    assert [*dict.fromkeys(episode for episode, _ in pupil.shown)] == list(range(12))
    assert result.checkpoints[0].env_steps == result.training_length.sum(), "budgets count the last task alone"


# --- all of it, killed and resumed -------------------------------------------------------------------------------


def test_a_killed_and_taught_learner_ends_in_the_same_bits(
    tmp_path: Path, die_after_saves: Callable[..., None]
) -> None:
    agent = "factored:given"
    encoder = encoders.own(registry.task("arrow_puzzle"), "clean", kind=registry.agent_entry(agent).encoder_kind)
    taught = {"demonstrations": 2, "queries": 2, "feedback": 1.0, "feedback_error": 0.3}
    after = {"after": ("arrow_puzzle_hard", "arrow_puzzle_toward"), "after_episodes": 2}
    wanted = small(agents=(agent,), budgets=(3, 5), evaluation_episodes=1, **after, **taught)

    def go(folder: Path, every_s: float) -> RunResult:
        spec = RunSpec(protocol=wanted, agent=agent, seed=1, encoder=encoder, checkpoint_every_s=every_s)
        return run_observed(spec, folder, lambda progress: None)

    whole = go(tmp_path / "whole", 1e9)
    die_after_saves(1, 2, 5, 7)  # on the first task, right after it, while watching, while asking
    for _ in range(4):
        with pytest.raises(KilledError):
            go(tmp_path / "run", 0.0)
    resumed = go(tmp_path / "run", 0.0)
    assert measured(whole) == measured(resumed)
    assert np.array_equal(whole.tried, resumed.tried)
    before, after = final_arrays(tmp_path / "whole"), final_arrays(tmp_path / "run")
    assert set(before) == set(after)
    assert [name for name in before if before[name].tobytes() != after[name].tobytes()] == []
