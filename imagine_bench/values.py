"""The values that settings and JSON files hold, and how dataclasses with arrays are kept as such values and arrays."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping, Sequence
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from imagine_bench.arrays import Array, Arrays
from imagine_bench.errors import InvalidValueError, brief

Scalar = bool | int | float | str | None
Setting = Scalar | tuple[Scalar, ...] | list[Scalar] | dict[str, Scalar]
"""The value of an agent's setting, as JSON has it."""
Json = Scalar | Sequence["Json"] | Mapping[str, "Json"]
"""A value that a JSON file can hold."""


KINDS = {int: "a whole number", float: "a number", str: "a text", bool: "True or False", types.NoneType: "none"}
"""The kinds of plain values, in words."""


def kind_in_words(hint: Any) -> str:
    """A type of a setting or of a field of a protocol, in words; other classes are tables of a file."""
    arguments = get_args(hint)
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(kind_in_words, arguments)))
    if get_origin(hint) is tuple:
        return f"a list, each item {kind_in_words(arguments[0])}" if arguments[-1] is Ellipsis else "a list"
    return KINDS.get(hint, "a table")


def has_switch(value: object) -> bool:
    """Whether a value, or one in a sequence, is true or false; Python takes these for whole numbers, too."""
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(has_switch, value)))


def dotted(settings: Mapping[str, Setting], before: str = "") -> dict[str, Setting]:
    """Settings, nested or not, by dotted name, such as ``controller.discount``."""
    found: dict[str, Setting] = {}
    for name, value in settings.items():
        found |= dotted(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return found


def grouped(arrays: Mapping[str, Array]) -> dict[str, Arrays]:
    """Arrays by the first part of their slashed names."""
    groups: dict[str, Arrays] = {}
    for name, array in arrays.items():
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest] = array
    return groups


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
    """Rebuild an object of type ``kind`` from the values of :func:`pack`; ``values`` is None if only arrays were kept.

    A field that files do not have takes its default.

    Raises:
        KeyError: An array is missing.
        TypeError: A field without a default is missing.
    """
    origin = get_origin(kind)
    arguments = get_args(kind)
    if types.NoneType in arguments:  # one type or None; of plain values any may be
        return unpack(arguments[0], values, arrays) if values is not None or arrays else None
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


def numbers(diagnostics: Mapping[str, Any]) -> dict[str, float]:
    """Diagnostics of a learner as tables hold them: true and false are 1 and 0, a tensor of one number is a number.

    Raises InvalidValueError: one is no number.
    """
    found: dict[str, float] = {}
    for name, value in diagnostics.items():
        try:
            found[name] = value if type(value) in (int, float) else float(value + 0)  # not of a text
        except (TypeError, ValueError):
            raise InvalidValueError(f"The diagnostic {name!r} is {brief(value)}; give a number.") from None
    return found
