"""Starts for training and others for tests that differ in structure: data with a hash, named by a line of text."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from imagine_bench.errors import InvalidValueError, brief
from imagine_bench.interfaces import Rules, State
from imagine_bench.rules import shortest_plans, tabulate


@dataclass(frozen=True, kw_only=True)
class Split:
    """Start macrostates of training and of tests; none is in both.

    Raises:
        InvalidValueError: One of them is empty.
    """

    name: str  #: their difference
    train: tuple[State, ...]
    test: tuple[State, ...]

    def __post_init__(self) -> None:
        if not self.train or not self.test:
            empty = "test" if self.train else "training"
            raise InvalidValueError(f"The split {self.name} leaves no start for {empty}; choose other values.")

    @property
    def hash(self) -> str:
        """12 hex digits of the content, whatever its name."""
        return hashlib.sha256(json.dumps([sorted(self.train), sorted(self.test)]).encode()).hexdigest()[:12]

    @property
    def identity(self) -> str:
        """Its identity in a protocol: its name and its hash."""
        return f"{self.name}@{self.hash}"


@dataclass(frozen=True, eq=False)
class StartingFrom:
    """Rules as they are, with some of their starts."""

    rules: Rules
    start_states: tuple[State, ...]

    def __getattr__(self, name: str) -> Any:
        if name == "rules":  # of a copy that is being made
            raise AttributeError(name)
        return getattr(self.rules, name)


def split_of(rules: Rules, text: str) -> Split:
    """The split that a text names: ``plan_length=2``, ``values=3:0:1`` or ``pairs=0:3:4``.

    - ``plan_length=LONGEST``: training has the starts whose shortest plan has at most so many macro-actions; starts
    without a plan are left out.
    - ``values=COORDINATE:VALUE:...``: tests have the starts with some values of a coordinate, such as a goal that
      training never has.
    - ``pairs=COORDINATE:COORDINATE:COUNT``: tests have the starts with one of so many pairs of values of two
      coordinates, drawn with seed 0. Training never shows such a pair, but it shows each of its values.

    With ``@`` and a hash behind, it must be that very split.

    Raises:
        InvalidValueError: It names none, or another than its hash says.
    """
    name, _, wanted = text.partition("@")
    kind, _, rest = name.partition("=")
    try:
        numbers = [int(each) for each in rest.split(":")]
        if kind == "values":  # whose order says nothing
            numbers[1:] = sorted(set(numbers[1:]))
        is_test = _KINDS[kind](rules, *numbers)
        sides = {state: is_test(state) for state in rules.start_states}
    except InvalidValueError:  # which says more
        raise
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InvalidValueError(
            f"{brief(text)} names no split of {len(rules.start_states)} starts; give plan_length=LONGEST, "
            "values=COORDINATE:VALUE:... or pairs=COORDINATE:COORDINATE:COUNT, such as plan_length=2."
        ) from error
    found = Split(
        name=f"{kind}={':'.join(map(str, numbers))}",
        train=tuple(state for state, side in sides.items() if side is False),
        test=tuple(state for state, side in sides.items() if side),
    )
    if wanted and wanted != found.hash:
        raise InvalidValueError(f"Split {found.name} is {found.hash} here, not {wanted}; the world's starts changed.")
    return found


def _counted(rules: Rules, *coordinates: int) -> tuple[State, ...]:
    """The starts. IndexError: a coordinate is counted from the end, so that one split would have two names."""
    if min(coordinates) < 0:
        raise IndexError(min(coordinates))
    return rules.start_states


def _by_plan_length(rules: Rules, longest: int) -> _IsTest:
    tables = tabulate(rules)
    lengths = dict(zip(rules.start_states, shortest_plans(tables)[tables.starts].tolist(), strict=True))
    return lambda state: lengths[state] > longest if lengths[state] > 0 else None


def _by_values(rules: Rules, coordinate: int, *values: int) -> _IsTest:
    known = {state[coordinate] for state in _counted(rules, coordinate)}
    for value in values:
        if value not in known:
            raise InvalidValueError(
                f"No start has the value {value} of coordinate {coordinate}; give some of {sorted(known)}."
            )
    return lambda state: state[coordinate] in values


def _by_pairs(rules: Rules, first: int, second: int, held_out: int) -> _IsTest:
    found = sorted({(state[first], state[second]) for state in _counted(rules, first, second)})
    trained = list(found)
    rng = np.random.default_rng(0)
    for index in rng.permutation(len(found)).tolist():
        left = [pair for pair in trained if pair != found[index]]
        if len(found) - len(left) <= held_out and all(
            {pair[i] for pair in left} == {pair[i] for pair in found} for i in (0, 1)
        ):
            trained = left
    if len(found) - len(trained) < held_out:
        raise InvalidValueError(f"Only {len(found) - len(trained)} pairs can be held out, not {held_out}.")
    return lambda state: (state[first], state[second]) not in trained


_IsTest = Callable[[State], bool | None]
"""Whether a start is of the tests; None leaves it out."""
_KINDS: dict[str, Callable[..., _IsTest]] = {
    "plan_length": _by_plan_length,
    "values": _by_values,
    "pairs": _by_pairs,
}
