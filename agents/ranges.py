"""Which numbers a setting may take, and one clear error for every other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from imagine_bench.errors import InvalidValueError


@dataclass(frozen=True, slots=True)
class Range:
    """A set of numbers, in words too. NaN satisfies no comparison, so it is never allowed."""

    holds: Callable[[float], bool]
    words: str


PROBABILITY = Range(lambda value: 0.0 <= value <= 1.0, "must lie in [0, 1]")
INSIDE = Range(lambda value: 0.0 < value < 1.0, "must lie between 0 and 1")
SHARE = Range(lambda value: 0.0 <= value < 1.0, "must lie in [0, 1)")
RATE = Range(lambda value: 0.0 < value <= 1.0, "must lie in (0, 1]")
POSITIVE = Range(lambda value: value > 0.0, "must be above 0")
NOT_NEGATIVE = Range(lambda value: value >= 0.0, "must be at least 0")
FINITE = Range(lambda value: 0.0 <= value < math.inf, "must be at least 0 and finite")
COUNT = Range(lambda value: value >= 1, "must be at least 1")


def between(low: float, high: float, why: str = "") -> Range:
    """Numbers from ``low`` to ``high``, both allowed; ``why`` says what is wrong with the others."""
    return Range(lambda value: low <= value <= high, f"must lie in [{low:g}, {high:g}]" + (why and f": {why}"))


def require_ranges(values: Mapping[str, Any], ranges: Mapping[str, Range], otherwise: Range = COUNT) -> None:
    """Raise InvalidValueError for a number, or a number in a tuple, that its setting does not allow.

    Args:
        values: Settings by name; those that are no numbers are passed over.
        ranges: By the same names.
        otherwise: Of every other setting.
    """
    for name, value in values.items():
        allowed = ranges.get(name, otherwise)
        numbers = value if isinstance(value, tuple) else (value,)
        if any(type(number) in (int, float) and not allowed.holds(number) for number in numbers):
            raise InvalidValueError(f"Setting {name} is {value}; it {allowed.words}.")
