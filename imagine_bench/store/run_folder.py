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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.data import ProtocolData, digest
from imagine_bench.registry.old_names import agent_label
from imagine_bench.store.checkpoints import load_newest
from imagine_bench.store.codec import Arrays, pack, read_arrays, table_rows, table_text, unpack, write_arrays
from imagine_bench.store.counters import Counters
from imagine_bench.store.files import first_difference, read_sealed, reading, sealed, sha256, write_bytes, write_json
from imagine_bench.store.results import Checkpoint, ComparedRollout, KeptEpisodes, RunResult

FORMAT = "imagine_bench run 2"
_DONE, _CONFIG, _METRICS, _RECORDING = "DONE", "config.json", "metrics.csv", "recording.rrd"
_MEASURED, _IMAGINED, _TRAINING, _EPISODES = "measured.npz", "imagined.npz", "training.npz", "episodes.npz"
_DIAGNOSTIC = "diagnostics/"
_APART = ("diagnostics", "open_loop", "beliefs", "kept")
"""Fields of a row that have columns or a file of their own."""
_KEPT = tuple(field.name for field in dataclasses.fields(KeptEpisodes))


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
        rows = table_rows(path.read_text()) if path.is_file() else []
        return int(rows[-1]["episodes"]) if rows else 0


def check_config(folder: Path, config: Mapping[str, Any]) -> None:
    """Write what is run into a new run folder, or see that an old one holds the same.

    Raises:
        ArtefactError: The folder was begun with something else.
        SetupError: It cannot be written.
    """
    path, now = folder / _CONFIG, json.loads(json.dumps({"format": FORMAT, **config}))
    if not path.exists():
        write_json(path, sealed(now))
        return
    difference = first_difference(_config(folder), now)
    if difference is not None:
        name, was, would_be = difference
        raise ArtefactError(
            f"{folder} was begun with {name} {was!r}, and this version would use {would_be!r} on this machine; it was "
            "left untouched. Finish it with the version and on the kind of machine that began it, or choose another "
            "folder with --out."
        )


def _config(folder: Path) -> dict[str, Any]:
    config = read_sealed(folder / _CONFIG, "a run's configuration")
    if config.get("format") != FORMAT:
        raise ArtefactError(f"{folder / _CONFIG} was not written as {FORMAT!r}. It was left untouched.")
    return config


def require_run_of(folder: Path, protocol: ProtocolData, agent: str, seed: int) -> None:
    """Raise ArtefactError unless the run in ``folder`` is this agent's and seed's of this very protocol."""
    config = _config(folder)
    difference = first_difference(
        {name: config.get(name) for name in ("agent", "seed", "protocol_hash", "protocol")},
        {
            "agent": protocol.written_name(agent),
            "seed": seed,
            "protocol_hash": digest(config.get("protocol")),
            "protocol": protocol.as_dict(),
        },
    )
    if difference is not None:
        name, was, would_be = difference
        raise ArtefactError(
            f"{folder / _CONFIG} has {name} {was!r} where its bench has {would_be!r}. It was left untouched; put back "
            "what was written."
        )


def write_metrics(folder: Path, checkpoints: Sequence[Checkpoint]) -> None:
    """Write one row a budget done so far, atomically. Raises SetupError: it cannot be written."""
    rows = []
    for values in pack(list(checkpoints))[0]:
        diagnostics = {_DIAGNOSTIC + name: value for name, value in sorted(values["diagnostics"].items())}
        rows.append({**{name: value for name, value in values.items() if name not in _APART}, **diagnostics})
    write_bytes(folder / _METRICS, table_text(rows).encode())


def forget(folder: Path) -> None:
    """Remove the results and checkpoints of an unfinished run, which begins anew."""
    (folder / _METRICS).unlink(missing_ok=True)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)


def finish(
    folder: Path,
    counters: Counters,
    *,
    imagined: Sequence[ComparedRollout] = (),
    sampled_rollouts: Sequence[ComparedRollout] = (),
) -> None:
    """Write the results of a run and mark it as done, or raise SetupError and leave it unmarked."""
    write_metrics(folder, counters.rows)
    measured = [dataclasses.replace(row, kept=None) for row in counters.rows]
    write_arrays(folder / _MEASURED, pack(measured)[1])
    kept = [row.kept for row in counters.rows if row.kept is not None]
    if len(kept) == len(counters.rows):  # else it was begun by a version that kept none
        write_arrays(folder / _EPISODES, _side_by_side(kept))
    write_arrays(folder / _TRAINING, counters.training())
    rollouts = {"imagined": imagined, "sampled_rollouts": sampled_rollouts}
    write_arrays(folder / _IMAGINED, {n: a for name, each in rollouts.items() for n, a in pack(each, name)[1].items()})
    mark_done(folder, [_CONFIG, _METRICS, _MEASURED, _TRAINING, _IMAGINED])


