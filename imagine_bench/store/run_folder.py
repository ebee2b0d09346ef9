"""The files of one run: its configuration, its metrics, one checkpoint, and the digests of all that is finished.

``config.json`` (the run's configuration), ``metrics.csv`` (one row a budget), ``checkpoints/`` (the newest holds
everything that was measured), ``imagined.npz`` (rollouts of agents that imagine, and two recorded episodes),
``recording.rrd``,
``log.txt``, and last ``DONE``, with the digests of the others. Finished runs of before 2026-11-28 have more files,
which nobody reads.

A checkpoint is a folder ``checkpoint_000007_episode_120`` (the seventh of its run) of ``agent.safetensors``,
``runner.safetensors`` and ``state.json``, which has its own digest and those of the other two. It is complete once it
has its name, so that a ``kill -9`` at any moment damages none; one of another name is none. The newest is kept; the one
before it goes when the newer is complete. :func:`.values.pack` turns the state of a runner into JSON-like values and
named arrays, and :func:`.values.unpack` reads it back to the bit.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import ArtefactError, writing
from imagine_bench.interfaces import AgentState
from imagine_bench.protocols.data import ProtocolData, RunSpec
from imagine_bench.registry.entries import agent_label
from imagine_bench.store.files import (
    first_difference,
    lock,
    make_folder,
    read_arrays,
    read_sealed,
    reading,
    sealed,
    sha256,
    sweep,
    sync_folder,
    table_text,
    write_arrays,
    write_bytes,
    write_json,
)
from imagine_bench.store.results import Checkpoint, ComparedRollout, KeptEpisodes, RecordedEpisode, RunResult
from imagine_bench.values import Json, grouped, pack, unpack

_SNAPSHOT = "imagine_bench checkpoint 2"
_NAME = re.compile(r"checkpoint_([0-9]{6,})_episode_([0-9]+)")
_PARTIAL = ".partial_"
_AGENT = "agent.safetensors"
_RUNNER = "runner.safetensors"
_STATE = "state.json"
TRAINING = "training"
"""The group of a checkpoint's arrays that holds the training episodes."""


def training_arrays(kept: KeptEpisodes) -> Arrays:
    """A run's training episodes as arrays of its checkpoint, integers in the smallest type that holds them."""
    arrays = {}
    for name, array in pack(kept, TRAINING)[1].items():
        is_natural = array.dtype.kind == "i" and array.size > 0 and array.min() >= 0
        arrays[name] = array.astype(np.min_scalar_type(array.max())) if is_natural else array
    return arrays


def training_of(snapshot: Snapshot) -> KeptEpisodes | None:
    """The training episodes that a checkpoint holds, or None: an earlier version kept none."""
    arrays = grouped(snapshot.arrays).get(TRAINING)
    if arrays is None:
        return None
    wide = {name: array.astype(np.int64) if array.dtype.kind == "u" else array for name, array in arrays.items()}
    kept: KeptEpisodes = unpack(KeptEpisodes, None, wide)
    return kept


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """An agent and the runner around it, after a whole number of episodes."""

    episode: int  #: Training episodes done
    agent: AgentState  #: The agent's own state
    arrays: Mapping[str, Array]  #: The runner's arrays
    values: Mapping[str, Any]  #: The runner's JSON-serialisable values


def save_snapshot(folder: Path, snapshot: Snapshot) -> Path:
    """Write a snapshot as a folder below ``folder``, remove the ones it replaces, and return where it lies.

    Raises SetupError: it cannot be written; the earlier checkpoint is untouched.
    """
    make_folder(folder)
    earlier = _checkpoints(folder)
    number = _number(earlier[-1]) + 1 if earlier else 1
    final = folder / f"checkpoint_{number:06d}_episode_{snapshot.episode}"
    partial = folder / f"{_PARTIAL}{final.name}"
    with writing(final):
        _sweep_partial(folder)
        partial.mkdir()
        parts = {_AGENT: snapshot.agent.arrays, _RUNNER: snapshot.arrays}
        digests = {}
        for name, arrays in parts.items():
            content = save({array_name: np.asarray(array, order="C") for array_name, array in arrays.items()})
            write_bytes(partial / name, content)
            digests[name] = hashlib.sha256(content).hexdigest()
        state: dict[str, Json] = {
            "format": _SNAPSHOT,
            "name": final.name,
            "episode": snapshot.episode,
            "sha256": digests,
            "agent": snapshot.agent.values,
            "runner": snapshot.values,
        }
        write_json(partial / _STATE, sealed(state))
        partial.replace(final)
        sync_folder(folder)
        for old in earlier:  # its name goes first, so that no half of it can pass for a whole one
            shutil.rmtree(old.rename(old.with_name(f"{_PARTIAL}{old.name}")))
    return final


