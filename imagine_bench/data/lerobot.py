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
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
import pyarrow as pa
import pyarrow.parquet as pq

from imagine_bench.arrays import Array, Arrays, Bools, Ints, content_hash
from imagine_bench.data.motion import CAMERAS, PROPRIO_NAMES
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
_STATE = "observation.state"
_CAMERA = "observation.images."
_MOTION_TYPES = {**_TYPES, _STATE: "float32", "macro_action": "int64"}
"""Columns of demonstrations, of one number a row but for the action and the state."""
_MOTION_NAMES = {
    "action": "actions",
    _STATE: "proprio",
    "macro_action": "macro_action",
    "next.reward": "rewards",
    "next.terminated": "terminated",
    "next.truncated": "truncated",
    "next.success": "success",
}
"""Columns of demonstrations, and the arrays that they are of."""
_INDEX = "__index_level_0__"
"""Where pandas keeps the index of a table."""


class _EpisodeRows(NamedTuple):
    """The rows of one episode."""

    columns: Arrays
    images: Mapping[str, Frame]
    tasks: list[str]


def write(folder: Path, episodes: Episodes, card: Mapping[str, Json]) -> None:
    """Write data, metadata and statistics of episodes; ``card`` has the task's ``description``."""
    firsts = np.cumsum(episodes.lengths) - episodes.lengths
    before, last = episodes.rows
    columns = _columns(episodes, firsts)
    frames = episodes.frames[before]
    masks = episodes.action_masks.astype(np.bool_)
    digests = _digests(columns, masks[before], frames, episodes.lengths)
    text = [str(card["description"])]
    table = {**columns, _MASK: masks[before]}
    spans = [slice(*span) for span in zip(firsts.tolist(), (firsts + episodes.lengths).tolist(), strict=True)]
    parts = (
        _EpisodeRows({name: each[span] for name, each in table.items()}, {_IMAGE: frames[span]}, text) for span in spans
    )
    _write_rows(folder, parts)
    pq.write_table(_tasks(text), folder / "meta/tasks.parquet")
    ends = _table({_EPISODE: np.arange(len(last)), _MASK: masks[last]}, {_IMAGE: episodes.frames[last]})
    pq.write_table(ends.append_column(_DIGEST, pa.array(digests)), folder / _FINAL)
    counts = {"total_episodes": len(episodes), "total_frames": len(episodes.actions), "total_tasks": 1}
    write_json(folder / _INFO, _info(_features(episodes), counts, fps=1))


def _write_rows(folder: Path, parts: Iterable[_EpisodeRows]) -> None:
    """Write the rows of episodes, one after another, the list of these, and the statistics of all."""
    rows: list[dict[str, Json]] = []
    columns = []
    levels: dict[str, Ints] = {}
    for (chunk, file), there in itertools.groupby(_placed(parts), key=operator.itemgetter(0)):
        with ExitStack() as opened:
            writer = None
            for _, begin, part in there:
                table = _table(part.columns, part.images)
                if writer is None:
                    writer = opened.enter_context(pq.ParquetWriter(_file(folder / "data", chunk, file), table.schema))
                writer.write_table(table)
                row: dict[str, Json] = {_EPISODE: len(rows)}
                row |= {"tasks": part.tasks, "length": len(table), "dataset_from_index": begin}
                row |= {"dataset_to_index": begin + len(table), "data/chunk_index": chunk, "data/file_index": file}
                row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
                counts = {name: _levels(frames) for name, frames in part.images.items()}
                stats = _statistics(part.columns, counts)
                flat = {f"stats/{name}/{each}": value for name, of in stats.items() for each, value in of.items()}
                rows.append(row | flat)
                columns.append(part.columns)
                levels = {name: levels.get(name, 0) + count for name, count in counts.items()}
    whole = {name: np.concatenate([each[name] for each in columns]) for name in columns[0]}
    pq.write_table(pa.Table.from_pylist(rows), _file(folder / "meta/episodes", 0, 0))
    write_json(folder / "meta/stats.json", _statistics(whole, levels))


