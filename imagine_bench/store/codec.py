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
from numpy.typing import NDArray

from imagine_bench.errors import ArtefactError
from imagine_bench.store.files import csv_text, write_bytes

Arrays = dict[str, NDArray[Any]]


def pack(value: Any, path: str = "") -> tuple[Any, Arrays]:
    """A dataclass, or a sequence of them, as JSON-like values and arrays that lie at ``path`` among others.

    Its fields are dataclasses, sequences, mappings of numbers, arrays, numbers, texts or None.
    """
    if isinstance(value, np.ndarray | np.generic):
        return None, {path: np.asarray(value)}
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        packed = {name: pack(part, _join(path, name)) for name, part in parts.items()}
        values: Any = {name: found for name, (found, _) in packed.items()}
        return values, _united(arrays for _, arrays in packed.values())
    if isinstance(value, list | tuple) and dataclasses.is_dataclass(next(iter(value), None)):
        each = [pack(part, _join(path, index)) for index, part in enumerate(value)]
        return [found for found, _ in each], _united(arrays for _, arrays in each)
    return (dict(value) if isinstance(value, Mapping) else list(value) if isinstance(value, tuple) else value), {}


def unpack(kind: Any, values: Any, arrays: Mapping[str, NDArray[Any]], path: str = "") -> Any:
    """The inverse of :func:`pack`, of type ``kind``; ``values`` is None where there are none beside arrays.

    Raises:
        KeyError: A value or an array is missing.
        TypeError: A value is of another type.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return arrays[path]
    if origin in (Union, types.UnionType):
        absent = values is None and not any(name.startswith(f"{path}/") for name in arrays)
        (kept,) = (argument for argument in arguments if argument is not type(None))
        return None if absent else unpack(kept, values, arrays, path)
    if dataclasses.is_dataclass(kind):
        hints, given = get_type_hints(kind), values or {}
        names = [field.name for field in dataclasses.fields(kind) if field.init]
        fields = {name: unpack(hints[name], given.get(name), arrays, _join(path, name)) for name in names}
        return kind(**fields)  # type: ignore[operator]
    if origin in (list, tuple) and dataclasses.is_dataclass(arguments[0]):
        parts = _indexed(arrays, path) * [None] if values is None else values
        return origin(unpack(arguments[0], part, arrays, _join(path, index)) for index, part in enumerate(parts))
    if values is None:
        raise KeyError(path)
    return origin(values) if origin in (list, tuple) else values


def _join(path: str, name: str | int) -> str:
    return f"{path}/{name}" if path else str(name)


def _united(each: Iterable[Arrays]) -> Arrays:
    return {name: array for arrays in each for name, array in arrays.items()}


def _indexed(arrays: Mapping[str, NDArray[Any]], path: str) -> int:
    """How many parts of a sequence have arrays."""
    return len({name[len(path) + 1 :].partition("/")[0] for name in arrays if name.startswith(f"{path}/")})


def grouped(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Arrays]:
    """Arrays by the first part of their slashed names."""
    groups: dict[str, Arrays] = {}
    for name, array in arrays.items():
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest] = array
    return groups


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
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