def load_newest(folder: Path, *, agent: bool = True) -> Snapshot | None:
    """The newest checkpoint below ``folder``, or None; the run may go on meanwhile. ArtefactError: it is damaged."""
    while found := _checkpoints(folder):
        try:
            return load_snapshot(found[-1], agent=agent)
        except ArtefactError:
            if found[-1].is_dir():  # else a newer one has replaced it
                raise
    return None


def load_snapshot(checkpoint: Path, *, agent: bool = True) -> Snapshot:
    """Read one checkpoint folder, with the agent's arrays or without.

    Raises ArtefactError: it is damaged or not a checkpoint.
    """
    path = checkpoint / _STATE
    what = f"the state of an {_SNAPSHOT!r}"
    state = read_sealed(path, what)
    with reading(path, what):
        if (state["format"], state["name"]) != (_SNAPSHOT, checkpoint.name):
            raise ValueError(f"it is {state['name']} of {state['format']!r}")
        of_agent = _unpacked(checkpoint / _AGENT, state["sha256"]) if agent else {}
        return Snapshot(
            episode=state["episode"],
            agent=AgentState(arrays=of_agent, values=state["agent"]),
            arrays=_unpacked(checkpoint / _RUNNER, state["sha256"]),
            values=state["runner"],
        )


def _sweep_partial(folder: Path) -> None:
    """Remove checkpoints below ``folder`` of a process that was killed while it wrote or removed them."""
    for leftover in folder.glob(f"{_PARTIAL}*"):
        shutil.rmtree(leftover)


def _checkpoints(folder: Path) -> list[Path]:
    """Complete checkpoints, the newest last; a folder that somebody copied or renamed has another name."""
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted((path for path in found if _NAME.fullmatch(path.name) and path.is_dir()), key=_number)


def _number(checkpoint: Path) -> int:
    return int(checkpoint.name.split("_")[1])


def _unpacked(path: Path, digests: Mapping[str, str]) -> Arrays:
    if sha256(path) != digests[path.name]:
        raise ArtefactError(
            f"{path} is damaged: its content is not as it was written. It was left untouched; delete the run's folder "
            "to start that run anew."
        )
    arrays: Arrays = load(path.read_bytes())
    return arrays


FORMAT = "imagine_bench run 3"
WITHOUT_TRAINING = "imagine_bench run 2"
"""The format of runs that a version of before 2026-11-28 began, which kept no training episodes."""
CHECKPOINTS = "checkpoints"
"""The folder of a run's checkpoints, below its own."""
_DONE = "DONE"
_CONFIG = "config.json"
_METRICS = "metrics.csv"
_RECORDING = "recording.rrd"
_IMAGINED = "imagined.npz"
_DIAGNOSTIC = "diagnostics/"
_APART = ("diagnostics", "open_loop", "beliefs", "kept")
"""Fields of a row that have columns of their own or none."""
_ROLLOUTS = tuple[ComparedRollout, ...]


def recording_path(folder: Path) -> Path:
    """Return where a run's recording lies."""
    return folder / _RECORDING


def is_done(folder: Path) -> bool:
    """Return whether the run in ``folder`` is finished."""
    return (folder / _DONE).is_file()


def mark_digest(folder: Path) -> str:
    """Twelve hex digits of the mark of a finished run, which has the digests of its files; empty of an unfinished
    one.
    """
    return sha256(folder / _DONE)[:12] if is_done(folder) else ""


@contextmanager
def unfinished(folder: Path) -> Iterator[bool]:
    """Hold a run's folder for this process, without the leftovers of a killed one; yields whether anything is left to
    do.

    Raises:
        BusyError: Another process is at this run.
        SetupError: The folder cannot be written.
    """
    make_folder(folder)
    with lock(folder / ".lock", f"The run folder {folder}", patience_s=5.0):  # a killed parent's child may be dying
        with writing(folder):
            sweep(folder)
            _sweep_partial(folder / CHECKPOINTS)
        yield not is_done(folder)


