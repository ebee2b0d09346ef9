"""Demonstrations of continuous control: the same motion in each format, and only that replays."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pyarrow.parquet as pq
import pytest
from imagine_bench.tasks.continuous.instructions import instruction
from imagine_bench_motion.control import datasets, demonstrator
from imagine_bench_motion.control.datasets import (
    DemonstrationSettings,
    collect,
    demonstration,
    describe,
    verify,
)
from recordings import logged, times

from imagine_bench import registry
from imagine_bench.arrays import Arrays, content_hash
from imagine_bench.cli import exit_code as main
from imagine_bench.data.folder import FORMATS, new_folder, read_card, read_dataset, read_files, write_card
from imagine_bench.data.motion import CAMERAS, Demonstrations, Digest, read_demonstrations
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.seeding import episode_seed

EASY = "arrow_puzzle_easy"  # one cube, at most two macro-actions


@functools.cache
def episode(policy: str = "expert", index: int = 0, task: str = EASY, look: str = "clean") -> Arrays:
    return demonstration(DemonstrationSettings(task=task, policy=policy, seed=0, appearance=look, size=32), index)


def written(
    folder: Path, format: str = "npz", count: int = 1, *, task: str = EASY, look: str = "clean",
    **changes: np.ndarray[Any, Any],
) -> Demonstrations:  # fmt: skip
    """Episodes as a folder whose card agrees with them, whatever was changed in the first."""
    told = [episode(index=index, task=task, look=look) for index in range(count)]
    told[0] = {**told[0], **changes}
    shown = [{name: each[name] for name in each if name not in ("seed", "macrostates")} for each in told]
    digest = Digest()
    for each in shown:
        digest.add(each)
    env_id = registry.motion_id(registry.task(task).env_id)
    card = {
        "task": task, "env_id": env_id, "policy": "expert", "control": "twist", "rate_hz": 25.0,
        "appearance": look, "size": 32, "control_names": list("xyzabcg"), "description": "", "format": format,
        "content": str(digest),
    }  # fmt: skip
    with new_folder(folder, format) as partial:
        (partial / "episodes").mkdir()
        registry.load(FORMATS[format]).write_motion(partial, iter(shown), card)
        seeds, macrostates = ([each[name] for each in told] for name in ("seed", "macrostates"))
        hidden = {"seeds": np.array(seeds), "macrostates": np.concatenate(macrostates)}
        whole = write_card(partial, card, {"privileged": hidden})
    return Demonstrations(folder=folder, card=whole)


def test_the_expert_solves_its_episodes_and_names_its_action() -> None:
    told = episode()
    n_steps = len(told["rewards"])
    assert told["success"][-1] and told["terminated"][-1] and not told["success"][:-1].any()
    assert told["actions"].dtype == np.float32 and told["actions"].shape == (n_steps, 7)
    assert told["hand"].shape == told["front"].shape == (n_steps + 1, 32, 32, 3)
    states = list(map(tuple, told["macrostates"].tolist()))
    rules = registry.task(EASY).rules
    for before, after, macro_action in zip(states, states[1:], told["macro_action"].tolist(), strict=False):
        assert after in (before, rules.outcomes(before, macro_action)[0].macrostate)
    assert len(set(states)) > 1
    assert told["instruction"][0].startswith("Turn the")


def test_each_command_has_the_wish_of_the_moment_before_it() -> None:
    """In a world where the human may want something else after each macro-action."""
    spec = registry.task("arrows:cubes=3,goal_change=0.9")
    found = [episode(index=index, task="arrows:cubes=3,goal_change=0.9") for index in range(9)]
    for told in found:
        states = [tuple(state) for state in told["macrostates"].tolist()]
        assert told["instruction"].tolist() == [instruction(spec, state) for state in states[:-1]]
    assert any(len(set(told["instruction"].tolist())) > 1 for told in found)


def test_a_noisy_expert_fails_plans_again_and_still_succeeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first try of each macro-action lets go too early: it takes twice as long, and no event is a fault."""
    begun = []
    begin = demonstrator.Expert.begin

    def noted(self: Any, macro_action: int, *, fails: bool = False) -> None:
        begun.append(fails := len(begun) % 2 == 0)
        begin(self, macro_action, fails=fails)

    with monkeypatch.context() as patched:
        patched.setattr(demonstrator.Expert, "begin", noted)
        told = episode.__wrapped__("noisy", 1)  # never kept: other tests have the expert as it is
    assert told["success"][-1] and begun == [True, False] * (len(begun) // 2)
    assert set(told["actions"][:, -1]) <= set(episode()["actions"][:, -1]), "its grip has no noise"
    assert not np.array_equal(told["actions"], episode("expert", 1)["actions"][: len(told["actions"])])


def test_random_commands_are_held_and_a_mixed_set_has_each_policy_in_turn() -> None:
    held = episode("random", 2)["actions"]
    begun = held[::10]
    assert np.array_equal(held, begun.repeat(10, axis=0)[: len(held)]) and len(np.unique(begun, axis=0)) == len(begun)
    for index, policy in ((0, "expert"), (2, "random")):
        assert np.array_equal(episode("mixed", index)["actions"], episode(policy, index)["actions"])


@pytest.mark.parametrize("format", FORMATS)
def test_each_format_gives_the_episodes_back(tmp_path: Path, format: str) -> None:
    kept = written(tmp_path / "set", format, count=2)
    for index, found in enumerate(read_demonstrations(tmp_path / "set")):
        told, n_steps = episode(index=index), len(found["rewards"])
        held = {name: array[:n_steps] for name, array in told.items() if name in found}
        assert content_hash({name: array[:n_steps] for name, array in found.items()}) == content_hash(held)
        assert set(told) - set(found) == {"seed", "macrostates"}, "no learner is given them"
    assert verify(kept).startswith("Holds. 2 of 2 episodes replay")
    with pytest.raises(InvalidValueError, match="has hand commands, no macro-actions"):
        read_dataset(tmp_path / "set")


def test_lerobot_rows_have_cameras_state_and_task(tmp_path: Path) -> None:
    said = episode()["instruction"].copy()
    said[40:] = "Stop."
    late = episode()["terminated"]
    changes = {"instruction": said.astype("<U40"), "truncated": late, "terminated": np.zeros_like(late)}
    written(tmp_path / "set", "lerobot", count=2, **changes)
    lengths = [len(episode(index=index)["rewards"]) for index in range(2)]
    count = np.concatenate(list(map(np.arange, lengths)))
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert set(table.schema.names) == set(info["features"])
    assert [info[name] for name in ("fps", "total_tasks", "total_episodes", "total_frames")] == [25, 2, 2, sum(lengths)]
    images = {f"observation.images.{name}": [32, 32, 3] for name in CAMERAS}
    shapes = {**images, "action": [7], "observation.state": [16]}
    assert {name: info["features"][name]["shape"] for name in shapes} == shapes
    numbers = {"index": np.arange(len(count)), "frame_index": count, "episode_index": np.repeat([0, 1], lengths)}
    numbers["next.done"] = np.diff(numbers["episode_index"], append=2) > 0
    numbers["task_index"] = (numbers["index"] >= 40) & (numbers["index"] < lengths[0])
    for name, column in numbers.items():
        np.testing.assert_array_equal(table[name].to_numpy(), column, err_msg=name)
    np.testing.assert_allclose(table["timestamp"].to_numpy(), count / 25, atol=1e-5)
    rows = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["tasks"] for row in rows] == [[said[0], "Stop."], [said[0]]]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == [
        *((0, lengths[0]), (lengths[0], sum(lengths)))
    ]
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    for told, name, scale in (
        ("observation.images.front", "front", 255), ("observation.state", "proprio", 1), ("action", "actions", 1),
    ):  # fmt: skip
        every = np.concatenate([episode(index=index)[name][: lengths[index]] for index in range(2)]) / scale
        of = every.reshape(-1, every.shape[-1])
        for which in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(np.ravel(stats[told][which]), getattr(of, which)(axis=0), atol=1e-6)
        assert stats[told]["count"] == [sum(lengths)]


