"""Episodes in the layout of LeRobot datasets, version 3.0, written with pyarrow; images are PNG, without loss.

A row is a macro-action: the frame before it, the action, and its result (``next.reward``, ``next.done``, ...). The
layout has no row for the frame that an episode ends with; it lies in ``final_frames.parquet``, which only we read.
LeRobot's own tools leave that file behind. Whoever deletes, splits or merges episodes with them copies it into the new
folder, one ``final_frames*.parquet`` a dataset that went into it: the digest of an episode's rows finds its last frame.

Source: https://github.com/huggingface/lerobot, ``src/lerobot/datasets``, versions 0.4.4 and 0.6.1.
"""

from __future__ import annotations

import io
import itertools
import json
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pyarrow as pa
import pyarrow.parquet as pq

from imagine_bench.arrays import Array, Arrays, Bools, Ints, content_hash
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import Frame
from imagine_bench.interfaces.episodes import FRAME_SHAPE, Episodes
from imagine_bench.store.files import make_folder, read_json, reading, write_json
from imagine_bench.values import Json

_VERSION = "v3.0"
_INFO = "meta/info.json"
_FINAL = "final_frames.parquet"
_FINALS = "final_frames*.parquet"
_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_IMAGE = "observation.image"
_MASK = "available"
_EPISODE = "episode_index"
_DIGEST = "episode_digest"
_DIGESTED = ("action", "next.reward", "next.terminated", "next.truncated", "next.success")
"""Columns that an episode is known by, with its frames and masks: those that no tool of LeRobot's changes."""
_TOLERANCE_S = 1e-4
"""How far a timestamp may be from that of its row, as LeRobot has it."""
_ROWS = 20_000
_FILES = 1000
"""Rows of a file, at most 100 MB; files of a chunk."""
_TYPES = {
    "action": "float32", "next.reward": "float64", "next.terminated": "bool", "next.truncated": "bool",
    "next.done": "bool", "next.success": "bool", "timestamp": "float32", "frame_index": "int64", _EPISODE: "int64",
    "index": "int64", "task_index": "int64",
}  # fmt: skip
"""Columns of one number a row. LeRobot's own tools take actions to be real numbers; a second is a macro-action."""


