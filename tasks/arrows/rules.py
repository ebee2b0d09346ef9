"""Arrow puzzles (thesis, chapter 5): a world of the family in one line, ``arrows:cubes=5,slip=0.1``, and its rules.

The rules know no physics and no images, and are exact. A world is a goal, forbidden arrangements, the effect of a turn,
the order of the macro-actions and its parameters.

A macrostate is ``(d0, ..., dn-1, pointed)``: the directions of the arrows, left to right in the agent's frame, and the
cube that the human points at. Directions: 0 toward the human (up in the frame), 1 right, 2 toward the agent, 3 left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, pairwise, product
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError, brief, require_known
from imagine_bench.interfaces import Outcome, State
from imagine_bench.values import Setting

from ..parameters.parameters import WorldParameters, WorldRules

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
    """A world; its canonical name says the parameters that differ from the defaults.

    Raises:
        InvalidValueError: A value of the wrong type or out of its range, or values that contradict each other.
        UnknownNameError: An unknown goal, forbid or coupling.
    """

    cubes: int = 3  #: 1 to 6
    #: The condition that must come true. ``"pointed"``: the arrow of the cube pointed at, toward the human (thesis
    #: 5.2.1); ``"toward_agent"``: the same toward the agent; ``"clockwise"``: the same to the left, and no arrow a
    #: quarter turn clockwise of it; ``"all"``: all arrows toward the human; or a digit a cube, its direction, such as
    #: ``"0123"``.
    goal: str = "pointed"
    #: The forbidden arrangements: ``"none"``; ``"equal"``: two arrows alike (thesis); ``"neighbours"``: two alike side
    #: by side; ``"agent"``: no goal has an arrow toward the agent (thesis 5.2.3); several joined by ``+``. None is
    #: ``"equal"`` up to 3 cubes and ``"neighbours"`` from 4 on, and becomes that.
    forbid: str | None = None
    coupling: str = "none"  #: ``"neighbour"``: a turn also turns the next cube to the right, the same way
    shuffle: int | None = None  #: a seed of the order of the macro-actions; None leaves it
    horizon: int | None = None  #: macro-actions before truncation, 1 to 1000; None: by the longest shortest plan

    FAMILY: ClassVar[str] = "arrows"
    SCENE: ClassVar[str] = "imagine_bench.tasks.arrows.world:ArrowWorld"
    IN_VIEW: ClassVar[tuple[str, ...]] = ("cubes", "distractors")
    MACRO_ACTIONS_ALONE: ClassVar[Mapping[str, str]] = {
        "shuffle": "the order of macro-actions, of which a hand knows none",
        "coupling": "that a macro-action turns two cubes, which one hand cannot at once",
    }
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


TOWARD_HUMAN, RIGHT, TOWARD_AGENT, LEFT = range(N_DIRECTIONS)

GOAL_REWARD = 50.0
ILLEGAL_REWARD = -5.0
STEP_REWARD = -1.0
SHORTEST_HORIZON = 10
PLANS_IN_HORIZON = 2
"""Where a world names no horizon, it is so many times its longest shortest plan, and at least the shortest horizon."""


@dataclass(frozen=True)
class Goal:
    """A condition on legal macrostates."""

    pointed: int | None = None  #: direction of the arrow of the cube that the human points at, or None for any
    absent: State = ()  #: directions that no arrow may have
    pattern: State = ()  #: direction of every arrow, or empty for any

    @classmethod
    def of(cls, world: Arrows) -> Goal:
        """That of a world."""
        pattern = "0" * world.cubes if world.goal == "all" else world.goal
        goal = _GOALS[world.goal] if world.goal in _GOALS else cls(pattern=tuple(map(int, pattern)))
        return replace(goal, absent=(*goal.absent, TOWARD_AGENT)) if "agent" in world.forbidden else goal

    def holds(self, macrostate: State) -> bool:
        """Whether a legal macrostate is a goal."""
        *directions, pointed = macrostate
        return (
            (self.pointed is None or directions[pointed] == self.pointed)
            and (not self.pattern or tuple(directions) == self.pattern)
            and not any(each in directions for each in self.absent)
        )


_GOALS = {
    "pointed": Goal(TOWARD_HUMAN),
    "toward_agent": Goal(TOWARD_AGENT),
    "clockwise": Goal(LEFT, absent=(TOWARD_HUMAN,)),
}


@dataclass(frozen=True)
class ArrowRules(WorldRules):
    """The macrostate machine of a world.

    Args:
        world: The world.
    """

    world: Arrows = field(default_factory=Arrows)

    @cached_property
    def goal(self) -> Goal:
        """Which of the legal macrostates are goals."""
        return Goal.of(self.world)

    @property
    def n_actions(self) -> int:
        """Two a cube."""
        return len(self.world.turns)

    @cached_property
    def states(self) -> tuple[State, ...]:
        """All macrostates: 192 of three cubes, 24,576 of six."""
        cubes = self.world.cubes
        return tuple(product(*[range(N_DIRECTIONS)] * cubes, range(cubes)))

    @cached_property
    def start_states(self) -> tuple[State, ...]:
        """The macrostates that are no end and from which turns lead to a goal, whatever slips or changes.

        Raises:
            InvalidValueError: There is none.
        """
        lengths = self.plan_lengths
        starts = tuple(state for state, length in zip(self.states, lengths.tolist(), strict=True) if length > 0)
        if not starts:
            raise InvalidValueError(
                f"World {self.world} has no start from which its goal can be reached; give another goal or forbid less."
            )
        return starts

    @cached_property
    def plan_lengths(self) -> NDArray[np.int64]:
        """Fewest turns from each macrostate to a goal without slips; 0 at goals, -1 where no turns do. Shape (S,)."""
        states = np.array(self.states)
        legal, goal = (np.array([what(state) for state in self.states]) for what in (self.is_legal, self.is_goal))
        after = []
        for turns in self.world.turns:
            turned = states.copy()
            for turn in turns:
                turned[:, turn.cube] = (turned[:, turn.cube] + (1 if turn.clockwise else -1)) % N_DIRECTIONS
            after.append(np.ravel_multi_index(tuple(turned.T), states.max(axis=0) + 1))
        lengths = np.where(goal, 0, -1)
        for length in count(1):
            leads = np.any([lengths[reached] == length - 1 for reached in after], axis=0)
            found = legal & (lengths < 0) & leads
            if not found.any():
                break
            lengths[found] = length
        return lengths

    @property
    def horizon(self) -> int:
        """Macro-actions before truncation."""
        longest = int(self.plan_lengths.max())
        return self.world.horizon or max(SHORTEST_HORIZON, PLANS_IN_HORIZON * longest)

    def is_legal(self, macrostate: State) -> bool:
        """Whether no two arrows are alike that may not be."""
        directions = macrostate[:-1]
        forbidden = self.world.forbidden
        if "equal" in forbidden and len(set(directions)) < len(directions):
            return False
        return "neighbours" not in forbidden or all(left != right for left, right in pairwise(directions))

    def is_goal(self, macrostate: State) -> bool:
        """Whether the macrostate is legal and a goal."""
        return self.is_legal(macrostate) and self.goal.holds(macrostate)

    def is_terminal(self, macrostate: State) -> bool:
        """Whether the macrostate is a goal or illegal."""
        return self.is_goal(macrostate) or not self.is_legal(macrostate)

    def turned(self, macrostate: State, action: int) -> State:
        """The macrostate after a macro-action that does not slip, also out of a terminal one.

        Raises:
            InvalidValueError: No such action.
        """
        self.require_action(action)
        turned = list(macrostate)
        for turn in self.world.turns[action]:
            turned[turn.cube] = (turned[turn.cube] + (1 if turn.clockwise else -1)) % N_DIRECTIONS
        return tuple(turned)

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        """Reward and end of an episode depend on the macrostate reached alone."""
        del macrostate, action
        if not self.is_legal(reached):
            return Outcome(1.0, reached, ILLEGAL_REWARD, terminated=True, success=False)
        if self.is_goal(reached):
            return Outcome(1.0, reached, GOAL_REWARD, terminated=True, success=True)
        return Outcome(1.0, reached, STEP_REWARD, terminated=False, success=False)

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """The result of a turn, which is certain but for the world's parameters."""
        return self.varied(macrostate, (self.judge(macrostate, action, self.turned(macrostate, action)),))

    def asked_otherwise(self, outcome: Outcome) -> list[Outcome]:
        """The outcomes where the human points at another cube."""
        *directions, pointed = outcome.macrostate
        others = [(*directions, cube) for cube in range(self.world.cubes) if cube != pointed]
        return [self.judge(outcome.macrostate, 0, other) for other in others]