def test_demonstrations_in_several_files_with_tasks_in_any_order_are_read(tmp_path: Path) -> None:
    """As tools of LeRobot may leave them."""
    said = episode()["instruction"].astype("<U40")
    said[40:] = "Stop."
    written(tmp_path / "set", "lerobot", count=2, instruction=said)
    before = [content_hash(each) for each in read_demonstrations(tmp_path / "set")]
    data, tasks = tmp_path / "set/data/chunk-000", tmp_path / "set/meta/tasks.parquet"
    table = pq.read_table(data / "file-000.parquet")
    for index in range(2):
        of_one = np.flatnonzero(table["episode_index"].to_numpy() == index)
        pq.write_table(table.take(of_one), data / f"file-{index:03}.parquet")
    pq.write_table(pq.read_table(tasks).take([1, 0]), tasks)
    found = list(read_demonstrations(tmp_path / "set"))
    assert [content_hash(each) for each in found] == before
    assert [each["instruction"].tolist() for each in found] == [said.tolist(), episode(index=1)["instruction"].tolist()]


def test_minari_recovers_the_environment_of_demonstrations(tmp_path: Path) -> None:
    written(tmp_path / "set", "minari", look="strong")
    (data,) = (tmp_path / "set").glob("*/data")
    spec = minari.MinariDataset(data).recover_environment().spec
    assert spec is not None and spec.id == "imagine_bench/ArrowPuzzleEasyMotion-v0"
    assert spec.kwargs.items() >= {"appearance": "strong", "size": 32}.items()


