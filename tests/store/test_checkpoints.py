"""Checkpoints: exact, whole at every moment, and honest about damage."""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from small_runs import exact

from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentState
from imagine_bench.running.evaluation import EvaluationCounts
from imagine_bench.running.run_state import Counters
from imagine_bench.store.results import Checkpoint, ComparedRollout, KeptEpisodes, OpenLoop, PolicyTable
from imagine_bench.store.run_folder import (
    Snapshot,
    load_newest,
    load_snapshot,
    pack,
    save_snapshot,
    training_arrays,
    training_of,
    unpack,
)

ARRAYS_ONLY = (OpenLoop, KeptEpisodes, ComparedRollout)
"""Classes whose arrays are kept without values beside them."""
SCALARS: dict[Any, Any] = {int: 3, float: 0.1, str: "0110", bool: True, Any: 1.5}


def variants(hint: Any) -> list[Any]:
    """Values of a type: with and without each part that may be absent, and sequences of none and of several parts."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        dtype = get_args(arguments[1])[0] if get_args(arguments[1]) else np.float64
        return [np.arange(6).reshape(3, 2).astype(dtype)]
    if origin in (Union, types.UnionType):
        return [None, *(value for each in arguments if each is not types.NoneType for value in variants(each))]
    if dataclasses.is_dataclass(hint):
        choices = itertools.product(*(variants(each) for each in get_type_hints(hint).values()))
        return [hint(**dict(zip(get_type_hints(hint), chosen, strict=True))) for chosen in choices]  # type: ignore[operator]
    if origin in (list, tuple):
        several = origin(variants(arguments[0]))
        return [origin(), several] if dataclasses.is_dataclass(arguments[0]) else [several]
    is_mapping = origin is not None and issubclass(origin, Mapping)
    return [{"b c": 0.25, "a": 2}] if is_mapping else [SCALARS[hint]]


@pytest.mark.parametrize("kind", [*ARRAYS_ONLY, PolicyTable, Checkpoint, EvaluationCounts, Counters])
def test_every_present_and_absent_part_is_read_back(kind: Any) -> None:
    for value in variants(kind):
        values, arrays = pack(value)
        for kept in (json.loads(json.dumps(values)), None)[: 1 + (kind in ARRAYS_ONLY)]:
            read = unpack(kind, kept, arrays)
            assert type(read) is kind and exact(dataclasses.asdict(read)) == exact(dataclasses.asdict(value))


def test_2000_training_episodes_take_150_kb_and_come_back_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    count, n_actions = 2000, 30
    whole = {"starts": (4, (count, 6)), "actions": (6, count * n_actions), "faults": (2, count)}
    kept = KeptEpisodes(
        **{name: rng.integers(most, size=shape) for name, (most, shape) in whole.items()},
        lengths=np.full(count, n_actions),
        fingerprints=rng.integers(2**32, size=count),
        returns=rng.normal(size=count),
        success=rng.random(count) < 0.5,
        sim_times_s=rng.random(count),
    )
    arrays = training_arrays(kept)
    assert sum(array.nbytes for array in arrays.values()) < 150_000
    read = training_of(dataclasses.replace(snapshot(), arrays=arrays))
    assert read is not None and exact(vars(read)) == exact(vars(kept))


def test_numpy_scalars_are_numbers_and_absent_fields_defaults() -> None:
    row = variants(Checkpoint)[-1]
    numbers = {"x": np.float32(0.1), "count": np.int64(5), "flag": np.True_, "text": np.str_("a")}
    values, arrays = pack(dataclasses.replace(row, diagnostics=numbers))
    assert json.dumps(values["diagnostics"]) == '{"x": 0.10000000149011612, "count": 5, "flag": true, "text": "a"}'
    del values["solved"]
    assert unpack(Checkpoint, values, arrays).solved is None
    del values["faults"]
    with pytest.raises(TypeError, match="faults"):
        unpack(Checkpoint, values, arrays)
    with pytest.raises(KeyError):
        unpack(OpenLoop, pack(variants(OpenLoop)[0])[0], {})


def snapshot(episode: int = 3) -> Snapshot:
    rng = np.random.default_rng(episode)
    arrays = {
        "weights": rng.normal(size=(4, 3)).astype(np.float32),
        "nan": np.array([np.nan, -0.0, np.inf]),
        "count": np.array(7, dtype=np.int64),
        "mask": rng.random((2, 5)) < 0.5,
        "transposed": rng.normal(size=(3, 2)).T,
        "none": np.zeros((0, 8)),
    }
    values = {"rng": np.random.default_rng(1).bit_generator.state, "mean": 0.1 + 0.2, "nan": float("nan")}
    agent = AgentState(arrays=arrays, values=values)
    return Snapshot(episode=episode, agent=agent, arrays={"success": np.array([True, False])}, values={"rows": []})


def newest_episode(folder: Path) -> int:
    newest = load_newest(folder)
    assert newest is not None
    return newest.episode


def test_every_bit_comes_back(tmp_path: Path) -> None:
    before = snapshot()
    path = save_snapshot(tmp_path, before)
    after = load_snapshot(path)
    assert after.episode == before.episode
    assert exact(after.agent.arrays) == exact(before.agent.arrays)
    assert json.dumps(after.agent.values) == json.dumps(before.agent.values)
    (path / "agent.safetensors").unlink()
    assert load_snapshot(path, agent=False).arrays["success"].tolist() == [True, False]


def test_the_newest_is_kept_alone(tmp_path: Path) -> None:
    for episode in (1, 1, 2):
        save_snapshot(tmp_path, snapshot(episode))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint_000003_episode_2"]
    assert newest_episode(tmp_path) == 2
    assert load_newest(tmp_path / "nothing") is None
    save_snapshot(tmp_path / "other", snapshot(1)).rename(tmp_path / "checkpoint_000001_episode_1")
    assert newest_episode(tmp_path) == 2, "an older one that a kill left behind"


@pytest.mark.parametrize("name", ["agent.safetensors", "runner.safetensors"])
def test_one_flipped_bit_or_a_missing_file_is_noticed(tmp_path: Path, name: str) -> None:
    path = save_snapshot(tmp_path, snapshot()) / name
    whole = path.read_bytes()
    changed = whole[:-1] + bytes([whole[-1] ^ 1])
    path.write_bytes(changed)
    with pytest.raises(ArtefactError, match=rf"{name} is damaged.*left untouched"):
        load_newest(tmp_path)
    assert path.read_bytes() == changed
    path.unlink()
    with pytest.raises(ArtefactError, match=rf"Cannot read .*{name}"):
        load_newest(tmp_path)


_watch: list[Callable[[str], None]] = []
sys.addaudithook(lambda event, _: [call(event) for call in _watch[:1]] and None)


def test_a_whole_checkpoint_is_there_at_every_moment(tmp_path: Path) -> None:
    save_snapshot(tmp_path, snapshot(1))
    seen: list[int] = []

    def look(event: str) -> None:
        if event.startswith(("os.", "shutil.", "open")):
            call = _watch.pop()  # looking opens files too
            seen.append(newest_episode(tmp_path))
            _watch.append(call)

    def overtake(event: str) -> None:
        if event == "open":
            _watch.clear()
            save_snapshot(tmp_path, snapshot(3))

    _watch.append(look)
    try:
        save_snapshot(tmp_path, snapshot(2))
        _watch[:] = [overtake]
        assert newest_episode(tmp_path) == 3, "it was replaced while it was read"
    finally:
        _watch.clear()
    assert set(seen) == {1, 2} and seen == sorted(seen)
