"""A world of the family of arrow puzzles, said in one line: ``arrows:cubes=5,slip=0.1``.

A macrostate is ``(d0, ..., dn-1, pointed)``: the directions of the arrows, left to right in the agent's frame, and the
cube that the human points at. Directions: 0 toward the human (up in the frame), 1 right, 2 toward the agent, 3 left.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from imagine_bench.errors import InvalidValueError, brief, require_known

MAX_CUBES = 6
N_DIRECTIONS = 4
GOALS = ("pointed", "toward_agent", "clockwise", "all")
FORBIDS = ("none", "equal", "neighbours", "agent")
COUPLINGS = ("none", "neighbour")
GESTURES = ("always", "first")
RANGES = {
    "cubes": (1, MAX_CUBES), "shuffle": (0, 2**32 - 1), "horizon": (1, 1000), "slip": (0.0, 0.99),
    "fickle": (0.0, 1.0), "gesture": (0.0, 1.0), "lag": (0, 10), "distractors": (0, 4),
}  # fmt: skip
"""Lowest and highest value of each number that says a world."""


@dataclass(frozen=True)
class Turn:
    """A macro-action: a quarter turn of one cube, as seen in the frame."""

    cube: int
    clockwise: bool


@dataclass(frozen=True, kw_only=True)
class Arrows:
    """A world; ``str`` gives its canonical name, which says what differs from the defaults.

    Raises:
        InvalidValueError: A value of the wrong type or out of its range, or values that contradict each other.
        UnknownNameError: An unknown goal, forbid, coupling or gesture.
    """

    cubes: int = 3  #: 1 to 6
    #: What must come true. ``"pointed"``: the arrow of the cube pointed at, toward the human (thesis 5.2.1);
    #: ``"toward_agent"``: the same toward the agent; ``"clockwise"``: the same to the left, and no arrow a quarter turn
    #: clockwise of it; ``"all"``: all arrows toward the human; or a digit a cube, its direction, such as ``"0123"``.
    goal: str = "pointed"
    #: What may not be: ``"none"``; ``"equal"``: two arrows alike (thesis); ``"neighbours"``: two alike side by side;
    #: ``"agent"``: no goal has an arrow toward the agent (thesis 5.2.3); several joined by ``+``. None is ``"equal"``
    #: up to 3 cubes and ``"neighbours"`` from 4 on, and becomes that.
    forbid: str | None = None
    coupling: str = "none"  #: ``"neighbour"``: a turn also turns the next cube to the right, the same way
    shuffle: int | None = None  #: a seed of the order of the macro-actions; None leaves it
    horizon: int | None = None  #: macro-actions before truncation, 1 to 1000; None: by the longest shortest plan
    slip: float = 0.0  #: probability, up to 0.99, that a macro-action leaves all as it is
    fickle: float = 0.0  #: probability in [0, 1] that the human points at another cube after a macro-action
    gesture: str | float = "always"  #: whether a frame shows it: always, ``"first"``: only the first, or a probability
    lag: int = 0  #: macro-actions that a frame is old, 0 to 10
    distractors: int = 0  #: things in view that move and are of no consequence, 0 to 4

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            if not (getattr(self, name) is getattr(Arrows, name) or (name == "gesture" and self.gesture in GESTURES)):
                object.__setattr__(self, name, self._in_range(name, low, high))
        if self.forbid is None:
            object.__setattr__(self, "forbid", self._usual_forbid)
        require_known("coupling", self.coupling, COUPLINGS)
        self._check_goal()
        self._check_forbid()
        for name in ("fickle", "coupling"):
            if self.cubes == 1 and getattr(self, name) != getattr(Arrows, name):
                raise InvalidValueError(f"{name}={getattr(self, name)} needs another cube; give at least 2 cubes.")

    def _in_range(self, name: str, low: float, high: float) -> float:
        value, kind = getattr(self, name), type(low)
        right = isinstance(value, int if kind is int else (int, float)) and not isinstance(value, bool)
        if not right or not low <= value <= high:
            words = f"{'an integer' if kind is int else 'a number'} from {low:g} to {high:g}"
            also = f", or {' or '.join(GESTURES)}" if name == "gesture" else ""
            raise InvalidValueError(f"{name} is {brief(value)}; give {words}{also}.")
        return kind(value)

    def _check_goal(self) -> None:
        pattern = f"a pattern of {self.cubes} digits from 0 to {N_DIRECTIONS - 1}"
        if not isinstance(self.goal, str) or not self.goal.isdecimal():
            require_known("goal", self.goal, (*GOALS, pattern))
        elif len(self.goal) != self.cubes or not set(self.goal) <= {str(each) for each in range(N_DIRECTIONS)}:
            raise InvalidValueError(f"Goal {brief(self.goal)} does not fit {self.cubes} cubes; give {pattern}.")

    def _check_forbid(self) -> None:
        parts = self.forbidden
        for part in parts:
            require_known("forbid", part, FORBIDS)
        if len(set(parts)) < len(parts) or ("none" in parts and len(parts) > 1):
            raise InvalidValueError(f"forbid={self.forbid} contradicts or repeats itself; give each part once.")
        if "equal" in parts and self.cubes >= N_DIRECTIONS:
            raise InvalidValueError(
                f"forbid=equal leaves no legal turn with {self.cubes} cubes, for an arrow has only {N_DIRECTIONS} "
                "directions; give at most 3 cubes, or forbid=neighbours or none."
            )

    @property
    def _usual_forbid(self) -> str:
        return "equal" if self.cubes < N_DIRECTIONS else "neighbours"

    @property
    def forbidden(self) -> tuple[str, ...]:
        """The parts of ``forbid``."""
        return tuple(str(self.forbid).split("+"))

    @cached_property
    def turns(self) -> tuple[Turn, ...]:
        """What each macro-action does, in their order. Length 2 ``cubes``."""
        turns = [Turn(cube, clockwise) for cube in range(self.cubes) for clockwise in (True, False)]
        if self.shuffle is None:
            return tuple(turns)
        rng = np.random.default_rng(self.shuffle)
        return tuple(turns[each] for each in rng.permutation(len(turns)).tolist())

    def turned_with(self, cube: int) -> tuple[int, ...]:
        """The cubes that turn when the arm turns one, that one first."""
        return (cube, cube + 1) if self.coupling == "neighbour" and cube + 1 < self.cubes else (cube,)

    def __str__(self) -> str:
        usual = Arrows(cubes=self.cubes)
        named = [(each.name, getattr(self, each.name), getattr(usual, each.name)) for each in fields(self)]
        said = [f"{name}={value}" for name, value, other in named if name == "cubes" or value != other]
        said = said[self.cubes == Arrows.cubes :]
        return "arrows:" + ",".join(said) if said else "arrows"

    @property
    def hash(self) -> str:
        """Eight hexadecimal digits of the canonical name."""
        return hashlib.sha256(str(self).encode()).hexdigest()[:8]