def test_a_recording_is_of_the_episode_that_is_asked_for(tmp_path: Path) -> None:
    kept, path = written(tmp_path / "set", count=2), tmp_path / "second.rrd"
    datasets.record(kept, 1, path)
    assert times(path, "/motion/reward", "env_step") == set(range(len(episode(index=1)["rewards"]) + 1))
    assert "**Success.**" in logged(path, "/motion/text", "TextDocument:text", "env_step")[-1][1][0]
    with pytest.raises(InvalidValueError, match=r"Episode 2 is not in .*; give 0 to 1"):
        datasets.record(kept, 2, path)


def changed(name: str, place: object, value: object) -> dict[str, np.ndarray[Any, Any]]:
    """A part of the episode that is otherwise in one place."""
    array = episode()[name].copy()
    assert np.any(array[place] != value)
    array[place] = value
    return {name: array}


FORGERIES: dict[str, Callable[[], dict[str, np.ndarray[Any, Any]]]] = {
    "a command": lambda: changed("actions", (20, 0), 0.9),
    "a reward": lambda: changed("rewards", 3, 1.0),
    "a macrostate": lambda: changed("macrostates", (5, 0), 3),
    "an instruction": lambda: changed("instruction", 7, "Stop."),
    "the arm's sense": lambda: changed("proprio", (9, 2), episode()["proprio"][9, 2] + 0.01),
    "another start": lambda: {"seed": episode()["seed"] + 1},
    "the end is missing": lambda: {name: array[: len(array) - 30] for name, array in episode().items() if array.ndim},
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_what_does_not_follow_from_the_commands_is_found(tmp_path: Path, forgery: str) -> None:
    """The forger wrote a card that agrees."""
    kept = written(tmp_path / "set", **FORGERIES[forgery]())
    with pytest.raises(ArtefactError, match="episode 0: "):
        verify(kept)


@pytest.mark.parametrize(
    "task", ["arrows:cubes=1,slip=0.5", pytest.param("pick_place:goal_change=0.5", marks=pytest.mark.slow)]
)
def test_worlds_with_options_and_chance_replay(tmp_path: Path, task: str) -> None:
    assert verify(written(tmp_path / "set", task=task, look="strong")).startswith("Holds.")


def test_a_card_counts_its_episodes_and_has_the_optimum_of_commands(tmp_path: Path) -> None:
    """To which a slip costs nothing. A macro-action that slips is one of the few that an episode has."""
    options = {"policy": "mixed", "episodes": 3, "seed": 0, "appearance": "clean", "size": 32, "workers": 1}
    kept = collect(f"{EASY}:slip=0.5", folder=tmp_path / "set", format="npz", **options)
    facts = registry.task(EASY).facts()
    assert (kept.card["optimum"], kept.card["optimal_return"]) == (facts.optimum, facts.optimal_return)
    assert registry.task(kept.card["task"]).facts().optimum < 0.7
    rewards, ends = zip(*((each["rewards"], each["success"][-1]) for each in kept), strict=True)
    solved, seeds = sum(ends), read_files(kept.folder, kept.card)["privileged"]["seeds"]
    assert seeds.tolist() == [episode_seed("dataset", 0, index) for index in range(3)] and 0 < solved < 3
    for line in (
        f"episodes      3 of {sum(map(len, rewards))} commands at 25 Hz, as npz",
        f"success       {solved / 3:.1%} of episodes [",
        f"return        {np.concatenate(rewards).sum() / 3:.2f} an episode; optimum {facts.optimal_return:.2f} if",
    ):
        assert line in describe(kept)


def test_an_image_that_was_changed_is_not_that_of_the_card(tmp_path: Path) -> None:
    written(tmp_path / "honest")
    written(tmp_path / "other", **changed("hand", (3, 0, 0), 7))
    shutil.copy(tmp_path / "other/episodes/000000.npz", tmp_path / "honest/episodes/000000.npz")
    with pytest.raises(ArtefactError, match="its episodes are not those of its card"):
        verify(read_demonstrations(tmp_path / "honest"))


def test_rows_at_other_times_than_the_metadata_says_do_not_hold(tmp_path: Path) -> None:
    kept = written(tmp_path / "set", "lerobot")
    path = tmp_path / "set/meta/info.json"
    path.write_text(path.read_text().replace('"fps": 25', '"fps": 24'))
    with pytest.raises(ArtefactError, match=r"row 1 has frame_index 1 and timestamp 0.04, but is .* at 24 a second"):
        verify(kept)


def test_the_command_says_whether_a_folder_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answers = {}
    for name, changes in (("honest", {}), ("forged", FORGERIES["a reward"]())):
        written(tmp_path / name, **changes)
        answers[name] = (main(["verify", str(tmp_path / name)]), capsys.readouterr().out)
    holds = "Holds. 1 of 1 episodes replay from seed and commands to equal rewards and macrostates.\n"
    assert answers["honest"] == (0, holds)
    code, complaint = answers["forged"]
    assert code == 1 and "rewards[3] is 0.0, and the file says 1.0" in complaint


def test_names_of_continuous_control_are_those_of_its_environments() -> None:
    for name in ("ArrowPuzzleMotion", "imagine_bench/ArrowPuzzleMotion-v0"):
        assert registry.task_of_motion(f"{name}:cubes=2") == "arrow_puzzle:cubes=2"
    assert registry.task_of_motion("ArrowPuzzleMotion") == "arrow_puzzle"
    assert registry.task_of_motion("arrow_puzzle") is None


@pytest.mark.slow
def test_fifty_episodes_replay_whatever_the_number_of_workers(tmp_path: Path) -> None:
    words = ["dataset", "ArrowPuzzleMotion", "--policy", "mixed", "--size", "32", "--episodes"]
    assert main([*words, "50", "--format", "lerobot", "--out", str(tmp_path / "two"), "--workers", "2"]) == 0
    assert main([*words, "4", "--out", str(tmp_path / "one"), "--workers", "1"]) == 0
    assert main(["verify", str(tmp_path / "two")]) == main(["verify", str(tmp_path / "one")]) == 0
    first = [dict(each) for each, _ in zip(read_demonstrations(tmp_path / "two"), range(4), strict=False)]
    for wide, narrow in zip(first, read_demonstrations(tmp_path / "one"), strict=True):
        np.testing.assert_array_equal(wide["actions"], narrow["actions"])
        np.testing.assert_array_equal(wide["front"], narrow["front"][:-1])
    assert (read_card(tmp_path / "two") or {})["episodes"] == 50


def test_a_collection_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(function: object, items: list[Any], *, on_end: Callable[[Any, str], None], **_: object) -> None:
        on_end(items[0], "the power went out.")

    monkeypatch.setattr(datasets, "work_through", fails)
    assert main(["dataset", "ArrowPuzzleMotion", "--policy", "expert", "--out", str(tmp_path / "set")]) == 1
    assert not list(tmp_path.iterdir())
