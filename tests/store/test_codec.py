"""The codec reads back, to the bit, every dataclass of a run folder, whichever of its parts are present."""

from __future__ import annotations

import dataclasses
import itertools
import json
import types
from collections.abc import Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from imagine_bench.running.evaluation import EvaluationCounts
from imagine_bench.running.run_state import Counters
from imagine_bench.store.codec import pack, unpack
from imagine_bench.store.results import Checkpoint, ComparedRollout, KeptEpisodes, OpenLoop, PolicyTable

ARRAYS_ONLY = (OpenLoop, PolicyTable, KeptEpisodes, ComparedRollout)
"""Classes whose arrays are kept without values beside them."""
SCALARS: dict[Any, Any] = {int: 3, float: 0.1, str: "0110", bool: True, Any: 1.5}


@dataclasses.dataclass(frozen=True)
class Inner:
    array: np.ndarray[Any, np.dtype[np.float32]] | None
    number: float | None


@dataclasses.dataclass(frozen=True)
class Odd:
    """Shapes that no stored class has today."""

    array: np.ndarray[Any, np.dtype[np.int16]] | None
    inner: Inner | None
    several: tuple[Inner, ...]
    pairs: tuple[tuple[str, int], ...]
    mixed: int | str | None
    later: int = 7


def variants(hint: Any) -> list[Any]:
    """Values of a type: with and without each part that may be absent, and sequences of none and of several parts."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        dtype = get_args(arguments[1])[0] if get_args(arguments[1]) else np.float64
        return [np.arange(6).reshape(3, 2).astype(dtype)]
    if origin in (Union, types.UnionType):
        return [None, *(value for each in arguments if each is not types.NoneType for value in variants(each))]
    if dataclasses.is_dataclass(hint):
        hints = get_type_hints(hint)
        names = [field.name for field in dataclasses.fields(hint)]
        choices = itertools.product(*(variants(hints[name]) for name in names))
        return [hint(**dict(zip(names, chosen, strict=True))) for chosen in choices]  # type: ignore[operator]
    if origin in (list, tuple):
        if origin is tuple and arguments[-1] is not Ellipsis:
            several = tuple(variants(each)[-1] for each in arguments)
        else:
            several = origin(variants(arguments[0]))
        return [origin(), several] if dataclasses.is_dataclass(arguments[0]) else [several]
    is_mapping = origin is not None and issubclass(origin, Mapping)
    return [{"b c": 0.25, "a": 2}] if is_mapping else [SCALARS[hint]]


def same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if dataclasses.is_dataclass(one):
        return type(one) is type(other) and all(same(value, vars(other)[name]) for name, value in vars(one).items())
    if isinstance(one, list | tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


@pytest.mark.parametrize("kind", [*ARRAYS_ONLY, Checkpoint, EvaluationCounts, Counters, Odd])
def test_every_present_and_absent_part_is_read_back(kind: Any) -> None:
    for value in variants(kind):
        values, arrays = pack(value)
        assert same(unpack(kind, json.loads(json.dumps(values)), arrays), value)
        if kind in ARRAYS_ONLY:
            assert same(unpack(kind, None, arrays), value)


@pytest.mark.parametrize("kind", ARRAYS_ONLY)
def test_a_sequence_is_read_back_from_its_arrays_alone(kind: Any) -> None:
    several = tuple(variants(kind) * 6)
    arrays = pack(several, "at")[1]
    assert len(several) >= 6 and same(unpack(tuple[kind, ...], None, arrays, "at"), several)
    assert unpack(tuple[kind, ...], None, arrays, "a") == ()


def test_an_optional_array_alone_in_a_file_is_read_back() -> None:
    array = np.arange(3)
    assert same(unpack(np.ndarray[Any, Any] | None, None, {"": array}), array)
    assert unpack(np.ndarray[Any, Any] | None, None, {}) is None


def test_numpy_scalars_are_kept_as_numbers() -> None:
    values, arrays = pack(Inner(array=None, number=np.float32(0.1)))  # type: ignore[arg-type]
    assert values["number"] == float(np.float32(0.1)) and not arrays
    assert pack({"mean": np.float32(0.5)})[0] == {"mean": 0.5}


def test_what_an_older_file_lacks_takes_its_default() -> None:
    (value, *_) = variants(Odd)
    values, arrays = pack(value)
    del values["later"]
    assert unpack(Odd, values, arrays).later == 7
    del values["pairs"]
    with pytest.raises(KeyError, match="pairs"):
        unpack(Odd, values, arrays)