def write(folder: Path, episodes: Episodes, card: Mapping[str, Json]) -> None:
    """Write data, metadata and statistics of episodes; ``card`` has the task's ``description``."""
    firsts = np.cumsum(episodes.lengths) - episodes.lengths
    before, last = episodes.rows
    columns = _columns(episodes, firsts)
    frames = episodes.frames[before]
    masks = episodes.action_masks.astype(np.bool_)
    table = _table({**columns, _MASK: masks[before]}, frames)
    digests = _digests(columns, masks[before], frames, episodes.lengths)
    text = [str(card["description"])]
    places = [divmod(file, _FILES) for file in (firsts // _ROWS).tolist()]
    spans = [slice(*span) for span in zip(firsts.tolist(), (firsts + episodes.lengths).tolist(), strict=True)]
    for place, there in itertools.groupby(zip(places, spans, strict=True), key=operator.itemgetter(0)):
        with pq.ParquetWriter(_file(folder / "data", *place), table.schema) as writer:
            for _, span in there:
                writer.write_table(table[span])
    rows = []
    for index, (span, (chunk, file)) in enumerate(zip(spans, places, strict=True)):
        row = {_EPISODE: index, "tasks": text, "length": span.stop - span.start, "dataset_from_index": span.start}
        row |= {"dataset_to_index": span.stop, "data/chunk_index": chunk, "data/file_index": file}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        stats = _statistics({name: column[span] for name, column in columns.items()}, frames[span])
        rows.append(row | {f"stats/{name}/{each}": value for name, of in stats.items() for each, value in of.items()})
    pq.write_table(pa.Table.from_pylist(rows), _file(folder / "meta/episodes", 0, 0))
    pq.write_table(_tasks(text), folder / "meta/tasks.parquet")
    ends = _table({_EPISODE: np.arange(len(last)), _MASK: masks[last]}, episodes.frames[last])
    pq.write_table(ends.append_column(_DIGEST, pa.array(digests)), folder / _FINAL)
    write_json(folder / "meta/stats.json", _statistics(columns, frames))
    write_json(folder / _INFO, _info(episodes))


def _columns(episodes: Episodes, firsts: Ints) -> Arrays:
    """The columns of one number a row, in the order of their types."""
    which = np.repeat(np.arange(len(firsts)), episodes.lengths)
    index = np.arange(len(episodes.actions))
    done = episodes.terminated | episodes.truncated
    count = index - firsts[which]
    columns = (
        episodes.actions, episodes.rewards, episodes.terminated, episodes.truncated, done,
        done & episodes.success[which], count, count, which, index, np.zeros_like(index),
    )  # fmt: skip
    return {name: array.astype(dtype) for (name, dtype), array in zip(_TYPES.items(), columns, strict=True)}


def _table(columns: Mapping[str, Array], frames: Frame) -> pa.Table:
    """Columns and images, as the ``datasets`` library describes them."""
    arrays: list[pa.Array] = [_pngs(frames)]
    features: dict[str, dict[str, Json]] = {_IMAGE: {"_type": "Image"}}
    for name, column in columns.items():
        features[name] = {"dtype": str(column.dtype), "_type": "Value"}
        arrays.append(pa.array(column.ravel()))
        if column.ndim > 1:
            features[name] = {"feature": features[name], "length": column.shape[1], "_type": "Sequence"}
            arrays[-1] = pa.FixedSizeListArray.from_arrays(arrays[-1], column.shape[1])
    told = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.table(arrays, names=list(features), metadata=told)


def _pngs(frames: Frame) -> pa.Array:
    images = []
    for frame in frames:
        with io.BytesIO() as stream:
            PIL.Image.fromarray(frame).save(stream, "PNG")
            images.append({"bytes": stream.getvalue(), "path": None})
    return pa.array(images, pa.struct({"bytes": pa.binary(), "path": pa.string()}))


def _file(folder: Path, chunk_index: int, file_index: int) -> Path:
    path = folder / _PATH.format(chunk_index=chunk_index, file_index=file_index)
    make_folder(path.parent)
    return path


def _statistics(columns: Mapping[str, Array], frames: Frame) -> dict[str, dict[str, Json]]:
    """Of every column, and of each color in [0, 1], whose arrays have the shape (3, 1, 1)."""
    levels = np.arange(256) / 255
    counts = [np.bincount(frames[..., color].ravel(), minlength=256) for color in range(3)]
    means = [np.average(levels, weights=count) for count in counts]
    spreads = [
        np.average((levels - mean) ** 2, weights=count) ** 0.5 for mean, count in zip(means, counts, strict=True)
    ]
    seen = [levels[count > 0] for count in counts]
    colors = {"min": [s[0] for s in seen], "max": [s[-1] for s in seen], "mean": means, "std": spreads}
    found: dict[str, dict[str, Json]] = {
        _IMAGE: {which: [[[float(value)]] for value in values] for which, values in colors.items()}
    }
    for name, column in columns.items():
        found[name] = {which: [float(getattr(column, which)())] for which in colors}
    return {name: {**of, "count": [len(frames)]} for name, of in found.items()}


def _tasks(text: list[str]) -> pa.Table:
    """The metadata that pandas writes for a table whose index is the description and whose one column is
    ``task_index``.
    """
    index = "__index_level_0__"
    column = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    columns = [
        {**column, "name": "task_index", "field_name": "task_index"},
        {**column, "name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"},
    ]
    told = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: text})
    return table.replace_schema_metadata({"pandas": json.dumps(told)})


def _info(episodes: Episodes) -> dict[str, Json]:
    features: dict[str, Json] = {}
    for name, dtype in _TYPES.items():
        names = ["macro_action"] if name == "action" else None
        features[name] = {"dtype": dtype, "shape": [1], "names": names}
    features[_MASK] = {"dtype": "bool", "shape": [episodes.n_actions], "names": None}
    features[_IMAGE] = {"dtype": "image", "shape": list(FRAME_SHAPE), "names": ["height", "width", "channels"]}
    return {
        "codebase_version": _VERSION, "robot_type": None, "total_episodes": len(episodes),
        "total_frames": len(episodes.actions), "total_tasks": 1, "chunks_size": _FILES, "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200, "fps": 1, "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{_PATH}", "video_path": None, "features": features,
    }  # fmt: skip


def _digests(columns: Mapping[str, Array], masks: Array, frames: Frame, lengths: Ints) -> list[str]:
    """A digest of each episode, by which its last frame is found; ``lengths`` are their numbers of rows."""
    known = {**{name: columns[name] for name in _DIGESTED}, _MASK: masks, _IMAGE: frames}
    ends = np.cumsum(lengths)
    spans = [slice(end - length, end) for end, length in zip(ends.tolist(), lengths.tolist(), strict=True)]
    return [content_hash({name: array[span] for name, array in known.items()}) for span in spans]


def read(path: Path) -> Episodes:
    """Read such a dataset from its ``info.json``. Raises ArtefactError: damaged, not whole, or not of our columns."""
    info = read_json(path, "the metadata of a LeRobot dataset")
    folder = path.parents[1]
    with reading(folder, f"a LeRobot dataset of macro-actions, version {_VERSION}"):
        table = _rows(folder, info)
        column = {name: table[name].to_numpy() for name in _TYPES}
        lengths = _lengths(column, info)
        frames, masks = _decoded(table)
        ends = _ends(folder, _digests(column, masks, frames, lengths))
        last_frames, last_masks = _decoded(ends)
        order = np.argsort(np.concatenate([np.arange(len(table)), np.cumsum(lengths) - 0.5]))
        return Episodes(
            lengths=lengths,
            frames=np.concatenate([frames, last_frames])[order],
            action_masks=np.concatenate([masks, last_masks])[order].astype(np.int8),
            actions=column["action"].astype(np.int64),
            rewards=column["next.reward"],
            terminated=column["next.terminated"],
            truncated=column["next.truncated"],
            success=column["next.success"][np.cumsum(lengths) - 1],
        )


