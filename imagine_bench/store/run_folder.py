"""The files of one run: written once, when it is finished, and read back with every number the report needs.

``config.json`` (what was run), ``metrics.csv`` (one row a budget), ``episodes.npz`` (the test episodes; runs of before
2026-11-24 have none), ``measured.npz`` (what observers measured at the budgets), ``imagined.npz`` (rollouts of agents
that imagine), ``training.npz``, ``recording.rrd``, ``log.txt``, ``checkpoints/``, and last ``DONE``, with the digests
of the results.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.arrays import Arrays
from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.protocols.runs import RunSpec
from imagine_bench.registry.old_names import agent_label
from imagine_bench.store.checkpoints import Snapshot, load_newest, sweep_partial
from imagine_bench.store.codec import pack, read_arrays, table_rows, table_text, unpack, write_arrays
from imagine_bench.store.files import (
    first_difference,
    lock,
    make_folder,
    read_sealed,
    reading,
    sealed,
    sha256,
    sweep,
    write_bytes,
    write_json,
    writing,
)
from imagine_bench.store.results import Checkpoint, ComparedRollout, KeptEpisodes, RunResult
from imagine_bench.values import Json

FORMAT = "imagine_bench run 2"
CHECKPOINTS = "checkpoints"
"""The folder of a run's checkpoints, below its own."""
_DONE = "DONE"
_CONFIG = "config.json"
_METRICS = "metrics.csv"
_RECORDING = "recording.rrd"
_MEASURED = "measured.npz"
_IMAGINED = "imagined.npz"
_TRAINING = "training.npz"
_EPISODES = "episodes.npz"
_DIAGNOSTIC = "diagnostics/"
_APART = ("diagnostics", "open_loop", "beliefs", "kept")
"""Fields of a row that have columns or a file of their own."""


def recording_path(folder: Path) -> Path:
    """Return where a run's recording lies."""
    return folder / _RECORDING


def is_done(folder: Path) -> bool:
    """Return whether the run in ``folder`` is finished."""
    return (folder / _DONE).is_file()


def reached(folder: Path) -> int:
    """Return the last budget at which the run in ``folder`` was tested, 0 before the first."""
    path = folder / _METRICS
    with reading(path, "the metrics of a run"):
        rows = table_rows(path.read_text()) if path.is_file() else []
        return int(rows[-1]["episodes"]) if rows else 0


