"""The one codec between dataclasses and what files hold: JSON-like values, named arrays, and tables.

The fields' types decide: an array is an array of the file, under the slashed path of its field; everything else is a
value. Reading gives what was written, to the bit.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import types
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import ArtefactError
from imagine_bench.store.files import csv_text, write_bytes


def pack(value: Any, path: str = "") -> tuple[Any, Arrays]:
    """Split a dataclass, or a sequence of them, into JSON-like values and arrays named below ``path``.

    Fields may hold dataclasses, sequences, mappings of numbers, arrays, numbers, texts or None. A numpy scalar is kept
    as the Python number of the same value.
    """
    if isinstance(value, np.ndarray):
        return None, {path: value}
    if isinstance(value, np.generic):
        return value.item(), {}
    if dataclasses.is_dataclass(value):
        arrays: Arrays = {}
        values = {}
        for field in dataclasses.fields(value):
            values[field.name], inner = pack(getattr(value, field.name), _join(path, field.name))
            arrays.update(inner)
        return values, arrays
    if isinstance(value, Mapping):
        return {name: pack(part)[0] for name, part in value.items()}, {}
    if isinstance(value, list | tuple):
        parts = [pack(part, _join(path, index)) for index, part in enumerate(value)]
        return [part for part, _ in parts], {name: array for _, inner in parts for name, array in inner.items()}
    return value, {}


def unpack(kind: Any, values: Any, arrays: Mapping[str, Array], path: str = "") -> Any:
    """Rebuild an object of type ``kind`` from what :func:`pack` gave; ``values`` is None if only arrays were kept.

    A field that files do not have takes its default.

    Raises:
        KeyError: A value or an array without a default is missing.
        TypeError: A value is of another type.
    """
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin in (Union, types.UnionType):
        kept = [argument for argument in arguments if argument is not types.NoneType]
        if values is None and not _has_arrays(arrays, path):
            return None
        return unpack(kept[0], values, arrays, path) if len(kept) == 1 else values
    if origin is np.ndarray:
        return arrays[path]
    if dataclasses.is_dataclass(kind):
        return _unpack_fields(kind, values or {}, arrays, path)
    if origin in (list, tuple):
        each = [None] * _count(arrays, path) if values is None and dataclasses.is_dataclass(arguments[0]) else values
        if each is None:
            raise KeyError(path)
        hints = arguments if origin is tuple and arguments[-1] is not Ellipsis else [arguments[0]] * len(each)
        parts = zip(hints, each, strict=True)
        return origin(unpack(hint, part, arrays, _join(path, i)) for i, (hint, part) in enumerate(parts))
    if values is None:
        raise KeyError(path)
    return values


def _unpack_fields(kind: Any, values: Mapping[str, Any], arrays: Mapping[str, Array], path: str) -> Any:
    hints = get_type_hints(kind)
    found = {}
    for field in dataclasses.fields(kind):
        inside = _join(path, field.name)
        absent = values.get(field.name) is None and not _has_arrays(arrays, inside)
        has_default = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if field.init and not (absent and has_default and field.name not in values):
            found[field.name] = unpack(hints[field.name], values.get(field.name), arrays, inside)
    return kind(**found)


def _join(path: str, name: str | int) -> str:
    return f"{path}/{name}" if path else str(name)


def _has_arrays(arrays: Mapping[str, Array], path: str) -> bool:
    """Whether an array lies at ``path`` or below it."""
    return (not path and bool(arrays)) or any(name == path or name.startswith(f"{path}/") for name in arrays)


def _count(arrays: Mapping[str, Array], path: str) -> int:
    """How many parts of a sequence have arrays: one more than the largest index below ``path``."""
    prefix = f"{path}/" if path else ""
    below = (name.removeprefix(prefix) for name in arrays if name.startswith(prefix))
    return max((int(name.partition("/")[0]) + 1 for name in below), default=0)


def grouped(arrays: Mapping[str, Array]) -> dict[str, Arrays]:
    """Arrays by the first part of their slashed names."""
    groups: dict[str, Arrays] = {}
    for name, array in arrays.items():
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest] = array
    return groups


def write_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write named arrays, atomically. Raises SetupError: they cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def read_arrays(path: Path) -> Arrays:
    """The inverse of :func:`write_arrays`. Raises ArtefactError: the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ArtefactError(f"{path} is not an array file of a run: {error}. It was left untouched.") from error


Row = Mapping[str, float | str]


def table_text(rows: Sequence[Row]) -> str:
    """Rows as CSV under the names of all of them; what one lacks is an empty cell."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return csv_text([names, *([row.get(name, "") for name in names] for row in rows)])


def table_rows(text: str, texts: Iterable[str] = ()) -> list[dict[str, Any]]:
    """The inverse of :func:`table_text`: all columns but ``texts`` hold numbers, or ValueError is raised."""
    words = set(texts)
    rows = csv.DictReader(io.StringIO(text))
    return [{name: cell if name in words else _number(cell) for name, cell in row.items() if cell} for row in rows]


def _number(text: str) -> float:
    return int(text) if text.lstrip("-").isdigit() else float(text)
