"""The files of one run: written once, when it is finished, and read back with every number the report needs.

``config.json`` (what was run), ``metrics.csv`` (one row a budget), ``open_loop.npz``, ``futures.npz``, ``imagined.npz``
and ``sampled_rollouts.npz`` (of agents that imagine), ``training.npz``, ``recording.rrd``, ``log.txt``, ``checkpoints/``, and
last ``DONE``, with the digests of the results.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.capabilities import ImaginedRollout
from imagine_bench.errors import ArtefactError
from imagine_bench.store.files import csv_text, first_difference, read_json, reading, sha256, write_bytes, write_json
from imagine_bench.store.results import Checkpoint, ComparedRollout, Futures, OpenLoop, RunResult

FORMAT = "imagine_bench run 1"
_DONE, _CONFIG, _METRICS, _RECORDING = "DONE", "config.json", "metrics.csv", "recording.rrd"
_OPEN_LOOP, _IMAGINED, _TRAINING = "open_loop.npz", "imagined.npz", "training.npz"
_FUTURES, _COURSES = "futures.npz", "sampled_rollouts.npz"
_DIAGNOSTIC = "diagnostics/"
_INTEGERS = ("episodes", "env_steps", "test_episodes", "successes", "faults")
_NUMBERS = ("mean_return", "mean_length", "train_cpu_s", "eval_cpu_s")


def recording_path(folder: Path) -> Path:
    """Where a run's recording lies."""
    return folder / _RECORDING


def is_done(folder: Path) -> bool:
    """Whether the run in ``folder`` is finished."""
    return (folder / _DONE).is_file()


def reached(folder: Path) -> int:
    """The last budget at which the run in ``folder`` was tested, 0 before the first."""
    path = folder / _METRICS
    with reading(path, "the metrics of a run"):
        rows = list(csv.DictReader(io.StringIO(path.read_text()))) if path.is_file() else []
        return int(rows[-1]["episodes"]) if rows else 0


def check_config(folder: Path, config: Mapping[str, Any]) -> None:
    """Write what is run into a new run folder, or see that an old one holds the same.

    Raises:
        ArtefactError: The folder was begun with something else; the message names the first difference.
        SetupError: It cannot be written.
    """
    path, now = folder / _CONFIG, json.loads(json.dumps({"format": FORMAT, **config}))
    if not path.exists():
        write_json(path, now)
        return
    then = read_json(path, "a run's configuration")
    difference = first_difference(then, now)
    if difference is None:
        return
    name, was, would_be = difference
    raise ArtefactError(
        f"{folder} was begun with {name} {was!r}, and this version would use {would_be!r} on this machine; it was left "
        "untouched. Finish it with the version and on the kind of machine that began it, or choose another folder with "
        "--out."
    )


def write_metrics(folder: Path, checkpoints: Sequence[Checkpoint]) -> None:
    """Write one row a budget done so far, atomically.

    Raises:
        SetupError: It cannot be written.
    """
    names = sorted({name for checkpoint in checkpoints for name in checkpoint.diagnostics})
    fields = (*_INTEGERS, *_NUMBERS)
    rows = [
        [*(getattr(row, field) for field in fields), *(row.diagnostics.get(name, "") for name in names)]
        for row in checkpoints
    ]
    head = [*fields, *(_DIAGNOSTIC + name for name in names)]
    write_bytes(folder / _METRICS, csv_text([head, *rows]).encode())


def forget(folder: Path) -> None:
    """Remove the results and checkpoints of an unfinished run, which begins anew."""
    (folder / _METRICS).unlink(missing_ok=True)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)


def finish(
    folder: Path,
    *,
    checkpoints: Sequence[Checkpoint],
    training: Mapping[str, NDArray[Any]],
    imagined: Sequence[ComparedRollout],
    sampled_rollouts: Sequence[ComparedRollout],
) -> None:
    """Write the results of a run and mark it as done.

    Args:
        folder: The run's folder, with its ``config.json``.
        checkpoints: One a budget.
        training: ``success`` and ``length`` of each training episode.
        imagined: Example rollouts.
        sampled_rollouts: Several rollouts from one beginning.

    Raises:
        SetupError: Something cannot be written; the run is then not marked.
    """
    write_metrics(folder, checkpoints)
    write_arrays(folder / _TRAINING, training)
    loops = {str(row.episodes): row.open_loop for row in checkpoints if row.open_loop is not None}
    write_arrays(folder / _OPEN_LOOP, {f"{n}/{k}": v for n, loop in loops.items() for k, v in _arrays(loop).items()})
    write_arrays(folder / _FUTURES, futures_arrays(checkpoints))
    _write_rollouts(folder / _IMAGINED, imagined)
    _write_rollouts(folder / _COURSES, sampled_rollouts)
    names = [_CONFIG, _METRICS, _TRAINING, _OPEN_LOOP, _FUTURES, _IMAGINED, _COURSES]
    mark_done(folder, names)


def mark_done(folder: Path, names: Sequence[str]) -> None:
    """Mark a run as done: from now on these files of it never change.

    Raises:
        SetupError: The mark cannot be written.
    """
    write_json(folder / _DONE, {"format": FORMAT, "sha256": {name: sha256(folder / name) for name in names}})