def _rows(folder: Path, info: Mapping[str, Any]) -> pa.Table:
    """The rows of all files. Raises InvalidValueError: there are others than ``info`` says, or they lack a column."""
    if info["codebase_version"] != _VERSION:
        raise InvalidValueError(f"it is of version {info['codebase_version']}")
    lacks = [name for name in (*_TYPES, _MASK, _IMAGE) if name not in info["features"]]
    if lacks:
        raise InvalidValueError(f"it has no {lacks[0]}, which 'imagine-bench dataset' writes")
    tables = [pq.read_table(file) for file in sorted(folder.glob("data/*/*.parquet"))]
    rows = sum(map(len, tables))
    if not tables or rows != info["total_frames"]:
        files = f"in {len(tables)} files data/*/*.parquet; is one missing?"
        raise InvalidValueError(f"{info['total_frames']} rows are said to be in it and {rows} are, {files}")
    return pa.concat_tables(tables)


def _lengths(column: Mapping[str, Array], info: Mapping[str, Any]) -> Ints:
    """Rows of each episode. Raises InvalidValueError: rows are in another order, or at other times, than ``info``'s."""
    which = column[_EPISODE]
    in_order = np.array_equal(column["index"], np.arange(len(which))) and not which[0]
    if not in_order or not np.isin(np.diff(which), (0, 1)).all():
        raise InvalidValueError("its rows are not in order")
    lengths = np.bincount(which)
    if len(lengths) != info["total_episodes"]:
        raise InvalidValueError(f"{info['total_episodes']} episodes are said to be in it and {len(lengths)} are")
    count = np.arange(len(which)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    on_time = np.abs(column["timestamp"] - count / info["fps"]) <= _TOLERANCE_S + 1e-6 * count
    wrong = np.flatnonzero(~on_time | (column["frame_index"] != count))
    if len(wrong):
        row = int(wrong[0])
        found = f"frame_index {column['frame_index'][row]} and timestamp {column['timestamp'][row]:g}"
        wanted = f"row {count[row]} of its episode, at {info['fps']} a second"
        raise InvalidValueError(f"row {row} has {found}, but is {wanted}")
    if not np.array_equal(column["action"].astype(np.int64), column["action"]):
        raise InvalidValueError("an action is no integer")
    return lengths


def _ends(folder: Path, digests: list[str]) -> pa.Table:
    """The last frame and mask of each episode.

    Raises:
        ArtefactError: No file has them, or one is damaged.
        InvalidValueError: No file has those of an episode.
    """
    remedy = (
        f"LeRobot's own tools leave {_FINAL} behind: copy it from the dataset that this one was made from; of several "
        "datasets, as final_frames_1.parquet, final_frames_2.parquet and so on"
    )
    files = sorted(folder.glob(_FINALS))
    if not files:
        raise ArtefactError(f"There is no {folder / _FINAL}, which has the last frames of episodes. {remedy}.")
    tables = []
    for file in files:
        with reading(file, "the last frames of episodes"):
            tables.append(pq.read_table(file))
    ends = pa.concat_tables(tables)
    if _DIGEST not in ends.column_names:  # written before 2026-11-28, in the order of the episodes
        if len(ends) != len(digests):
            raise InvalidValueError(f"it has {len(digests)} episodes and {len(ends)} last frames")
        return ends
    places: dict[str, list[int]] = {}
    for row, digest in enumerate(ends[_DIGEST].to_pylist()):
        places.setdefault(digest, []).append(row)
    chosen = []
    for episode, digest in enumerate(digests):
        rows = places.get(digest)
        if rows is None:
            raise InvalidValueError(f"{_FINALS} has no last frame of episode {episode}; {remedy}")
        chosen.append(rows.pop(0) if len(rows) > 1 else rows[0])  # of episodes that are alike, in their order
    return ends.take(chosen)


def _decoded(table: pa.Table) -> tuple[Frame, Bools]:
    """The images of a table, and its masks."""
    images = [PIL.Image.open(io.BytesIO(image["bytes"]), formats=["PNG"]) for image in table[_IMAGE].to_pylist()]
    for image in images:
        if (image.mode, image.size) != ("RGB", FRAME_SHAPE[:2]):
            raise InvalidValueError(f"an image is {image.mode} of {image.size} pixels")
    return np.stack([np.asarray(image) for image in images]), np.array(table[_MASK].to_pylist(), dtype=np.bool_)
