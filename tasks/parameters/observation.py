"""Gesture and lag: frames may hide what the human says, and come some macro-actions late.

The first observations of an episode repeat the start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from imagine_bench.interfaces import Sight, State

HIDDEN = -1
_Seen = TypeVar("_Seen")


@dataclass(frozen=True, kw_only=True)
class GestureObservation:
    """Frames of macrostates whose last coordinate, the gesture, may be hidden.

    Args:
        gesture: ``"always"``, ``"first"``, or the probability that a frame shows it.
        lag: Macro-actions that a frame is old.
        always_shown: Macrostates whose gesture no frame hides.
    """

    gesture: str | float
    lag: int
    always_shown: Callable[[State], bool] = lambda macrostate: False

    def seen(self, macrostate: State, step: int) -> tuple[tuple[float, State], ...]:
        """What a frame taken after ``step`` macro-actions may show, as :meth:`.Sight.seen`."""
        shown = self.gesture
        if isinstance(shown, str):
            shown = float(shown == "always" or step == 0)
        if self.always_shown(macrostate):
            shown = 1.0
        both = ((shown, macrostate), (1.0 - shown, (*macrostate[:-1], HIDDEN)))
        return tuple((share, what) for share, what in both if share)


def hides(sight: Sight, macrostate: State, step: int, rng: np.random.Generator) -> bool:
    """Whether a frame hides the gesture, drawn where that is a matter of chance."""
    seen = sight.seen(macrostate, step)
    which = 0 if len(seen) == 1 else int(rng.random() >= seen[0][0])
    return seen[which][1][-1] == HIDDEN


def delivered(under_way: tuple[_Seen, ...], newest: _Seen, lag: int) -> tuple[_Seen, ...]:
    """What is under way once the newest observation is taken in; the first of it is due now."""
    return (*under_way, newest)[-1 - lag :]
