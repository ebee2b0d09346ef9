"""A dataset that was damaged, changed or made up ends in one sentence that names it, and is left untouched."""

from __future__ import annotations

import io
import json
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_runs import FORMATS, collected, written

from imagine_bench.arrays import Arrays
from imagine_bench.data.folder import read_dataset, write_dataset
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError
from imagine_bench.interfaces.episodes import Episodes, joined
from imagine_bench.running.collect import describe


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sets")
    for format in FORMATS:
        written(root / format, format)
    return root


def refused(folder: Path, sentence: str) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(ArtefactError) as caught:
        describe(read_dataset(folder))
    said = str(caught.value)
    assert sentence in said and str(folder) in said and "\n" not in said and len(said) < 1500, said
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def archive(**changes: Any) -> Callable[[Path], None]:
    """Writes the archive again with other arrays; None leaves one out."""

    def change(folder: Path) -> None:
        arrays = {**collected()[0].arrays(), **changes}
        np.savez(folder / "episodes.npz", **{name: array for name, array in arrays.items() if array is not None})

    return change


def bytes_of(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        (path,) = folder.glob(name)
        path.write_bytes(change(path.read_bytes()))

    return damage


def with_item(name: str, index: int, value: Any) -> Callable[[Path], None]:
    array = getattr(collected()[0], name).copy()
    array[index] = value
    return archive(**{name: array})


_DATA = "data/chunk-000/file-000.parquet"


def table(change: Callable[[pa.Table], pa.Table], name: str = _DATA) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        pq.write_table(change(pq.read_table(folder / name)), folder / name)

    return damage


def info(**values: Any) -> Callable[[Path], None]:
    return bytes_of("meta/info.json", lambda old: json.dumps({**json.loads(old), **values}).encode())


def replaced(old: pa.Table, name: str, values: Any) -> pa.Table:
    field = old.schema.field(name)
    column = values if isinstance(values, pa.ChunkedArray) else pa.array(values, field.type)
    return old.set_column(old.schema.get_field_index(name), field, column)


def with_image(content: bytes) -> Callable[[pa.Table], pa.Table]:
    def change(old: pa.Table) -> pa.Table:
        images = old["observation.image"].to_pylist()
        images[3] = {"bytes": content, "path": None}
        return replaced(old, "observation.image", images)

    return change


def steps_less_one(content: bytes) -> bytes:
    values = json.loads(content)
    return json.dumps({**values, "total_steps": values["total_steps"] - 1}).encode()


def png(size: tuple[int, int]) -> bytes:
    with io.BytesIO() as stream:
        PIL.Image.new("RGB", size).save(stream, "PNG")
        return stream.getvalue()


def flipped(content: bytes) -> bytes:
    return content[:-200] + bytes([content[-200] ^ 1]) + content[-199:]


_LONG = np.ones(6, dtype=np.int64)
DAMAGES: list[tuple[str, Callable[[Path], None], str]] = [
    ("npz", bytes_of("episodes.npz", lambda old: old[:-1000]), "is not an archive of episodes"),
    ("npz", archive(actions=np.array([[1], [1, 2]], dtype=object)), "pickle"),
    ("npz", archive(rewards=None), "it lacks 'rewards'"),
    ("npz", archive(more=_LONG), "it has 'more', which is unknown"),
    ("npz", with_item("rewards", 2, np.nan), "reward 2 is not finite"),
    ("npz", with_item("actions", 0, 6), "actions must lie from 0 to 5"),
    ("npz", with_item("action_masks", 0, 2), "an action mask is neither 0 nor 1"),
    ("npz", with_item("terminated", 1, True), "an episode goes on after its end, or has none"),
    ("npz", archive(frames=collected()[0].frames[1:]), "frames has shape"),
    ("npz", archive(lengths=np.zeros(0, dtype=np.int64)), "one or more episodes"),
    ("npz", archive(lengths=-_LONG), "each of at least 1"),
    ("npz", with_item("frames", 0, 7), "is damaged: its episodes are not those of its card"),
    ("npz", bytes_of("card.json", lambda old: old.replace(b'"mixed"', b'"oracle"')), "card.json is damaged"),
    ("npz", bytes_of("privileged.npz", flipped), "privileged.npz is not a part of a dataset"),
    ("npz", lambda folder: np.savez(folder / "privileged.npz", seeds=np.arange(6)), "differs from the card"),
    ("lerobot", lambda folder: (folder / "final_frames.parquet").unlink(), "copy it from the dataset that this"),
    ("lerobot", lambda folder: shutil.rmtree(folder / "data"), "and 0 are, in 0 files data/*/*.parquet; is one missi"),
    ("lerobot", table(lambda old: replaced(old, "timestamp", [9.0] * len(old))), "row 0 has frame_index 0 and times"),
    ("lerobot", table(lambda old: replaced(old, "frame_index", [0] * len(old))), "row 1 has frame_index 0 and timesta"),
    ("lerobot", info(fps=30), "row 1 has frame_index 1 and timestamp 1, but is row 1 of its episode, at 30 a second"),
    ("lerobot", info(total_episodes=7), "7 episodes are said to be in it and 6 are"),
    ("lerobot", table(lambda old: old[1:], "final_frames.parquet"), "has no last frame of episode 0; LeRobot's"),
    ("lerobot", table(lambda old: replaced(old, "episode_index", old["episode_index"][::-1])), "rows are not in order"),
    ("lerobot", table(lambda old: replaced(old, "action", [0.5] * len(old))), "an action is no integer"),
    ("lerobot", table(with_image(b"not a PNG")), "cannot identify image"),
    ("lerobot", table(with_image(png((6400, 64)))), "an image is RGB of (6400, 64) pixels"),
    ("lerobot", info(codebase_version="v2.1"), "it is of version v2.1"),
    ("lerobot", info(features={"action": {}, "observation.images.top": {}}), "it has no next.reward, which 'imagine"),
    ("lerobot", info(total_frames=10**9), "1000000000 rows are said to be in it and"),
    ("minari", bytes_of("*/data/metadata.json", lambda old: b"{}"), "is not a Minari dataset of macro-actions"),
    ("minari", bytes_of("*/data/metadata.json", steps_less_one), "steps are not those that it holds"),
    ("minari", lambda folder: shutil.rmtree(next(folder.glob("*/data/5"))), "a file of it is missing"),
]  # fmt: skip


@pytest.mark.parametrize(("format", "damage", "sentence"), DAMAGES, ids=range(len(DAMAGES)))
def test_what_is_damaged_is_refused(
    sets: Path, tmp_path: Path, format: str, damage: Callable[[Path], Any], sentence: str
) -> None:
    folder = tmp_path / "set"
    shutil.copytree(sets / format, folder)
    read_dataset(folder)
    damage(folder)
    refused(folder, sentence)


@pytest.mark.parametrize("make", [lambda path: None, Path.mkdir, Path.touch], ids=["nothing", "a folder", "a file"])
def test_what_is_no_dataset_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "set")
    with pytest.raises(ArtefactError, match="is no dataset; give a folder with episodes"):
        read_dataset(tmp_path / "set")


