"""Snapshots that a ``kill -9`` at any moment cannot damage: one folder each, complete once it has its name.

:func:`pack` turns what a runner knows into what files hold, JSON-like values and named arrays, and :func:`unpack` reads
it back to the bit: the types of a dataclass's fields decide.

A folder ``checkpoint_000007_episode_120`` (the seventh of its run) holds ``agent.safetensors``, ``runner.safetensors``
and ``state.json``, which has its own digest and those of the other two. A folder of another name is none. The newest is
kept; the one before it goes when the newer is complete.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import shutil
import types
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from safetensors.numpy import load, save

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentState
from imagine_bench.store.files import (
    grouped,
    make_folder,
    read_sealed,
    reading,
    sealed,
    sha256,
    sync_folder,
    write_bytes,
    write_json,
    writing,
)

FORMAT = "imagine_bench checkpoint 2"
_NAME = re.compile(r"checkpoint_([0-9]{6,})_episode_([0-9]+)")
_PARTIAL = ".partial_"
_AGENT = "agent.safetensors"
_RUNNER = "runner.safetensors"
STATE = "state.json"


def pack(value: Any, path: str = "") -> tuple[Any, Arrays]:
    """Split a dataclass, or a sequence of them, into JSON-like values and arrays named below ``path``.

    Fields may hold dataclasses, sequences, mappings, arrays, numbers, texts or None. A numpy scalar is kept as the
    Python number of the same value.
    """
    if isinstance(value, np.ndarray):
        return None, {path: value}
    if isinstance(value, np.generic):
        return value.item(), {}
    if dataclasses.is_dataclass(value):
        return pack(vars(value), path)
    if not isinstance(value, Mapping | list | tuple):
        return value, {}
    parts = value.items() if isinstance(value, Mapping) else enumerate(value)
    values = {}
    arrays: Arrays = {}
    for name, part in parts:
        values[name], inner = pack(part, f"{path}/{name}" if path else str(name))
        arrays |= inner
    return values if isinstance(value, Mapping) else list(values.values()), arrays


def unpack(kind: Any, values: Any, arrays: Mapping[str, Array]) -> Any:
    """Rebuild an object of type ``kind`` from what :func:`pack` gave; ``values`` is None if only arrays were kept.

    A field that files do not have takes its default.

    Raises:
        KeyError: An array is missing.
        TypeError: A field without a default is missing.
    """
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin in (Union, types.UnionType):
        present = [argument for argument in arguments if argument is not types.NoneType]
        if len(present) > 1 or (values is None and not arrays):
            return values
        return unpack(present[0], values, arrays)
    if origin is np.ndarray:
        return arrays[""]
    parts = grouped(arrays)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        given = {**dict.fromkeys(parts), **(values or {})}
        hints = {name: hint for name, hint in get_type_hints(kind).items() if name in given}
        return kind(**{name: unpack(hint, given[name], parts.get(name, {})) for name, hint in hints.items()})
    if origin in (list, tuple) and dataclasses.is_dataclass(arguments[0]):
        each = [None] * len(parts) if values is None else values
        return origin(unpack(arguments[0], part, parts.get(str(index), {})) for index, part in enumerate(each))
    return values


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
    earlier = checkpoints_in(folder)
    number = _number(earlier[-1]) + 1 if earlier else 1
    final = folder / f"checkpoint_{number:06d}_episode_{snapshot.episode}"
    partial = folder / f"{_PARTIAL}{final.name}"
    with writing(final):
        sweep_partial(folder)
        partial.mkdir()
        parts = {_AGENT: snapshot.agent.arrays, _RUNNER: snapshot.arrays}
        digests = {}
        for name, arrays in parts.items():
            content = save({array_name: np.asarray(array, order="C") for array_name, array in arrays.items()})
            write_bytes(partial / name, content)
            digests[name] = hashlib.sha256(content).hexdigest()
        state = {
            "format": FORMAT,
            "name": final.name,
            "episode": snapshot.episode,
            "sha256": digests,
            "agent": snapshot.agent.values,
            "runner": snapshot.values,
        }
        write_json(partial / STATE, sealed(state))
        partial.replace(final)
        sync_folder(folder)
        for old in earlier:  # its name goes first, so that no half of it can pass for a whole one
            shutil.rmtree(old.rename(old.with_name(f"{_PARTIAL}{old.name}")))
    return final


def load_newest(folder: Path, *, agent: bool = True) -> Snapshot | None:
    """The newest checkpoint below ``folder``, or None; the run may go on meanwhile. ArtefactError: it is damaged."""
    while found := checkpoints_in(folder):
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
    path = checkpoint / STATE
    what = f"the state of an {FORMAT!r}"
    state = read_sealed(path, what)
    with reading(path, what):
        if (state["format"], state["name"]) != (FORMAT, checkpoint.name):
            raise ValueError(f"it is {state['name']} of {state['format']!r}")
        of_agent = _unpacked(checkpoint / _AGENT, state["sha256"]) if agent else {}
        return Snapshot(
            episode=state["episode"],
            agent=AgentState(arrays=of_agent, values=state["agent"]),
            arrays=_unpacked(checkpoint / _RUNNER, state["sha256"]),
            values=state["runner"],
        )


def sweep_partial(folder: Path) -> None:
    """Remove what a process left below ``folder`` that was killed while it wrote or removed a checkpoint."""
    for leftover in folder.glob(f"{_PARTIAL}*"):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


def checkpoints_in(folder: Path) -> list[Path]:
    """Complete checkpoints, the newest last; a folder that somebody copied or renamed has another name."""
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted((path for path in found if _NAME.fullmatch(path.name) and path.is_dir()), key=_number)


def _number(checkpoint: Path) -> int:
    return int(checkpoint.name.split("_")[1])


def _unpacked(path: Path, digests: Mapping[str, str]) -> Arrays:
    if sha256(path) != digests[path.name]:
        raise ArtefactError(
            f"{path} is damaged: its content is not what was written. It was left untouched; delete the run's folder "
            "to start that run anew."
        )
    arrays: Arrays = load(path.read_bytes())
    return arrays