def require_done(folder: Path) -> dict[str, Any]:
    """What was run in a finished folder, whose files are all as the run left them.

    Raises:
        ArtefactError: It is unfinished, damaged or made by something else; the message names the file.
    """
    done = read_json(folder / _DONE, "the mark of a finished run")
    if done.get("format") != FORMAT or not isinstance(done.get("sha256"), dict):
        raise ArtefactError(f"{folder / _DONE} was not written as {FORMAT!r}. It was left untouched.")
    for name, digest in done["sha256"].items():
        if sha256(folder / name) != digest:
            raise ArtefactError(
                f"{folder / name} is not as the run left it (it was changed or damaged). It was left untouched; delete "
                f"{folder} to run it anew."
            )
    config: dict[str, Any] = read_json(folder / _CONFIG, "a run's configuration")
    return config


def load_run(folder: Path) -> RunResult:
    """Read a finished run.

    Raises:
        ArtefactError: It is unfinished, damaged or made by something else; the message names the file.
    """
    config = require_done(folder)
    training = read_arrays(folder / _TRAINING)
    recording = recording_path(folder)
    return RunResult(
        agent=config["agent"],
        seed=config["seed"],
        checkpoints=with_futures(_read_metrics(folder), read_arrays(folder / _FUTURES)),
        settings=config["settings"],
        training_success=training["success"],
        training_length=training["length"],
        imagined=_read_rollouts(folder / _IMAGINED),
        sampled_rollouts=_read_rollouts(folder / _COURSES),
        folder=folder,
        recording=recording if recording.is_file() else None,
    )


def checkpoint_to_json(checkpoint: Checkpoint) -> dict[str, Any]:
    """A row as JSON-serialisable values, for snapshots, but for its futures: see :func:`futures_arrays`."""
    values = {field.name: getattr(checkpoint, field.name) for field in dataclasses.fields(checkpoint)}
    loop = checkpoint.open_loop
    values["diagnostics"] = dict(checkpoint.diagnostics)
    values["open_loop"] = None if loop is None else {name: array.tolist() for name, array in _arrays(loop).items()}
    values["futures"] = None
    return values


def checkpoint_from_json(values: Mapping[str, Any]) -> Checkpoint:
    """The inverse of :func:`checkpoint_to_json`."""
    loop = values["open_loop"]
    return Checkpoint(**{**values, "open_loop": None if loop is None else _open_loop(loop)})


def futures_arrays(checkpoints: Sequence[Checkpoint]) -> dict[str, NDArray[Any]]:
    """The futures of all rows, by budget and name."""
    found = {str(row.episodes): row.futures for row in checkpoints if row.futures is not None}
    return {f"{budget}/{name}": array for budget, each in found.items() for name, array in _arrays(each).items()}


def with_futures(checkpoints: Sequence[Checkpoint], arrays: Mapping[str, NDArray[Any]]) -> tuple[Checkpoint, ...]:
    """The rows with their futures, as :func:`futures_arrays` gave them."""
    found = {budget: Futures(**parts) for budget, parts in grouped(arrays).items()}
    return tuple(dataclasses.replace(row, futures=found.get(str(row.episodes))) for row in checkpoints)


def _open_loop(arrays: Mapping[str, Any]) -> OpenLoop:
    integers = {"count": np.asarray(arrays["count"], dtype=np.int64)}
    unmeasured = np.full(len(integers["count"]), np.nan)  # by the version that made an older run
    names = [field.name for field in dataclasses.fields(OpenLoop) if field.name not in integers]
    numbers: dict[str, Any] = {name: np.asarray(arrays.get(name, unmeasured), dtype=np.float64) for name in names}
    return OpenLoop(**{**numbers, **integers})


def _read_metrics(folder: Path) -> tuple[Checkpoint, ...]:
    loops = grouped(read_arrays(folder / _OPEN_LOOP))
    rows = csv.DictReader(io.StringIO((folder / _METRICS).read_text()))
    return tuple(
        Checkpoint(
            **_counted(row),
            diagnostics={
                name.removeprefix(_DIAGNOSTIC): float(value)
                for name, value in row.items()
                if name.startswith(_DIAGNOSTIC) and value != ""
            },
            open_loop=_open_loop(loops[row["episodes"]]) if row["episodes"] in loops else None,
        )
        for row in rows
    )


def _counted(row: Mapping[str, str]) -> dict[str, Any]:
    return {**{name: int(row[name]) for name in _INTEGERS}, **{name: float(row[name]) for name in _NUMBERS}}


def _write_rollouts(path: Path, rollouts: Sequence[ComparedRollout]) -> None:
    write_arrays(path, {f"{n}/{k}": v for n, one in enumerate(rollouts) for k, v in _arrays(one).items()})


def _read_rollouts(path: Path) -> tuple[ComparedRollout, ...]:
    examples = []
    for _, arrays in sorted(grouped(read_arrays(path)).items()):
        rollout = {name.partition("/")[2]: array for name, array in arrays.items() if name.startswith("rollout/")}
        rest = {name: array for name, array in arrays.items() if "/" not in name}
        examples.append(ComparedRollout(rollout=ImaginedRollout(**rollout), **rest))
    return tuple(examples)


def _arrays(record: Any, prefix: str = "") -> dict[str, NDArray[Any]]:
    """The arrays of a dataclass by slashed name."""
    arrays: dict[str, NDArray[Any]] = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            arrays.update(_arrays(value, f"{prefix}{field.name}/"))
        else:
            arrays[prefix + field.name] = np.asarray(value)
    return arrays


def grouped(arrays: Mapping[str, NDArray[Any]]) -> dict[str, dict[str, NDArray[Any]]]:
    """Arrays by the first part of their slashed names."""
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for name, array in arrays.items():
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest] = array
    return groups


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays, atomically.

    Raises:
        SetupError: They cannot be written.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The inverse of :func:`write_arrays`.

    Raises:
        ArtefactError: The file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ArtefactError(f"{path} is not an array file of a run: {error}. It was left untouched.") from error
