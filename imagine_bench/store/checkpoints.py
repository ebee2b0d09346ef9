"""Snapshots that a ``kill -9`` at any moment cannot damage: one folder each, complete once it has its name.

A folder ``checkpoint_000007_episode_120`` (the seventh of its run) holds ``agent.safetensors``, ``runner.safetensors``
and ``state.json``, which has its own digest and those of the other two. A folder of another name is none. The newest is
kept; the one before it goes when the newer is complete.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentState
from imagine_bench.store.files import (
    make_folder,
    read_sealed,
    reading,
    sealed,
    sync_folder,
    write_bytes,
    write_json,
    writing,
)

FORMAT = "imagine_bench checkpoint 2"
_NAME = re.compile(r"checkpoint_([0-9]{6,})_episode_([0-9]+)")
_PARTIAL = ".partial_"


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
        sweep_partial(folder)
        partial.mkdir()
        parts = {"agent.safetensors": snapshot.agent.arrays, "runner.safetensors": snapshot.arrays}
        digests = {}
        for name, arrays in parts.items():
            content = _packed(arrays)
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
        write_json(partial / "state.json", sealed(state))
        partial.replace(final)
        sync_folder(folder)
        for old in earlier:
            _remove(old)
    return final


def load_newest(folder: Path) -> Snapshot | None:
    """The newest checkpoint below ``folder``, or None; the run may go on meanwhile. ArtefactError: it is damaged."""
    while found := _checkpoints(folder):
        try:
            return load_snapshot(found[-1])
        except ArtefactError:
            if found[-1].is_dir():  # else a newer one has replaced it
                raise
    return None


def has_checkpoint(folder: Path) -> bool:
    """Whether there is a checkpoint below ``folder``."""
    return bool(_checkpoints(folder))


def load_snapshot(checkpoint: Path) -> Snapshot:
    """Read one checkpoint folder. Raises ArtefactError: it is damaged or not a checkpoint."""
    path = checkpoint / "state.json"
    state = read_sealed(path, f"the state of an {FORMAT!r}")
    if state.get("format") != FORMAT:
        raise ArtefactError(f"{path} was not written as {FORMAT!r}. It was left untouched.")
    if state.get("name") != checkpoint.name:
        raise ArtefactError(f"{path} is of {state.get('name')}, a checkpoint of another name. It was left untouched.")
    with reading(path, f"the state of an {FORMAT!r}"):
        agent = _unpacked(checkpoint / "agent.safetensors", state["sha256"])
        runner = _unpacked(checkpoint / "runner.safetensors", state["sha256"])
        return Snapshot(
            episode=state["episode"],
            agent=AgentState(arrays=agent, values=state["agent"]),
            arrays=runner,
            values=state["runner"],
        )


def sweep_partial(folder: Path) -> None:
    """Remove what a process left below ``folder`` that was killed while it wrote or removed a checkpoint."""
    for leftover in folder.glob(f"{_PARTIAL}*"):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


def _checkpoints(folder: Path) -> list[Path]:
    """Complete checkpoints, the newest last; a folder that somebody copied or renamed has another name."""
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted((path for path in found if _NAME.fullmatch(path.name) and path.is_dir()), key=_number)


def _number(checkpoint: Path) -> int:
    return int(checkpoint.name.split("_")[1])


def _remove(checkpoint: Path) -> None:
    """Remove a checkpoint so that no half of it can pass for a whole one: its name goes first."""
    shutil.rmtree(checkpoint.rename(checkpoint.with_name(f"{_PARTIAL}{checkpoint.name}")))


def _packed(arrays: Mapping[str, Array]) -> bytes:
    return save({name: np.asarray(array, order="C") for name, array in arrays.items()})


def _unpacked(path: Path, digests: Mapping[str, str]) -> Arrays:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ArtefactError(f"Cannot read {path}: {error.strerror}.") from error
    if hashlib.sha256(content).hexdigest() != digests[path.name]:
        raise ArtefactError(
            f"{path} is damaged: its content is not what was written. It was left untouched; delete the run's folder "
            "to start that run anew."
        )
    try:
        arrays: Arrays = load(content)
    except SafetensorError as error:
        raise ArtefactError(f"{path} is not a safetensors file: {error}. It was left untouched.") from error
    return arrays