def test_a_set_that_could_not_be_written_leaves_nothing(tmp_path: Path) -> None:
    collected()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))  # bytes of a file of this process
    try:
        with pytest.raises(ImagineBenchError, match=r"Cannot write .*: File too large"):
            written(tmp_path / "set")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", FORMATS)
def test_what_a_killed_writer_left_is_in_no_other_set(sets: Path, tmp_path: Path, format: str) -> None:
    left = tmp_path / ".set.partial"
    shutil.copytree(sets / format, left)
    (left / "card.json").unlink()
    more = left / "data/chunk-000/file-001.parquet"
    if format == "lerobot":
        shutil.copy(left / _DATA, more)
    before = sorted(path.relative_to(left) for path in left.rglob("*"))
    written(tmp_path / "set", format, episodes=3)
    assert len(read_dataset(tmp_path / "set").episodes) == 3
    assert sorted(path.relative_to(left) for path in left.rglob("*")) == before, "it may be anybody's"
    assert sorted(path.name for path in tmp_path.iterdir()) == [".set.partial", "set"]


def test_writers_of_one_name_do_not_mix(tmp_path: Path) -> None:
    """The second begins while the first is at it: one set is whole, and the other writer says why it has none."""

    class Overtaken(Episodes):
        def arrays(self) -> Arrays:
            if not (tmp_path / "set").exists():
                written(tmp_path / "set", episodes=3)
            return super().arrays()

    episodes, apart, card = collected()
    with pytest.raises(ImagineBenchError, match="Cannot write"):
        write_dataset(tmp_path / "set", Overtaken(**episodes.arrays()), apart, card, "npz")
    assert len(read_dataset(tmp_path / "set").episodes) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_no_value_changes_with_its_type() -> None:
    """Others may keep actions as floats and rewards as integers; a number that is no action is refused."""
    episodes = collected(episodes=1)[0]
    part: dict[str, Any] = {**episodes.arrays(), "success": episodes.success[0]}
    del part["lengths"]
    assert joined([{**part, "actions": part["actions"].astype(np.float32)}]).hash == episodes.hash
    with pytest.raises(InvalidValueError, match="actions holds float64, not int64"):
        joined([{**part, "actions": part["actions"] + 0.5}])
