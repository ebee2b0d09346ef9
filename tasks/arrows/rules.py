"""The rules of arrow puzzles (thesis, chapter 5): no physics, no images, exact.

A world is a goal, what is forbidden, what a turn turns, the order of the macro-actions and its parameters; see
:class:`.description.Arrows`, which also says what a macrostate is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, pairwise, product

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome, State

from ..parameters.rules import WorldRules
from .description import N_DIRECTIONS, Arrows

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
