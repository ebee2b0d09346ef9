"""Checkpoints: exact, whole, and honest about damage."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.interfaces import AgentState
from imagine_bench.running.evaluation import EvaluationCounts
from imagine_bench.running.run_state import Counters
from imagine_bench.store import checkpoints as checkpointing
from imagine_bench.store.checkpoints import Snapshot, load_newest, load_snapshot, save_snapshot
from imagine_bench.store.results import Checkpoint


def snapshot(episode: int = 3) -> Snapshot:
    rng = np.random.default_rng(episode)
    arrays = {
        "weights": rng.normal(size=(4, 3)).astype(np.float32),
        "nan": np.array([np.nan, -0.0, np.inf]),
        "count": np.array(7, dtype=np.int64),
        "mask": rng.random((2, 5)) < 0.5,
        "transposed": rng.normal(size=(3, 2)).T,
        "none": np.zeros((0, 8)),
        "generator": np.arange(9, dtype=np.uint8),
    }
    values = {"rng": np.random.default_rng(1).bit_generator.state, "mean": 0.1 + 0.2, "nan": float("nan")}
    agent = AgentState(arrays=arrays, values=values)
    return Snapshot(episode=episode, agent=agent, arrays={"success": np.array([True, False])}, values={"rows": []})


def test_every_bit_comes_back(tmp_path: Path) -> None:
    before = snapshot()
    after = load_snapshot(save_snapshot(tmp_path, before))
    assert after.episode == before.episode
    assert set(after.agent.arrays) == set(before.agent.arrays)
    for name, array in before.agent.arrays.items():
        back = after.agent.arrays[name]
        assert (back.shape, back.dtype, back.tobytes()) == (array.shape, array.dtype, array.tobytes()), name
    assert json.dumps(after.agent.values) == json.dumps(before.agent.values)
    assert after.arrays["success"].tolist() == [True, False]


def test_the_newest_is_kept_alone(tmp_path: Path) -> None:
    for episode in (1, 1, 2):
        save_snapshot(tmp_path, snapshot(episode))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint_000003_episode_2"]
    newest = load_newest(tmp_path)
    assert newest is not None and newest.episode == 2
    assert load_newest(tmp_path / "nothing") is None
    save_snapshot(tmp_path / "other", snapshot(1)).rename(tmp_path / "checkpoint_000001_episode_1")
    newest = load_newest(tmp_path)
    assert newest is not None and newest.episode == 2, "an older one that a kill left behind"


def test_a_checkpoint_replaced_while_it_is_read_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_snapshot(tmp_path, snapshot(1))
    real, calls = checkpointing.load_snapshot, []

    def overtaken(checkpoint: Path) -> Snapshot:
        calls.append(checkpoint)
        if len(calls) == 1:
            save_snapshot(tmp_path, snapshot(2))
        return real(checkpoint)

    monkeypatch.setattr(checkpointing, "load_snapshot", overtaken)
    newest = load_newest(tmp_path)
    assert newest is not None and newest.episode == 2 and len(calls) == 2


def test_a_save_that_fails_half_way_keeps_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_snapshot(tmp_path, snapshot(1))
    real, calls = os.fsync, []

    def full_at_the_third(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", full_at_the_third)
    with pytest.raises(SetupError, match="the disk is full"):
        save_snapshot(tmp_path, snapshot(2))
    monkeypatch.setattr(os, "fsync", real)
    newest = load_newest(tmp_path)
    assert newest is not None and newest.episode == 1
    assert list(tmp_path.glob(".partial*"))  # what the failure left behind ...
    save_snapshot(tmp_path, snapshot(3))
    assert not list(tmp_path.glob(".partial*"))  # ... goes with the next success


@pytest.mark.parametrize("name", ["agent.safetensors", "runner.safetensors"])
def test_one_flipped_bit_is_noticed(tmp_path: Path, name: str) -> None:
    path = save_snapshot(tmp_path, snapshot()) / name
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ArtefactError, match=rf"{name} is damaged.*left untouched"):
        load_newest(tmp_path)
    assert path.read_bytes() == bytes(content)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    folder = save_snapshot(tmp_path, snapshot())
    (folder / "agent.safetensors").unlink()
    with pytest.raises(ArtefactError, match=r"Cannot read .*agent\.safetensors"):
        load_newest(tmp_path)


@pytest.mark.parametrize("content", ["[]", '{"format": "other 7"}', "{"])
def test_a_foreign_state_is_named(tmp_path: Path, content: str) -> None:
    folder = save_snapshot(tmp_path, snapshot())
    (folder / "state.json").write_text(content)
    with pytest.raises(ArtefactError, match=r"state\.json .*left untouched"):
        load_newest(tmp_path)
    assert (folder / "state.json").read_text() == content


_watch: list[Callable[[str], None]] = []
sys.addaudithook(lambda event, _: [call(event) for call in _watch[:1]] and None)


def test_a_whole_checkpoint_is_there_at_every_moment_of_a_save(tmp_path: Path) -> None:
    save_snapshot(tmp_path, snapshot(1))
    seen: list[int] = []

    def look(event: str) -> None:
        if event.startswith(("os.", "shutil.", "open")):
            call = _watch.pop()  # looking opens files too
            newest = load_newest(tmp_path)
            seen.append(0 if newest is None else newest.episode)
            _watch.append(call)

    _watch.append(look)
    try:
        save_snapshot(tmp_path, snapshot(2))
    finally:
        _watch.clear()
    assert set(seen) == {1, 2} and seen == sorted(seen)


def test_every_counter_comes_back(tmp_path: Path) -> None:
    assert not any(vars(Counters()).values()) and not any(vars(EvaluationCounts()).values()), "all begin at nothing"
    counters = Counters(before=3, train_cpu_s=1.5)
    counters.starts = [[0, 1], [2, 1], [0, 0]]
    for success, length, queries in [(True, 3, 2), (False, 6, 0), (True, 1, 5)]:
        counters.try_out([2 * (counters.episode == 1), 1], 4 * (counters.episode != 1))
        counters.add_episode(success, length, queries)
    played = {"actions": [2, 0, 1], "lengths": [1, 2], "returns": [-1.5], "faults": [1], "starts": [[0, 1], [1, 2]]}
    counters.test = EvaluationCounts(solved="01", **played, fingerprints=[7, 9], cpu_s=0.25)
    row = {"episodes": 2, "env_steps": 9, "test_episodes": 5, "successes": 4, "mean_return": 0.5, "mean_length": 2.5}
    counters.rows.append(Checkpoint(**row, faults=1, train_cpu_s=0.5, eval_cpu_s=0.25, diagnostics={"loss": 0.1}))
    save_snapshot(tmp_path, counters.snapshot(AgentState(arrays={}, values={})))
    newest = load_newest(tmp_path)
    assert newest is not None and newest.episode == 3
    again = Counters.of(newest)
    assert again == counters
    assert {name: part.tolist() for name, part in again.training().items()} == {
        "success": [True, False, True], "length": [3, 6, 1], "queries": [2, 0, 5],
        "starts": [[0, 1], [2, 1], [0, 0]], "tried": [[0, 1, 4, 0], [2, 1, 0, 1]],
    }  # fmt: skip
