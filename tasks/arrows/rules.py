"""The rules of the arrow puzzle (thesis, chapter 5) and of its family: no physics, no images, exact.

A macrostate is ``(d0, d1, d2, pointed)``: the arrow directions of the cubes, left to right in the agent's frame, and
the cube the human points at. Directions: 0 toward the human (up in the frame), 1 right, 2 toward the agent, 3 left.
What a turn does and what is illegal is the same for the whole family; its members differ in the goal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Outcome
from imagine_bench.rules import optimal_policy, tabulate

N_CUBES = 3
N_DIRECTIONS = 4
TOWARD_HUMAN, RIGHT, TOWARD_AGENT, LEFT = range(N_DIRECTIONS)

GOAL_REWARD = 50.0
ILLEGAL_REWARD = -5.0
STEP_REWARD = -1.0


@dataclass(frozen=True)
class Turn:
    """A macro-action: a quarter turn of one cube, as seen in the frame."""

    cube: int
    clockwise: bool


TURNS = tuple(Turn(cube, clockwise) for cube in range(N_CUBES) for clockwise in (True, False))
"""What each action does."""


@dataclass(frozen=True)
class Goal:
    """A condition on legal macrostates."""

    pointed: int  #: direction of the arrow of the cube that the human points at
    absent: int | None = None  #: direction that no arrow may have, or None

    def holds(self, macrostate: tuple[int, ...]) -> bool:
        """Whether a legal macrostate is a goal."""
        directions = macrostate[:N_CUBES]
        return directions[macrostate[N_CUBES]] == self.pointed and self.absent not in directions


GOALS = {
    "toward_human": Goal(TOWARD_HUMAN),  # thesis 5.2.1
    "toward_human_alone": Goal(TOWARD_HUMAN, absent=TOWARD_AGENT),  # the hard variant, thesis 5.2.3
    "toward_agent": Goal(TOWARD_AGENT),
    "left": Goal(LEFT, absent=TOWARD_HUMAN),
}
"""One a member of the family."""


@dataclass(frozen=True)
class ArrowPuzzleRules:
    """The macrostate machine of the arrow puzzle.

    Args:
        goal: Which of the legal macrostates are goals.
    """

    goal: Goal = GOALS["toward_human"]

    @property
    def n_actions(self) -> int:
        """Two turns a cube."""
        return len(TURNS)

    @cached_property
    def states(self) -> tuple[tuple[int, ...], ...]:
        """All 192 macrostates."""
        return tuple(product(*[range(N_DIRECTIONS)] * N_CUBES, range(N_CUBES)))

    @cached_property
    def start_states(self) -> tuple[tuple[int, ...], ...]:
        """The macrostates that are not terminal: of 72 legal ones, those that are no goal."""
        return tuple(state for state in self.states if not self.is_terminal(state))

    def is_legal(self, macrostate: tuple[int, ...]) -> bool:
        """Whether all arrows point in different directions."""
        return len(set(macrostate[:N_CUBES])) == N_CUBES

    def is_goal(self, macrostate: tuple[int, ...]) -> bool:
        """Whether the macrostate is legal and a goal."""
        return self.is_legal(macrostate) and self.goal.holds(macrostate)

    def is_terminal(self, macrostate: tuple[int, ...]) -> bool:
        """Whether the macrostate is a goal or illegal."""
        return self.is_goal(macrostate) or not self.is_legal(macrostate)

    def turned(self, macrostate: tuple[int, ...], action: int) -> tuple[int, ...]:
        """The macrostate after a quarter turn, also out of a terminal one.

        Raises:
            InvalidValueError: No such action.
        """
        if not 0 <= action < self.n_actions:
            raise InvalidValueError(f"Action {action} does not exist; give an integer from 0 to {self.n_actions - 1}.")
        turn, turned = TURNS[action], list(macrostate)
        turned[turn.cube] = (turned[turn.cube] + (1 if turn.clockwise else -1)) % N_DIRECTIONS
        return tuple(turned)

    def judge(self, macrostate: tuple[int, ...], action: int, reached: tuple[int, ...]) -> Outcome:
        """Reward and end of an episode depend on the macrostate reached alone."""
        del macrostate, action
        if not self.is_legal(reached):
            return Outcome(1.0, reached, ILLEGAL_REWARD, terminated=True, success=False)
        if self.is_goal(reached):
            return Outcome(1.0, reached, GOAL_REWARD, terminated=True, success=True)
        return Outcome(1.0, reached, STEP_REWARD, terminated=False, success=False)

    def outcomes(self, macrostate: tuple[int, ...], action: int) -> tuple[Outcome, ...]:
        """The one result of a turn, which is certain."""
        return (self.judge(macrostate, action, self.turned(macrostate, action)),)

    @cached_property
    def _policy(self) -> dict[tuple[int, ...], int]:
        return dict(zip(self.states, optimal_policy(tabulate(self)).tolist(), strict=True))

    def optimal_action(self, macrostate: tuple[int, ...]) -> int:
        """The first action of a shortest plan (the lowest index among equals)."""
        return self._policy[tuple(int(value) for value in macrostate)]
