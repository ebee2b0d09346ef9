"""Learning from a dataset first: its transitions are experience as any, whatever format they come in."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_fakes import Pupil, TableAgent
from small_runs import collected, final_arrays, measured, run_observed, written

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Transition
from imagine_bench.protocols.data import OnProgress, RunSpec
from imagine_bench.rules import states_of
from imagine_bench.running.bench import plan
from imagine_bench.running.control import plan_control
from imagine_bench.store.results import RunResult
from imagine_bench.store.run_folder import load_newest

_FEW: dict[str, Any] = {
    "seeds": (0,), "evaluation_episodes": 2, "execution": "kinematic", "open_loop_starts": 0,
    "recorded_episodes": 0, "appearance": "mild",
}  # fmt: skip


@pytest.fixture(autouse=True)
def pupils() -> list[Pupil]:
    Pupil.made.clear()
    return Pupil.made


def spec_of(dataset: Path | None, agent: str = "pupil", **changes: Any) -> RunSpec[Any]:
    wanted, paths = plan_control("arrow_puzzle", "smoke", dataset=dataset, **{"agents": (agent,), **_FEW, **changes})
    encoder = next((path for kind, path in paths.items() if kind != "dataset"), None)
    return RunSpec(protocol=wanted, agent=agent, seed=0, encoder=encoder, dataset=paths.get("dataset"))


def run(folder: Path, spec: RunSpec[Any], on_progress: OnProgress = lambda progress: None) -> RunResult:
    result = run_observed(spec, folder, on_progress)
    assert result is not None
    return result


def facts(transition: Transition) -> tuple[Any, ...]:
    frames = (transition.observation.frame.tobytes(), transition.next_observation.frame.tobytes())
    return (*frames, transition.action, transition.reward, transition.terminated, transition.truncated)


def test_the_learner_sees_the_transitions_and_no_state(tmp_path: Path) -> None:
    episodes = collected()[0]
    result = run(tmp_path / "run", spec_of(written(tmp_path / "set").folder))
    pupil = Pupil.made[-1]
    before, _ = episodes.rows
    frames = [frame.tobytes() for frame in episodes.frames]
    steps = zip(episodes.actions, episodes.rewards, episodes.terminated, episodes.truncated, strict=True)
    wanted = [(frames[row], frames[row + 1], *step) for row, step in zip(before, steps, strict=True)]
    assert [facts(transition) for _, transition in pupil.shown] == wanted
    assert [episode for episode, _ in pupil.shown] == np.repeat(np.arange(6), episodes.lengths).tolist()
    for _, transition in pupil.shown:
        assert transition.observation.macrostate is None and transition.next_observation.macrostate is None
    tested = sum(row.mean_length * row.test_episodes for row in result.checkpoints)
    rules = registry.task("arrow_puzzle").rules
    asked = sum(not rules.is_terminal(state) for state in states_of(rules))
    assert len(pupil.seen) == tested + asked, "it acts in tests, and for each macrostate, to find causes of failures"
    assert all(seen.macrostate is None for seen in pupil.seen)


def test_a_dataset_is_experience_and_budgets_count_it(tmp_path: Path) -> None:
    episodes, folder = collected()[0], written(tmp_path / "set").folder
    offline = run(tmp_path / "offline", spec_of(folder))
    assert [row.episodes for row in offline.checkpoints] == [6], "without budgets, the dataset is all"
    assert offline.checkpoints[0].env_steps == len(episodes.actions)
    assert offline.training_success.tolist() == episodes.success.tolist()
    assert offline.training_length.tolist() == episodes.lengths.tolist()
    further = run(tmp_path / "further", spec_of(folder, budgets=(3, 8)))
    first, second = further.checkpoints
    assert first.env_steps == episodes.lengths[:3].sum() and second.env_steps > len(episodes.actions)
    assert further.training_success[:6].tolist() == episodes.success.tolist()


def test_in_an_unannounced_change_a_datasets_episodes_are_counted_on(tmp_path: Path) -> None:
    changes = {"budgets": (8,), "after": ("arrow_puzzle_hard",), "after_episodes": 3, "unannounced": True}
    run(tmp_path / "run", spec_of(written(tmp_path / "set").folder, **changes))
    assert [*dict.fromkeys(episode for episode, _ in Pupil.made[-1].shown)] == list(range(3 + 8))


class Killed(TableAgent):
    """Is killed once, in the middle of its third episode, if it may be."""

    kills = 0

    def observe(self, transition: Transition, *, episode: int) -> None:
        if episode == 2 and Killed.kills > 0:
            Killed.kills -= 1
            raise KeyboardInterrupt
        super().observe(transition, episode=episode)


@pytest.mark.usefixtures("own_names")
def test_a_kill_within_a_dataset_changes_no_bit(tmp_path: Path) -> None:
    registry.AGENTS["killed"] = dataclasses.replace(registry.AGENTS["table"], make=f"{__name__}:Killed")
    spec = spec_of(written(tmp_path / "set").folder, "killed", budgets=(4, 8))
    whole = run(tmp_path / "whole", spec)
    often = dataclasses.replace(spec, checkpoint_every_s=0.0)
    Killed.kills = 1
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "killed", often)
    left = load_newest(tmp_path / "killed" / "checkpoints")
    assert left is not None and left.episode == 2
    assert measured(run(tmp_path / "killed", often)) == measured(whole)
    assert final_arrays(tmp_path / "killed")["table"].tobytes() == final_arrays(tmp_path / "whole")["table"].tobytes()


def test_a_dataset_that_changed_since_is_refused(tmp_path: Path) -> None:
    spec = spec_of(written(tmp_path / "set").folder, "table")
    shutil.rmtree(tmp_path / "set")
    other = written(tmp_path / "set", episodes=3)
    with pytest.raises(ArtefactError, match=f"is {other.identity}, and this bench is of mixed-6@"):
        run(tmp_path / "run", spec)


@pytest.mark.parametrize(
    ("task", "changes", "words"),
    [
        ("arrow_puzzle", {"agents": ("sb3_dqn_latents",)}, "trains in a loop of its own; leave --dataset out, or"),
        ("arrow_puzzle", {"agents": ("q_learning_macrostate",)}, "is shown true macrostates; leave --dataset out, or"),
        ("arrow_puzzle", {"demonstrations": 2}, "Both a dataset and demonstrations would come first; give one"),
        # an encoder for clean frames would make nothing of these
        ("arrow_puzzle", {"appearance": "clean"}, "frames of appearance mild, not clean; give --appearance mild, and"),
        ("pick_place", {}, "is of arrow_puzzle with 6 macro-actions; give one of pick_place, which has"),
        ("arrow_puzzle_hard", {}, "is of arrow_puzzle with 6 macro-actions; give one of arrow_puzzle_hard, which has"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(tmp_path: Path, task: str, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        plan(task, "smoke", dataset=written(tmp_path / "set").folder, **{**_FEW, **changes})


@pytest.mark.parametrize("help_given", ["after", "dataset"])
def test_a_split_keeps_the_starts_of_tests_out_of_all_training(tmp_path: Path, help_given: str) -> None:
    value = written(tmp_path / "set").folder if help_given == "dataset" else ("arrow_puzzle_toward",)
    with pytest.raises(InvalidValueError, match=f"those of --{help_given} begin anywhere; leave one of the two out"):
        plan_control("arrow_puzzle", "smoke", agents=("pupil",), split="values=3:2", **{**_FEW, help_given: value})


@pytest.mark.parametrize("option", ["feedback", "queries"])
def test_a_learner_that_only_watches_is_taught_nothing_more(tmp_path: Path, option: str) -> None:
    taught: dict[str, Any] = {option: 1, "agents": ("factored:given",), **_FEW, "appearance": "clean"}
    with pytest.raises(InvalidValueError, match=f"watch all 6 training episodes, so --{option} changes nothing"):
        plan_control("arrow_puzzle", "smoke", demonstrations=9, budgets=(6,), **taught)
    watched = written(tmp_path / "set").folder
    with pytest.raises(InvalidValueError, match=f"watch all 6 training episodes, so --{option} changes nothing"):
        plan_control("arrow_puzzle", "smoke", dataset=watched, **{**taught, "appearance": "mild"})
    wanted, _ = plan_control("arrow_puzzle", "smoke", demonstrations=5, budgets=(6,), **taught)
    assert wanted.demonstrations == 5


def test_tests_may_look_otherwise_than_a_dataset(tmp_path: Path) -> None:
    wanted = spec_of(written(tmp_path / "set").folder, test_appearance="clean").protocol
    assert (wanted.appearance, wanted.test_appearance) == ("mild", "clean")
