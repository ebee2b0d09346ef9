"""A world of the family of arrow puzzles, said in one line: ``arrows:cubes=5,slip=0.1``.

A macrostate is ``(d0, ..., dn-1, pointed)``: the directions of the arrows, left to right in the agent's frame, and the
cube that the human points at. Directions: 0 toward the human (up in the frame), 1 right, 2 toward the agent, 3 left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.values import Setting

from ..parameters.parameters import WorldParameters

MAX_CUBES = 6
N_DIRECTIONS = 4
GOALS = ("pointed", "toward_agent", "clockwise", "all")
FORBIDS = ("none", "equal", "neighbours", "agent")
COUPLINGS = ("none", "neighbour")


@dataclass(frozen=True)
class Turn:
    """A quarter turn of one cube, as seen in the frame."""

    cube: int
    clockwise: bool


@dataclass(frozen=True, kw_only=True)
class Arrows(WorldParameters):
    """A world; its canonical name says what differs from the defaults.

    Raises:
        InvalidValueError: A value of the wrong type or out of its range, or values that contradict each other.
        UnknownNameError: An unknown goal, forbid or coupling.
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

    FAMILY: ClassVar[str] = "arrows"
    SCENE: ClassVar[str] = "imagine_bench.tasks.arrows.world:ArrowWorld"
    IN_VIEW: ClassVar[tuple[str, ...]] = ("cubes", "distractors")
    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {
        "cubes": (1, MAX_CUBES),
        "shuffle": (0, 2**32 - 1),
        "horizon": (1, 1000),
        **WorldParameters.RANGES,
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.forbid is None:
            object.__setattr__(self, "forbid", self._usual("forbid"))
        require_known("coupling", self.coupling, COUPLINGS)
        self._check_goal()
        self._check_forbid()
        for name in ("goal_change", "coupling"):
            if self.cubes == 1 and getattr(self, name) != getattr(Arrows, name):
                raise InvalidValueError(f"{name}={getattr(self, name)} needs another cube; give at least 2 cubes.")

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
    def forbidden(self) -> tuple[str, ...]:
        """The parts of ``forbid``."""
        return tuple(str(self.forbid).split("+"))

    @cached_property
    def turns(self) -> tuple[tuple[Turn, ...], ...]:
        """The turns that each macro-action makes, that of its own cube first. Length 2 ``cubes``."""
        last = self.cubes - 1
        turns = [
            tuple(Turn(each, clockwise) for each in (cube, cube + 1)[: 2 if self._coupled and cube < last else 1])
            for cube in range(self.cubes)
            for clockwise in (True, False)
        ]
        if self.shuffle is None:
            return tuple(turns)
        rng = np.random.default_rng(self.shuffle)
        return tuple(turns[each] for each in rng.permutation(len(turns)).tolist())

    @property
    def _coupled(self) -> bool:
        return self.coupling == "neighbour"

    def _usual(self, name: str) -> Setting:
        if name == "forbid":
            return "equal" if self.cubes < N_DIRECTIONS else "neighbours"
        return super()._usual(name)