def mark_done(folder: Path, names: Sequence[str]) -> None:
    """Mark a run as done: from now on these files of it, and its recording, never change.

    Raises SetupError: the mark cannot be written.
    """
    names = [*names, *(name for name in (_EPISODES, _RECORDING) if (folder / name).is_file())]
    digests = {name: sha256(folder / name) for name in names}
    write_json(folder / _DONE, sealed({"format": FORMAT, "sha256": digests}))


def require_done(folder: Path) -> dict[str, Any]:
    """The configuration of a finished run. Raises ArtefactError: it is unfinished, damaged or of another format."""
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
    return _config(folder)


def load_run(folder: Path) -> RunResult:
    """Read a finished run. Raises ArtefactError: it is unfinished, damaged or made by something else."""
    config = require_done(folder)
    training, rollouts = read_arrays(folder / _TRAINING), read_arrays(folder / _IMAGINED)
    recording = recording_path(folder)
    return RunResult(
        agent=agent_label(config["agent"], config["protocol"]),
        seed=config["seed"],
        checkpoints=_read_checkpoints(folder),
        settings=config["settings"],
        training_success=training["success"],
        training_length=training["length"],
        training_starts=training.get("starts"),
        tried=training.get("tried"),
        imagined=unpack(tuple[ComparedRollout, ...], None, rollouts, "imagined"),
        sampled_rollouts=unpack(tuple[ComparedRollout, ...], None, rollouts, "sampled_rollouts"),
        folder=folder,
        recording=recording if recording.is_file() else None,
    )


def load_unfinished(folder: Path) -> RunResult:
    """Read a run as far as its newest checkpoint has come. Raises ArtefactError: none is there, or it is damaged."""
    snapshot = load_newest(folder / "checkpoints")
    if snapshot is None:  # it had one a moment ago
        raise ArtefactError(f"{folder} is being begun anew; give the same command again.")
    config = _config(folder)
    with reading(folder / "checkpoints", "a run's checkpoint"):
        counters = Counters.of(snapshot)
    training = counters.training()
    with reading(folder / _CONFIG, "a run's configuration"):
        return RunResult(
            agent=agent_label(config["agent"], config["protocol"]),
            seed=config["seed"],
            checkpoints=tuple(counters.rows),
            settings=config["settings"],
            training_success=training["success"],
            training_length=training["length"],
            folder=folder,
        )


def _read_checkpoints(folder: Path) -> tuple[Checkpoint, ...]:
    values = []
    for row in table_rows((folder / _METRICS).read_text(), texts=("solved",)):
        diagnostics = {k.removeprefix(_DIAGNOSTIC): value for k, value in row.items() if k.startswith(_DIAGNOSTIC)}
        values.append({**row, "diagnostics": diagnostics})
    rows = unpack(tuple[Checkpoint, ...], values, read_arrays(folder / _MEASURED))
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
    for name in _KEPT:
        each = [getattr(test, name) for test in tests]
        array = np.concatenate(each) if name == "actions" else np.stack(each, axis=1)
        low, high = np.min_scalar_type(array.min(initial=0)), np.min_scalar_type(array.max(initial=0))
        arrays[name] = array.astype(np.promote_types(low, high)) if array.dtype == np.int64 else array
    return arrays


def _apart(arrays: Arrays) -> list[KeptEpisodes]:
    """The inverse of :func:`_side_by_side`."""
    wide = {name: array.astype(np.int64) if array.dtype.kind in "iu" else array for name, array in arrays.items()}
    ends = np.cumsum(wide["lengths"].sum(axis=0))[:-1]
    parts = {n: np.split(array, ends) if n == "actions" else np.moveaxis(array, 1, 0) for n, array in wide.items()}
    return [KeptEpisodes(**{name: parts[name][budget] for name in _KEPT}) for budget in range(len(ends) + 1)]