def _placed(parts: Iterable[_EpisodeRows]) -> Iterator[tuple[tuple[int, int], int, _EpisodeRows]]:
    """Each part with its chunk and file, and with the number of rows before it."""
    begin = 0
    for part in parts:
        yield divmod(begin // _ROWS, _FILES), begin, part
        begin += len(part.columns[_EPISODE])


def write_motion(folder: Path, episodes: Iterator[Arrays], card: Mapping[str, Any]) -> None:
    """Write demonstrations, one after another. Each row has its own instruction as its task."""
    tasks: dict[str, int] = {}
    counts = Counter({"total_episodes": 0, "total_frames": 0})
    fps = round(card["rate_hz"])
    size = card["size"]

    def parts() -> Iterator[_EpisodeRows]:
        for episode in episodes:
            yield _motion_part(episode, counts, tasks, fps)
            counts.update(total_episodes=1, total_frames=len(episode["rewards"]))

    _write_rows(folder, parts())
    pq.write_table(_tasks(list(tasks)), folder / "meta/tasks.parquet")
    names = {"action": list(card["control_names"]), _STATE: list(PROPRIO_NAMES)}
    features: dict[str, Json] = {}
    for name, dtype in _MOTION_TYPES.items():
        features[name] = {"dtype": dtype, "shape": [len(names.get(name, "1"))], "names": names.get(name)}
    for name in CAMERAS:
        shape = [size, size, 3]
        features[_CAMERA + name] = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    write_json(folder / _INFO, _info(features, {**counts, "total_tasks": len(tasks)}, fps=fps))


def _motion_part(episode: Arrays, before: Mapping[str, int], tasks: dict[str, int], fps: float) -> _EpisodeRows:
    """The rows of a demonstration; ``before`` counts those before it, ``tasks`` numbers the instructions so far."""
    said = episode["instruction"].tolist()
    for text in said:
        tasks.setdefault(text, len(tasks))
    n_steps = len(said)
    count = np.arange(n_steps)
    made = {
        "next.done": episode["terminated"] | episode["truncated"],
        "timestamp": count / fps,
        "frame_index": count,
        _EPISODE: np.full(n_steps, before["total_episodes"]),
        "index": before["total_frames"] + count,
        "task_index": np.array([tasks[text] for text in said]),
    }
    given = {theirs: episode[ours][:n_steps] for theirs, ours in _MOTION_NAMES.items()}
    columns = {name: {**given, **made}[name].astype(dtype) for name, dtype in _MOTION_TYPES.items()}
    return _EpisodeRows(
        columns, {_CAMERA + name: episode[name][:n_steps] for name in CAMERAS}, list(dict.fromkeys(said))
    )


def read_motion(folder: Path) -> Iterator[Arrays]:
    """Read demonstrations, one at a time. Raises ArtefactError: damaged, not whole, or not of our columns."""
    info = read_json(folder / _INFO, "the metadata of a LeRobot dataset")
    with reading(folder, f"a LeRobot dataset of demonstrations, version {_VERSION}"):
        tasks = pq.read_table(folder / "meta/tasks.parquet")
        said = np.array(tasks[_INDEX].to_pylist())[np.argsort(tasks["task_index"].to_numpy())]
        for file in sorted(folder.glob("data/*/*.parquet")):
            table = pq.read_table(file)
            lengths = np.unique(table[_EPISODE].to_numpy(), return_counts=True)[1]
            for begin, length in zip(np.cumsum(lengths) - lengths, lengths, strict=True):
                rows = table.slice(begin, length)
                times = {name: rows[name].to_numpy() for name in ("timestamp", "frame_index")}
                _require_on_time(times, np.arange(length), info["fps"])
                yield _motion_arrays(rows, said)


def _motion_arrays(rows: pa.Table, said: Array) -> Arrays:
    found: Arrays = {"instruction": np.array(said[rows["task_index"].to_numpy()].tolist())}
    for theirs, ours in _MOTION_NAMES.items():
        found[ours] = np.array(rows[theirs].to_pylist(), dtype=_MOTION_TYPES[theirs])
    for name in CAMERAS:
        images = _images(rows[_CAMERA + name].to_pylist())
        found[name] = np.stack([np.asarray(image) for image in images])
    return found


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


def _table(columns: Mapping[str, Array], images: Mapping[str, Frame]) -> pa.Table:
    """Columns and images, with their types for the ``datasets`` library."""
    arrays: list[pa.Array] = [_pngs(frames) for frames in images.values()]
    features: dict[str, dict[str, Json]] = {name: {"_type": "Image"} for name in images}
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


def _levels(frames: Frame) -> Ints:
    """How often each color has each of its 256 levels. Shape (3, 256)."""
    return np.stack([np.bincount(frames[..., color].ravel(), minlength=256) for color in range(3)])


def _statistics(columns: Mapping[str, Array], images: Mapping[str, Ints]) -> dict[str, dict[str, Json]]:
    """Of every column but the mask; and, from their :func:`_levels`, of images, each color in [0, 1] as (3, 1, 1)."""
    levels = np.arange(256) / 255
    found: dict[str, dict[str, Json]] = {}
    for name, counts in images.items():
        means = [np.average(levels, weights=count) for count in counts]
        spreads = [
            np.average((levels - mean) ** 2, weights=count) ** 0.5 for mean, count in zip(means, counts, strict=True)
        ]
        seen = [levels[count > 0] for count in counts]
        colors = {"min": [s[0] for s in seen], "max": [s[-1] for s in seen], "mean": means, "std": spreads}
        found[name] = {which: [[[float(value)]] for value in values] for which, values in colors.items()}
    for name, column in columns.items():
        if name != _MASK:
            whichs = ("min", "max", "mean", "std")
            found[name] = {which: np.ravel(getattr(column, which)(axis=0)).astype(float).tolist() for which in whichs}
    rows = len(columns[_EPISODE])
    return {name: {**of, "count": [rows]} for name, of in found.items()}


def _tasks(text: list[str]) -> pa.Table:
    """The table of pandas whose index is the descriptions and whose one column is ``task_index``."""
    index = _INDEX
    column = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    columns = [
        {**column, "name": "task_index", "field_name": "task_index"},
        {**column, "name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"},
    ]
    told = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.2.0"}
    table = pa.table({"task_index": pa.array(range(len(text)), pa.int64()), index: text})
    return table.replace_schema_metadata({"pandas": json.dumps(told)})


def _features(episodes: Episodes) -> dict[str, Json]:
    features: dict[str, Json] = {}
    for name, dtype in _TYPES.items():
        names = ["macro_action"] if name == "action" else None
        features[name] = {"dtype": dtype, "shape": [1], "names": names}
    features[_MASK] = {"dtype": "bool", "shape": [episodes.n_actions], "names": None}
    features[_IMAGE] = {"dtype": "image", "shape": list(FRAME_SHAPE), "names": ["height", "width", "channels"]}
    return features


def _info(features: Mapping[str, Json], counts: Mapping[str, int], fps: float) -> dict[str, Json]:
    return {
        "codebase_version": _VERSION, "robot_type": None, **counts, "chunks_size": _FILES,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": fps,
        "splits": {"train": f"0:{counts['total_episodes']}"}, "data_path": f"data/{_PATH}", "video_path": None,
        "features": features,
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
    _require_on_time(column, count, info["fps"])
    if not np.array_equal(column["action"].astype(np.int64), column["action"]):
        raise InvalidValueError("an action is no integer")
    return lengths


def _require_on_time(column: Mapping[str, Any], count: Ints, fps: float) -> None:
    """Raise InvalidValueError if a row's number in its episode is not ``count``, or its time is not that of ``fps``."""
    on_time = np.abs(column["timestamp"] - count / fps) <= _TOLERANCE_S + 1e-6 * count
    wrong = np.flatnonzero(~on_time | (column["frame_index"] != count))
    if len(wrong):
        row = int(wrong[0])
        found = f"frame_index {column['frame_index'][row]} and timestamp {column['timestamp'][row]:g}"
        raise InvalidValueError(f"row {row} has {found}, but is row {count[row]} of its episode, at {fps} a second")


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
    images = _images(table[_IMAGE].to_pylist())
    for image in images:
        if (image.mode, image.size) != ("RGB", FRAME_SHAPE[:2]):
            raise InvalidValueError(f"an image is {image.mode} of {image.size} pixels")
    return np.stack([np.asarray(image) for image in images]), np.array(table[_MASK].to_pylist(), dtype=np.bool_)


def _images(column: Iterable[Mapping[str, bytes]]) -> list[PIL.Image.Image]:
    return [PIL.Image.open(io.BytesIO(image["bytes"]), formats=["PNG"]) for image in column]