@contextmanager
def unfinished(folder: Path) -> Iterator[bool]:
    """Hold a run's folder for this process; yields whether there is anything left to do.

    Raises:
        BusyError: Another process is at this run.
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    with lock(folder / ".lock", f"The run folder {folder}", patience_s=5.0):  # a killed parent's child may be dying
        yield not is_done(folder)


def newest_snapshot(folder: Path) -> Snapshot | None:
    """Return the newest checkpoint of a run, None before the first; what a killed process left half done goes.

    Raises:
        ArtefactError: The checkpoint is damaged.
        SetupError: The folder cannot be written.
    """
    with writing(folder):
        sweep(folder)
        sweep_partial(folder / CHECKPOINTS)
    return load_newest(folder / CHECKPOINTS)


def check_config(folder: Path, spec: RunSpec[ProtocolData], learner: object) -> None:
    """Write what is run into a new run folder, or compare it with what an old one holds.

    Args:
        folder: The run's folder.
        spec: The run.
        learner: Its agent or regressor, whose ``settings`` are kept if it has any.

    Raises:
        ArtefactError: The folder was begun with something else.
        SetupError: It cannot be written.
    """
    settings = getattr(learner, "settings", None)
    config = {
        "format": FORMAT,
        "protocol": spec.protocol.as_dict(),
        "protocol_hash": spec.protocol.hash,
        "agent": spec.protocol.written_name(spec.agent),
        "seed": spec.seed,
        "settings": {} if settings is None else dataclasses.asdict(settings),
    }
    path = folder / _CONFIG
    now = json.loads(json.dumps(config))
    if not path.exists():
        write_json(path, sealed(now))
        return
    difference = first_difference(read_config(folder), now)
    if difference is not None:
        name, was, would_be = difference
        raise ArtefactError(
            f"{folder} was begun with {name} {was!r}, and this version would use {would_be!r} on this machine; it was "
            "left untouched. Finish it with the version and on the kind of machine that began it, or choose another "
            "folder with --out."
        )


def read_config(folder: Path) -> dict[str, Any]:
    """Return what was run: protocol, agent, seed, settings. Raises ArtefactError: it is missing or damaged."""
    config = read_sealed(folder / _CONFIG, "a run's configuration; give a run's folder, .../<agent>/seed_<n>")
    if config.get("format") != FORMAT:
        raise ArtefactError(f"{folder / _CONFIG} was not written as {FORMAT!r}. It was left untouched.")
    return config


def require_run_of(folder: Path, protocol: ProtocolData, agent: str, seed: int) -> None:
    """Raise ArtefactError unless the run in ``folder`` is this agent's and seed's of this very protocol."""
    config = read_config(folder)
    protocol_hash = digest(config.get("protocol"))
    wanted: dict[str, Json] = {
        "agent": protocol.written_name(agent),
        "seed": seed,
        "protocol_hash": protocol_hash,
        "protocol": protocol.as_dict(),
    }
    difference = first_difference({name: config.get(name) for name in wanted}, wanted)
    if difference is not None:
        name, was, would_be = difference
        raise ArtefactError(
            f"{folder / _CONFIG} has {name} {was!r} where its bench has {would_be!r}. It was left untouched; put back "
            "what was written."
        )


def write_metrics(folder: Path, checkpoints: Sequence[Checkpoint]) -> None:
    """Write one row a budget done so far, atomically. Raises SetupError: it cannot be written."""
    rows = []
    for values in pack(checkpoints)[0]:
        row = {name: value for name, value in values.items() if name not in _APART}
        diagnostics = sorted(values["diagnostics"].items())
        rows.append(row | {_DIAGNOSTIC + name: value for name, value in diagnostics})
    write_bytes(folder / _METRICS, table_text(rows).encode())


def forget(folder: Path) -> None:
    """Remove the results and checkpoints of an unfinished run, which begins anew."""
    (folder / _METRICS).unlink(missing_ok=True)
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)


def finish(
    folder: Path,
    checkpoints: Sequence[Checkpoint],
    training: Arrays,
    *,
    imagined: Sequence[ComparedRollout] = (),
    sampled_rollouts: Sequence[ComparedRollout] = (),
) -> None:
    """Write the results of a run and mark it as done, or raise SetupError and leave it unmarked.

    ``training`` holds ``success`` (episodes,), ``length`` (episodes,) and what else is kept of training.
    """
    write_metrics(folder, checkpoints)
    write_arrays(folder / _MEASURED, pack([dataclasses.replace(row, kept=None) for row in checkpoints])[1])
    kept = [row.kept for row in checkpoints if row.kept is not None]
    if len(kept) == len(checkpoints):  # else it was begun by a version that kept none
        write_arrays(folder / _EPISODES, _side_by_side(kept))
    write_arrays(folder / _TRAINING, training)
    write_arrays(folder / _IMAGINED, pack(imagined, "imagined")[1] | pack(sampled_rollouts, "sampled_rollouts")[1])
    mark_done(folder, [_CONFIG, _METRICS, _MEASURED, _TRAINING, _IMAGINED])


def mark_done(folder: Path, names: Sequence[str]) -> None:
    """Mark a run as done: from now on these files of it, and its recording, never change.

    Raises SetupError: the mark cannot be written.
    """
    beside = [name for name in (_EPISODES, _RECORDING) if (folder / name).is_file()]
    digests = {name: sha256(folder / name) for name in [*names, *beside]}
    write_json(folder / _DONE, sealed({"format": FORMAT, "sha256": digests}))


def require_done(folder: Path) -> dict[str, Any]:
    """Return the configuration of a finished run.

    Raises ArtefactError: the run is unfinished, damaged or of another format.
    """
    done = read_sealed(folder / _DONE, "the mark of a finished run")
    if done.get("format") != FORMAT or not isinstance(done.get("sha256"), dict):
        raise ArtefactError(f"{folder / _DONE} was not written as {FORMAT!r}. It was left untouched.")
    for name, written in done["sha256"].items():
        if name == _RECORDING and not recording_path(folder).exists():
            continue  # recordings are large, and nothing else needs them
        if sha256(folder / name) != written:
            raise ArtefactError(
                f"{folder / name} is not as the run left it (it was changed or damaged). It was left untouched; delete "
                f"{folder} to run it anew."
            )
    return read_config(folder)


def load_run(folder: Path) -> RunResult:
    """Read a finished run. Raises ArtefactError: it is unfinished, damaged or made by something else."""
    config = require_done(folder)
    rollouts = read_arrays(folder / _IMAGINED)
    kind = tuple[ComparedRollout, ...]
    recording = recording_path(folder)
    result = _result(folder, config, _read_checkpoints(folder), read_arrays(folder / _TRAINING))
    return dataclasses.replace(
        result,
        imagined=unpack(kind, None, rollouts, "imagined"),
        sampled_rollouts=unpack(kind, None, rollouts, "sampled_rollouts"),
        recording=recording if recording.is_file() else None,
    )


def load_so_far(folder: Path) -> RunResult | None:
    """Read a run as far as it has come: its results, or what its newest checkpoint holds; None before the first.

    Raises ArtefactError: a file is damaged.
    """
    if is_done(folder):
        return load_run(folder)
    snapshot = load_newest(folder / CHECKPOINTS)
    if snapshot is None:
        return None
    with reading(folder / CHECKPOINTS, "a run's checkpoint"):
        rows = unpack(tuple[Checkpoint, ...], snapshot.values["rows"], snapshot.arrays, "rows")
        training = {
            "success": np.array(snapshot.values["success"], dtype=np.bool_),
            "length": np.array(snapshot.values["length"], dtype=np.int64),
        }
    return _result(folder, read_config(folder), rows, training)


def _result(folder: Path, config: Mapping[str, Any], rows: tuple[Checkpoint, ...], training: Arrays) -> RunResult:
    with reading(folder / _CONFIG, "a run's configuration"):
        return RunResult(
            agent=agent_label(config["agent"], config["protocol"]),
            seed=config["seed"],
            checkpoints=rows,
            settings=config["settings"],
            training_success=training["success"],
            training_length=training["length"],
            training_starts=training.get("starts"),
            tried=training.get("tried"),
            folder=folder,
        )


def _read_checkpoints(folder: Path) -> tuple[Checkpoint, ...]:
    values = []
    for row in table_rows((folder / _METRICS).read_text(), texts=("solved",)):
        diagnostics = {k.removeprefix(_DIAGNOSTIC): value for k, value in row.items() if k.startswith(_DIAGNOSTIC)}
        values.append({**row, "diagnostics": diagnostics})
    rows: tuple[Checkpoint, ...] = unpack(tuple[Checkpoint, ...], values, read_arrays(folder / _MEASURED))
    if not (folder / _EPISODES).exists():
        return rows
    with reading(folder / _EPISODES, "the test episodes of a run"):
        kept = _apart(read_arrays(folder / _EPISODES))
        return tuple(dataclasses.replace(row, kept=each) for row, each in zip(rows, kept, strict=True))


def _side_by_side(tests: Sequence[KeptEpisodes]) -> Arrays:
    """B tests of K episodes as arrays (K, B, ...), so that what they have in common is compressed away.

    ``actions`` are one test's behind another's. Integers are of the smallest type that holds them.
    """
    arrays: Arrays = {}
    for name in vars(tests[0]):
        each = [getattr(test, name) for test in tests]
        array = np.concatenate(each) if name == "actions" else np.stack(each, axis=1)
        if array.dtype == np.int64:
            low = np.min_scalar_type(array.min(initial=0))
            high = np.min_scalar_type(array.max(initial=0))
            array = array.astype(np.promote_types(low, high))
        arrays[name] = array
    return arrays


def _apart(arrays: Arrays) -> list[KeptEpisodes]:
    """The inverse of :func:`_side_by_side`."""
    wide: Arrays = {
        name: array.astype(np.int64) if array.dtype.kind in "iu" else array for name, array in arrays.items()
    }
    ends = np.cumsum(wide["lengths"].sum(axis=0))
    actions = np.split(wide.pop("actions"), ends[:-1])
    return [
        KeptEpisodes(actions=actions[budget], **{name: array[:, budget] for name, array in wide.items()})
        for budget in range(len(ends))
    ]
