"""A collected dataset is true: it can be replayed, its policies are as named, one seed is one content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest import mock

import gymnasium
import numpy as np
import pytest
from bench_fakes import TableAgent
from small_runs import Inline, collected, do, small

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Frame, Info
from imagine_bench.cli import exit_code as main
from imagine_bench.data.folder import read_dataset, write_dataset
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Observation
from imagine_bench.running.collect import collect, describe, policy_of
from imagine_bench.seeding import episode_seed
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.files import sealed, write_json
from imagine_bench.tools import standard_data

TASK = registry.task("arrow_puzzle")


@pytest.mark.parametrize("policy", ["mixed", "uniform"])
def test_replaying_the_actions_gives_every_frame_again(policy: str) -> None:
    episodes, apart, _ = collected(policy)
    hidden, frames, states = apart["privileged"], [], []
    assert hidden["seeds"].tolist() == [episode_seed("dataset", 0, k) for k in range(len(episodes))], "those of no run"

    def noted(frame: Frame, info: Info) -> None:
        frames.append(frame)
        states.append(info["macrostate"])

    with gymnasium.make(TASK.env_id, execution="kinematic", appearance="mild") as env:
        for index, seed in enumerate(hidden["seeds"].tolist()):
            steps, rows = episodes.steps(index)
            options = {"macrostate": hidden["macrostates"][rows][0]} if policy == "uniform" else None
            noted(*env.reset(seed=seed, options=options))
            for step in range(steps.start, steps.stop):
                frame, reward, terminated, truncated, info = env.step(int(episodes.actions[step]))
                noted(frame, info)
                assert (reward, terminated) == (episodes.rewards[step], episodes.terminated[step])
                assert truncated == episodes.truncated[step] or policy == "uniform"
            assert info["is_success"] == episodes.success[index]
    assert np.array_equal(frames, episodes.frames) and np.array_equal(states, hidden["macrostates"])


def test_macrostates_apart_are_true_however_late_and_hidden_the_frames_are() -> None:
    spec = registry.task("arrows:gesture=0.0,lag=1")
    given = {"episodes": 4, "seed": 2, "execution": "kinematic", "appearance": "clean"}
    episodes, apart, _ = collect(spec, policy_of("random", spec, 2), **given)
    for index in range(4):
        steps, rows = episodes.steps(index)
        state, *after = map(tuple, apart["privileged"]["macrostates"][rows].tolist())
        assert state in spec.rules.start_states
        for action, reached in zip(episodes.actions[steps].tolist(), after, strict=True):
            (outcome,) = spec.rules.outcomes(state, action)
            assert outcome.macrostate == reached
            state = reached


def test_one_seed_is_one_content_and_another_is_another() -> None:
    first, _, _ = collected(episodes=3)
    again, _, _ = collected.__wrapped__(episodes=3)
    other, _, _ = collected(episodes=3, seed=1)
    assert first.hash == again.hash != other.hash
    longer, _, _ = collected(episodes=6)
    assert np.array_equal(longer.frames[: len(first.frames)], first.frames), "more episodes begin with the same"
    (one, hidden, _), (other, others, _) = (collected("uniform", 6, seed) for seed in (0, 1))
    assert not np.array_equal(one.actions, other.actions)
    for name in ("macrostates", "seeds"):
        assert not np.array_equal(hidden["privileged"][name][::2], others["privileged"][name][::2]), name


def test_a_runs_agent_sees_as_in_its_run_and_through_the_given_encoder(tmp_path: Path) -> None:
    do(tmp_path / "run", "pupil_privileged", agents=("pupil_privileged",))
    ((_, privileged),) = policy_of(str(tmp_path / "run"), TASK, 0).players
    assert privileged
    wanted = small(agents=("dqn",), encoder=encoders.identity(encoders.own(TASK, "clean")))
    config = {"format": run_folder.FORMAT, "protocol": wanted.as_dict(), "agent": "dqn", "seed": 0, "settings": {}}
    write_json(tmp_path / "config.json", sealed(config))
    with pytest.raises(ArtefactError, match=r"through encoder arrow_puzzle-clean@.*, which arrow_puzzle-mild is not"):
        policy_of(str(tmp_path), TASK, 0, "arrow_puzzle-mild")


def test_the_oracle_is_optimal_and_chance_is_not() -> None:
    optimal, _, card = collected("oracle", episodes=20)
    chance, _, other = collected("random", episodes=20)
    assert optimal.success.all() and card["successes"] == 20 and card["optimum"] == 1.0
    assert other["successes"] == chance.success.sum() < 10
    assert card["mean_return"] == optimal.rewards.sum() / 20
    assert other["chance_level"] == TASK.facts().chance_level < 0.1
    mixed, _, _ = collected()
    assert mixed.success[1::2].all() and not mixed.success[::2].all(), "the oracle plays every other episode"


def test_uniform_is_one_action_from_any_open_macrostate() -> None:
    """200 draws of about 100 states: a state in which no episode begins is among them, and none in which all ended."""
    episodes, apart, _ = collected("uniform", episodes=200)
    starts = [tuple(state) for state in apart["privileged"]["macrostates"][::2].tolist()]
    open_states = {state for state in TASK.rules.states if not TASK.rules.is_terminal(state)}
    assert set(starts) <= open_states and len(set(starts)) > 0.6 * len(open_states)
    assert (episodes.lengths == 1).all() and np.array_equal(episodes.truncated, ~episodes.terminated)
    assert np.bincount(episodes.actions, minlength=6).min() > 15


def test_a_trained_agent_acts_greedily(tmp_path: Path) -> None:
    do(tmp_path / "run", agent="table")
    policy = policy_of(str(tmp_path / "run"), TASK, 0)
    agent, _ = policy.players[0]
    with mock.patch.object(TableAgent, "act", autospec=True, side_effect=TableAgent.act) as act:
        episodes, _, card = collect(TASK, policy, episodes=3, seed=0, execution="kinematic", appearance="clean")
    shown = [(call.kwargs["explore"], call.args[1].macrostate) for call in act.call_args_list]
    assert shown == [(False, None)] * len(episodes.actions), "greedy, and shown no macrostate"
    seen = [Observation(frame=frame) for frame in episodes.frames[episodes.rows[0]]]
    assert [agent.act(each, explore=False) for each in seen] == episodes.actions.tolist()
    assert card["policy"] == "table" and card["played"] == "greedy after 9 episodes of seed 0"
    with pytest.raises(InvalidValueError, match="learned arrow_puzzle, not pick_place; give a run of pick_place"):
        policy_of(str(tmp_path / "run"), registry.task("pick_place"), 0)


def test_the_arms_motion_is_kept_apart_where_asked_for() -> None:
    policy = policy_of("oracle", TASK, 0)
    episodes, apart, card = collect(
        TASK, policy, episodes=1, seed=0, execution="physics", appearance="clean", motion_hz=20
    )
    arm, total = apart["arm"], int(apart["arm"]["samples"].sum())
    assert len(arm["samples"]) == len(episodes.actions) and card["motion_hz"] == 20
    assert arm["joint_command_rad"].shape == (total, 7) and arm["tcp_in_world"].shape == (total, 7)
    begins = np.cumsum(arm["samples"]) - arm["samples"]
    assert (arm["time_s"][begins] == 0).all() and np.ptp(arm["joint_rad"], axis=0).max() > 0.1


def test_the_command_collects_and_describes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "set"
    words = ["dataset", "arrow_puzzle", "--policy", "oracle", "--episodes", "2", "--execution", "kinematic"]
    assert main([*words, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert main(["dataset", "--describe", str(out)]) == 0
    assert capsys.readouterr().out == said.partition("\n")[2], "the read dataset is the written one"
    rewards = read_dataset(out).episodes.rewards
    assert f"\nreturn        {rewards.sum() / 2:.2f} an episode\n" in said
    assert describe(read_dataset(out)) in said and "100.0% of episodes [34.2%" in said and "chance 4.6%" in said
    assert main([*words, "--out", str(out)]) == 2
    assert f"{out} exists; give another folder with --out. Nothing was written." in capsys.readouterr().err


def test_a_dataset_has_the_appearance_that_people_type(tmp_path: Path) -> None:
    episodes, apart, card = collected()
    stored = {**card, "appearance": appearance_name("patched")}
    found = write_dataset(tmp_path / "set", episodes, apart, stored, "npz")
    assert "kinematic execution, appearance patched\n" in describe(found)
    page = (tmp_path / "set" / "README.md").read_text()
    assert "| appearance | patched |" in page and "photo" not in page
    assert found.card is not None and found.card["appearance"] == "photo", "as files hold it"


def test_standard_sets_are_of_three_strengths_and_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(standard_data, "MEDIUM", {"arrow_puzzle": 3})
    monkeypatch.setattr(standard_data, "launcher", lambda *_: Inline())
    folders = list(standard_data.standard_sets(tmp_path, "npz", 4))
    assert [folder.name for folder in folders] == [f"arrow_puzzle-{name}" for name in ("random", "medium", "optimal")]
    cards = [read_dataset(folder).card or {} for folder in folders]
    assert [card["policy"] for card in cards] == ["random", "dqn", "oracle"]
    assert cards[1]["played"] == "greedy after 3 episodes of seed 1000" and cards[2]["successes"] == 4
    monkeypatch.setattr(standard_data, "collect", None)
    assert list(standard_data.standard_sets(tmp_path, "npz", 4)) == folders


def test_an_agent_called_as_a_policy_plays_whole_episodes() -> None:
    """Only the policy ``uniform`` begins anywhere and ends after one macro-action."""
    theirs = replace(policy_of("oracle", TASK, 0), name="uniform")
    episodes, _, card = collect(TASK, theirs, episodes=4, seed=754, execution="kinematic", appearance="clean")
    assert card["policy"] == "uniform" and card["successes"] == 4
    assert episodes.terminated[np.cumsum(episodes.lengths) - 1].all()