def check_config(folder: Path, spec: RunSpec[ProtocolData], learner: object) -> None:
    """Write the configuration of a run into a new run folder, or compare it with that of an old one.

    Args:
        folder: The run's folder.
        spec: The run.
        learner: Its agent or regressor, whose ``settings`` are kept if it has any.

    Raises:
        ArtefactError: The folder was begun with something else.
        SetupError: It cannot be written.
    """
    settings = getattr(learner, "settings", None)
    is_new = not (folder / _CONFIG).exists()
    config = {
        "format": FORMAT if is_new else read_config(folder)["format"],
        "protocol": spec.protocol.as_dict(),
        "protocol_hash": spec.protocol.hash,
        "agent": spec.protocol.written_name(spec.agent),
        "seed": spec.seed,
        "settings": {} if settings is None else dataclasses.asdict(settings),
    }
    now = json.loads(json.dumps(config))
    if is_new:
        write_json(folder / _CONFIG, sealed(now))
    _require_same(
        folder,
        now,
        "Finish it with the version and on the kind of machine that began it, or choose another folder with --out.",
    )


def _require_same(folder: Path, wanted: Mapping[str, Json], remedy: str) -> None:
    """Raise ArtefactError where a run's configuration has other values than ``wanted``."""
    config = read_config(folder)
    difference = first_difference({name: config.get(name) for name in wanted}, wanted)
    if difference is not None:
        name, was, would_be = difference
        raise ArtefactError(
            f"{folder / _CONFIG} has {name} {was!r} where {would_be!r} is wanted now. It was left untouched. {remedy}"
        )


def read_config(folder: Path) -> dict[str, Any]:
    """Return the configuration of a run: protocol, agent, seed, settings. Raises ArtefactError: it is missing or
    damaged.
    """
    path = folder / _CONFIG
    values = read_sealed(path, "a run's configuration; give a run's folder, .../<agent>/seed_<n>")
    if values.get("format") not in (FORMAT, WITHOUT_TRAINING):
        raise ArtefactError(f"{path} was not written as {FORMAT!r}. It was left untouched.")
    return values


def require_run_of(folder: Path, protocol: ProtocolData, agent: str, seed: int) -> None:
    """Raise ArtefactError unless the run in ``folder`` is this agent's and seed's of this very protocol."""
    wanted: dict[str, Json] = {"agent": protocol.written_name(agent), "seed": seed, "protocol": protocol.as_dict()}
    _require_same(folder, wanted, "Put back the file that its bench wrote.")


def write_metrics(folder: Path, checkpoints: Sequence[Checkpoint]) -> None:
    """Write one row a budget done so far, atomically. Raises SetupError: it cannot be written."""
    write_bytes(folder / _METRICS, table_text(_metrics(checkpoints)).encode())


def _metrics(checkpoints: Sequence[Checkpoint]) -> list[dict[str, float | str]]:
    rows = []
    for values in pack(checkpoints)[0]:
        row = {name: value for name, value in values.items() if name not in _APART}
        diagnostics = sorted(values["diagnostics"].items())
        rows.append(row | {_DIAGNOSTIC + name: value for name, value in diagnostics})
    return rows


def forget(folder: Path) -> None:
    """Remove the results and checkpoints of an unfinished run, which begins anew."""
    (folder / _METRICS).unlink(missing_ok=True)
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)


def finish(
    folder: Path,
    *,
    imagined: Sequence[ComparedRollout] = (),
    sampled_rollouts: Sequence[ComparedRollout] = (),
    recorded: Sequence[RecordedEpisode] = (),
) -> None:
    """Keep the measurements of observers at a run's end and mark it as done, or raise SetupError and leave it
    unmarked.
    """
    shown = {"imagined": imagined, "sampled_rollouts": sampled_rollouts, "recorded": recorded}
    write_arrays(folder / _IMAGINED, pack(shown)[1])
    newest = _checkpoints(folder / CHECKPOINTS)[-1].relative_to(folder)
    parts = [(newest / name).as_posix() for name in (_STATE, _AGENT, _RUNNER)]
    mark_done(folder, [_CONFIG, _METRICS, _IMAGINED, *parts])


