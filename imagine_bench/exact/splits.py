"""Starts for training and others for tests that differ in structure: data with a hash, named by a line of text."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
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

    name: str  #: what they differ in
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
        """What stands for it in a protocol: its name and its hash."""
        return f"{self.name}@{self.hash}"


class StartingFrom:
    """Rules as they are, with some of their starts."""

    def __init__(self, rules: Rules, starts: tuple[State, ...]) -> None:
        self._rules = rules
        self.start_states = starts

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rules, name)


def split_of(rules: Rules, text: str) -> Split:
    """The split that a text names, such as ``plan_length=2``, ``values=3:0:1`` or ``pairs=0:3:4``.

    The numbers are the arguments of :func:`by_plan_length`, of :func:`by_values`, one value behind the other, and of
    :func:`by_pairs`, whose generator has seed 0. With ``@`` and a hash behind, it must be that very split.

    Raises:
        InvalidValueError: It names none, or another than its hash says.
    """
    name, _, wanted = text.partition("@")
    kind, _, rest = name.partition("=")
    try:
        numbers = [int(each) for each in rest.split(":")]
        found = _KINDS[kind](rules, *numbers)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InvalidValueError(
            f"{brief(text)} names no split of {len(rules.start_states)} starts; give plan_length=LONGEST, "
            "values=COORDINATE:VALUE:... or pairs=COORDINATE:COORDINATE:COUNT, such as plan_length=2."
        ) from error
    found = replace(found, name=f"{kind}={':'.join(map(str, numbers))}")
    if wanted and wanted != found.hash:
        raise InvalidValueError(f"Split {found.name} is {found.hash} here, not {wanted}; the world's starts changed.")
    return found


def by_plan_length(rules: Rules, longest: int) -> Split:
    """Training has the starts whose shortest plan has at most so many macro-actions; what has no plan is left out."""
    tables = tabulate(rules)
    length = dict(zip(rules.start_states, shortest_plans(tables)[tables.starts].tolist(), strict=True))
    solvable = [state for state in rules.start_states if length[state] > 0]
    return _split(f"plans of at most {longest}", solvable, lambda state: length[state] > longest)


def by_values(rules: Rules, coordinate: int, values: Collection[int]) -> Split:
    """Tests have the starts with some values of a coordinate, such as a goal that training never has."""
    name = f"coordinate {coordinate} is one of {sorted(values)} in tests"
    return _split(name, rules.start_states, lambda state: state[coordinate] in values)


def by_pairs(rules: Rules, first: int, second: int, held_out: int, rng: np.random.Generator) -> Split:
    """Tests have the starts with one of so many drawn pairs of values of two coordinates.

    Training never shows such a pair, but it shows each of its values.

    Raises:
        InvalidValueError: So many pairs cannot be held out.
    """
    starts = rules.start_states
    found = sorted({(state[first], state[second]) for state in starts})
    pairs = list(found)
    chosen = set[tuple[int, int]]()
    for index in rng.permutation(len(found)).tolist():
        left = [pair for pair in pairs if pair != found[index]]
        if len(chosen) < held_out and all({pair[i] for pair in left} == {pair[i] for pair in found} for i in (0, 1)):
            pairs = left
            chosen.add(found[index])
    if len(chosen) < held_out:
        raise InvalidValueError(f"Only {len(chosen)} of {len(found)} pairs can be held out, not {held_out}.")
    name = f"pairs {sorted(chosen)} of coordinates {first} and {second} in tests"
    return _split(name, starts, lambda state: (state[first], state[second]) in chosen)


def _split(name: str, starts: Collection[State], is_test: Callable[[State], bool]) -> Split:
    return Split(
        name=name,
        train=tuple(state for state in starts if not is_test(state)),
        test=tuple(state for state in starts if is_test(state)),
    )


_KINDS: dict[str, Callable[..., Split]] = {
    "plan_length": by_plan_length,
    "values": lambda rules, coordinate, *values: by_values(rules, coordinate, values),
    "pairs": lambda rules, first, second, count: by_pairs(rules, first, second, count, np.random.default_rng(0)),
}
