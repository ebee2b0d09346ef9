"""Files of JSON, tables and named arrays: each is whole or absent, and one sentence says why it cannot be used."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import socket
import stat
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import ArtefactError, BusyError, InvalidValueError, SetupError, brief, plain, why, writing
from imagine_bench.values import Json


def expanded(path: Path) -> Path:
    """A path with ``~`` as a home folder. Raises InvalidValueError: the system knows no such home."""
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise InvalidValueError(f"{path}: the system knows no such home folder; give a path without '~'.") from error


def make_folder(folder: Path) -> Path:
    """Create ``folder`` with its parents if need be. Raises SetupError: it cannot be made."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def require_writable(folder: Path) -> None:
    """Raise SetupError, before long work, where its result cannot be written to ``folder``; made if need be."""
    with writing(make_folder(folder)), TemporaryFile(dir=folder):
        pass


def sync_folder(folder: Path) -> None:
    """Make the names in ``folder`` survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sweep(folder: Path, *, older_than_s: float = 0.0) -> None:
    """Remove files that killed writers left half-written in ``folder``, whose lock is held or where nothing is so
    old.
    """
    for leftover in folder.glob(".*.partial"):
        with suppress(OSError):  # another sweeps too, or may not
            if time.time() - leftover.stat().st_mtime >= older_than_s:
                leftover.unlink()


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file at once, by a temporary neighbour, or raise SetupError and leave an earlier one untouched."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with writing(path):
        try:
            temporary.unlink(missing_ok=True)
            with temporary.open("xb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
        finally:
            with suppress(OSError):
                temporary.unlink()


def make_plain(log: Path) -> None:
    """Write the control characters in a log as escapes, for whoever prints it; an empty log is removed."""
    with suppress(OSError):  # there is none, another removed it, or the disk refuses: it stays as it is
        text = plain(log.read_text(errors="replace"))
        if text:
            log.write_text(text)
        else:
            log.unlink()


def with_null(value: Json) -> Any:
    """The value that JSON gives back of ``value``, None for NaN and infinities, for which JSON has no word."""
    return json.loads(json.dumps(value), parse_constant=lambda _: None)


def json_text(value: Json) -> str:
    """``value`` as JSON, as every file here has it."""
    return json.dumps(value, indent=1) + "\n"


def write_json(path: Path, value: Json) -> None:
    """Write ``value`` as JSON, atomically. Raises SetupError: it cannot be written."""
    write_bytes(path, json_text(value).encode())


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows, the head first, as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def table_text(rows: Sequence[Mapping[str, float | str]], columns: Sequence[str] | None = None) -> str:
    """Rows as CSV under ``columns``, or the names of all of them; a value that a row lacks is an empty cell."""
    names = columns or list(dict.fromkeys(name for row in rows for name in row))
    return csv_text([names, *([row.get(name, "") for name in names] for row in rows)])


def table_rows(text: str, texts: Collection[str] = ()) -> list[dict[str, Any]]:
    """The inverse of :func:`table_text`: all columns but ``texts`` hold numbers, or ValueError is raised."""
    rows = csv.DictReader(io.StringIO(text))
    return [{name: cell if name in texts else _number(cell) for name, cell in row.items() if cell} for row in rows]


def _number(text: str) -> float:
    return int(text) if text.lstrip("-").isdigit() else float(text)


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write named arrays, atomically. Raises SetupError: they cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def read_arrays(path: Path, what: str = "an array file of a run") -> Arrays:
    """The inverse of :func:`write_arrays`. Raises ArtefactError: the file is missing, damaged or not ``what``."""
    with reading(path, what), path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def read_json(path: Path, what: str) -> Any:
    """The object that a JSON file holds. Raises ArtefactError: it is missing, damaged or not ``what``."""
    with reading(path, what):
        found = json.loads(path.read_bytes())
        if not isinstance(found, dict):
            raise TypeError(f"it holds a {type(found).__name__}")
        return found


def sealed(values: Mapping[str, Json]) -> dict[str, Json]:
    """Values with the digest of all of them, as a reader of their file will have them, under ``seal``."""
    return {**values, "seal": _seal(json.loads(json.dumps(values)))}


def read_sealed(path: Path, what: str) -> dict[str, Any]:
    """The :func:`sealed` values of a JSON file. Raises ArtefactError as :func:`read_json`, or where one
    changed.
    """
    values = read_json(path, what)
    seal = values.pop("seal", None)
    if seal != _seal(values):
        raise ArtefactError(f"{path} is damaged: it is not as it was written. It was left untouched.")
    return values


def _seal(values: Mapping[str, Json]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Turn any error with the file ``path``, which should be ``what``, into one ArtefactError."""
    try:
        yield
    except ArtefactError:  # of a file that this one names
        raise
    except FileNotFoundError as error:
        raise ArtefactError(f"There is no {path}, {what}.") from error
    except Exception as error:  # a file that is not as it was written can be wrong in any way
        raise ArtefactError(f"{path} is not {what}: {why(error)}. It was left untouched.") from error


def first_difference(then: Json, now: Json, name: str = "") -> tuple[str, Json, Json] | None:
    """Where two JSON values differ first, by sorted name: the dotted name and both values; None where they are equal.

    A value that one of them lacks is None there.
    """
    if not (isinstance(then, Mapping) and isinstance(now, Mapping)):
        return None if then == now else (name, then, now)
    for key in sorted({*then, *now}):
        difference = first_difference(then.get(key), now.get(key), f"{name}.{key}" if name else key)
        if difference is not None:
            return difference
    return None


def sha256(path: Path) -> str:
    """Hex digest of a file. Raises ArtefactError: it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ArtefactError(f"Cannot read {path}: {error.strerror}.") from error


@contextmanager
def lock(path: Path, busy: str, *, patience_s: float = 0.0) -> Iterator[None]:
    """Hold the lock file ``path``; the system lets go of it when this process ends, however it ends.

    It stays behind, as does the name of its last holder beside it. ``busy`` says where another process works.

    Raises:
        BusyError: Another live process holds it for longer than ``patience_s`` seconds; the message says which.
        SetupError: The folder cannot be written or locked.
    """
    held = FileLock(path, timeout=patience_s)
    holder = path.with_name(f"{path.name}.holder")
    with writing(path):
        for each in (path, holder):
            if os.path.lexists(each) and not stat.S_ISREG(each.lstat().st_mode):
                raise SetupError(f"{each} is not a file of ours but a link or the like; remove it.")
        try:
            held.acquire()
        except Timeout:
            who = brief(holder.read_text(errors="replace"))[1:-1] if holder.is_file() else "another process"
            raise BusyError(f"{busy} is in use by {who}; wait for it, stop it, or choose another folder.") from None
    try:
        with suppress(OSError):  # a courtesy to the next process that finds it held; a full disk does not matter
            holder.write_text(f"process {os.getpid()} on {socket.gethostname()}")
        yield
    finally:
        held.release()
