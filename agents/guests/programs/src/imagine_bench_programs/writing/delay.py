"""Symbols that are some macro-actions late: which earlier macro-action each change belongs to.

Where frames come late, a macro-action seems to change nothing, or something that an earlier one did. With the right
number of macro-actions between, each change is that of one macro-action alone, and short laws explain all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from imagine_bench.interfaces import State

MOST_DELAY = 3
"""Macro-actions that symbols may be late."""


class CodedRow(NamedTuple):
    """A transition between symbols, -1 for a value that was not seen."""

    now: State
    action: int
    then: State
    reward: float
    ended: bool
    step: int = 0  # macro-actions before it in its episode

    def at(self, places: Sequence[int]) -> CodedRow:
        """The same transition between the symbols of these places alone."""
        now, then = (tuple(state[place] for place in places) for state in (self.now, self.then))
        return self._replace(now=now, then=then)


def complete(rows: Sequence[CodedRow]) -> list[CodedRow]:
    """The transitions in which every value was seen."""
    return [row for row in rows if min(*row.now, *row.then) >= 0]


def changes(rows: Sequence[CodedRow], delay: int) -> list[CodedRow]:
    """Transitions with the macro-action that was taken ``delay`` steps before, instead of their own.

    Each transition of an episode is to follow the one before it. At the beginning of an episode the first symbols are
    repeated; these transitions are of no macro-action, and are left out. The symbols after an end are never seen.
    """
    found = []
    for place, row in enumerate(rows):
        if row.step >= delay:
            found.append(row._replace(action=rows[place - delay].action, ended=row.ended and not delay))
    return found


def too_early(rows: Sequence[CodedRow], delay: int) -> int:
    """How many transitions changed something where symbols that are so late would still repeat the first."""
    return sum(row.step < delay and row.now != row.then for row in complete(rows))