def mark_done(folder: Path, names: Sequence[str]) -> None:
    """Mark a run as done: from now on these files of it, and its recording, never change.

    Raises SetupError: the mark cannot be written.
    """
    recorded = [_RECORDING] if recording_path(folder).is_file() else []
    digests = {name: sha256(folder / name) for name in [*names, *recorded]}
    write_json(folder / _DONE, sealed({"format": read_config(folder)["format"], "sha256": digests}))


def require_done(folder: Path) -> dict[str, Any]:
    """Return the configuration of a finished run.

    Raises ArtefactError: the run is unfinished, damaged or of another format.
    """
    what = "the mark of a finished run"
    done = read_sealed(folder / _DONE, what)
    with reading(folder / _DONE, what):
        digests = {_CONFIG: "", _METRICS: "", **done["sha256"]}  # these have one in every run
    for name, written in digests.items():
        path = folder / name
        found = sha256(path) if path.exists() else None
        if found == written or (found is None and name == _RECORDING):  # recordings are large, and nothing needs them
            continue
        how = "missing" if found is None else "not as the run left it"
        remedy = f"put it back, or delete {folder} to run it anew"
        raise ArtefactError(f"{path} is {how}, although the run is finished. It was left untouched; {remedy}.")
    return read_config(folder)


def load_run(folder: Path) -> RunResult:
    """Read a finished run. Raises ArtefactError: it is unfinished, damaged or made by something else."""
    require_done(folder)
    result = _result(folder)
    if result is None:
        raise ArtefactError(f"{folder} has no checkpoint, which holds its results; delete {folder} to run it anew.")
    with reading(folder / _METRICS, "the table of a run"):
        table = (folder / _METRICS).read_text()
    is_older = (folder / "measured.npz").exists()  # its table may have fewer columns
    columns = table.partition("\n")[0].split(",") if is_older else None
    if table != table_text(_metrics(result.checkpoints), columns):
        raise ArtefactError(f"{folder / _METRICS} says something else than its checkpoint. It was left untouched.")
    rollouts = grouped(read_arrays(folder / _IMAGINED))
    recording = recording_path(folder)
    return dataclasses.replace(
        result,
        imagined=unpack(_ROLLOUTS, None, rollouts.get("imagined", {})),
        sampled_rollouts=unpack(_ROLLOUTS, None, rollouts.get("sampled_rollouts", {})),
        recorded=unpack(tuple[RecordedEpisode, ...], None, rollouts.get("recorded", {})),
        recording=recording if recording.is_file() else None,
    )


def load_so_far(folder: Path) -> RunResult | None:
    """Read a run as far as it has come: its results, or those of its newest checkpoint; None before the first.

    Raises ArtefactError: a file is damaged.
    """
    return load_run(folder) if is_done(folder) else _result(folder)


def tried_pairs(tried: Mapping[str, int]) -> list[list[int]]:
    """Macrostate, macro-action and episode of each pair, of which a checkpoint keeps the former two as a text."""
    return [[*map(int, pair.split()), episode] for pair, episode in tried.items()]


def _result(folder: Path) -> RunResult | None:
    """The results in the newest checkpoint of a run, without those of its end; None before the first."""
    snapshot = load_newest(folder / CHECKPOINTS, agent=False)
    if snapshot is None:
        return None
    config = read_config(folder)
    with reading(folder / CHECKPOINTS, "a run's checkpoint"):
        values = snapshot.values
        rows = unpack(tuple[Checkpoint, ...], values["rows"], grouped(snapshot.arrays).get("rows", {}))
        tried = values.get("tried")
        pairs = None if tried is None else tried_pairs(tried)
        return RunResult(
            agent=agent_label(config["agent"], config["protocol"]),
            seed=config["seed"],
            checkpoints=rows,
            settings=config["settings"],
            training_success=np.array(values["success"], dtype=np.bool_),
            training_length=np.array(values["length"], dtype=np.int64),
            training=training_of(snapshot),
            tried=None if pairs is None else np.array(pairs, dtype=np.int32),
            folder=folder,
        )
