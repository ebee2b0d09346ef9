"""The rules of pick-and-place with a human (thesis, chapter 3): no physics, no pixels, exact, and stochastic.

A macrostate is ``(left, middle, right, gesture)``: where each object is, left to right in the agent's frame, and the
gesture of the human's hands. Twelve macrostates are play (thesis, table 3.1); seven more are ends: three with an object
in the human's palm, four with the hands withdrawn, which is how the human answers whatever they did not ask for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

from imagine_bench.interfaces import Outcome, State

from ..parameters.parameters import WorldParameters, WorldRules

N_OBJECTS = 3
PLACED, PICKED, HANDED_OVER = range(3)
POINTING = tuple(range(N_OBJECTS))
"""Gesture ``i`` points at object i."""
OPEN_PALM = N_OBJECTS
WITHDRAWN = N_OBJECTS + 1
HAND_OVER = N_OBJECTS
"""The action after the three that pick or place an object."""

PICK_REWARD = 1.0
PLACE_REWARD = 0.0
HANDOVER_REWARD = 5.0
WRONG_REWARD = -5.0

_ALL_PLACED = (PLACED,) * N_OBJECTS


def held_object(macrostate: State) -> int | None:
    """Which object the gripper holds."""
    return macrostate.index(PICKED) if PICKED in macrostate[:N_OBJECTS] else None


def _with(objects: State, index: int, value: int) -> State:
    return (*objects[:index], value, *objects[index + 1 :])


@dataclass(frozen=True, kw_only=True)
class PickPlace(WorldParameters):
    """A world: the parameters of all tasks, and no others."""

    FAMILY: ClassVar[str] = "pick_place"
    SCENE: ClassVar[str] = "imagine_bench.tasks.pick_place.world:PickWorld"


@dataclass(frozen=True)
class PickPlaceRules(WorldRules):
    """The macrostate machine: action i picks object i, or places it if it is held; action 3 hands over.

    The human's next gesture is drawn: after a pick that was asked for, the two other objects and the open palm are
    equally likely. Everything else is certain but for the world's parameters.
    """

    world: PickPlace = PickPlace()

    @property
    def n_actions(self) -> int:
        """One an object, and the handover."""
        return N_OBJECTS + 1

    @cached_property
    def states(self) -> tuple[State, ...]:
        """The 12 macrostates of play in the order of table 3.1, then the 7 ends."""
        held = [_with(_ALL_PLACED, each, PICKED) for each in range(N_OBJECTS)]
        play = [(*_ALL_PLACED, gesture) for gesture in POINTING]
        play += [(*objects, gesture) for objects in held for gesture in self._wishes(objects.index(PICKED))]
        given = [(*_with(_ALL_PLACED, each, HANDED_OVER), OPEN_PALM) for each in range(N_OBJECTS)]
        return (*play, *given, *((*objects, WITHDRAWN) for objects in (_ALL_PLACED, *held)))

    @cached_property
    def start_states(self) -> tuple[State, ...]:
        """Everything on the table, the human points at one of the three."""
        return tuple((*_ALL_PLACED, gesture) for gesture in POINTING)

    @staticmethod
    def _wishes(held: int) -> State:
        """The possible next gestures when ``held`` has been picked as asked."""
        return (*(each for each in POINTING if each != held), OPEN_PALM)

    def is_legal(self, macrostate: State) -> bool:
        """Whether the human's hands are still there: they are withdrawn at the first wrong action."""
        return macrostate[N_OBJECTS] != WITHDRAWN

    def is_terminal(self, macrostate: State) -> bool:
        """Whether an object was handed over or the human has withdrawn."""
        return HANDED_OVER in macrostate[:N_OBJECTS] or not self.is_legal(macrostate)

    def is_asked_for(self, macrostate: State, action: int) -> bool:
        """Whether ``action`` is the human's present wish, or the step toward it."""
        if self.is_terminal(macrostate):
            return False
        held = held_object(macrostate)
        gesture = macrostate[N_OBJECTS]
        if held is None:
            return action == gesture
        return action == (HAND_OVER if gesture == OPEN_PALM else held)

    def objects_after(self, macrostate: State, action: int) -> State:
        """Where the objects are after ``action``, asked for or not: the robot does it as far as that is possible.

        Raises:
            InvalidValueError: No such action.
        """
        self.require_action(action)
        objects = macrostate[:N_OBJECTS]
        held = held_object(macrostate)
        if HANDED_OVER in objects:
            return objects
        if action == HAND_OVER:
            offered = held is not None and macrostate[N_OBJECTS] == OPEN_PALM
            return _with(objects, held, HANDED_OVER) if held is not None and offered else objects
        if held is None:
            return _with(objects, action, PICKED)
        return _with(objects, held, PLACED) if action == held else objects

    def outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        """One outcome a possible next gesture, and one of an object that slips, which is not punished."""
        found = self._outcomes(macrostate, action)
        return found if self.is_terminal(macrostate) else self.varied(macrostate, found)

    def slipped(self, macrostate: State) -> Outcome:
        """The outcome of a macro-action that does nothing, which is not punished."""
        return Outcome(1.0, macrostate, PLACE_REWARD, terminated=False, success=False)

    def asked_otherwise(self, outcome: Outcome) -> list[Outcome]:
        """The outcomes where the human makes another gesture."""
        objects = outcome.macrostate[:N_OBJECTS]
        gesture = outcome.macrostate[N_OBJECTS]
        held = held_object(outcome.macrostate)
        wishes = POINTING if held is None else self._wishes(held)
        return [replace(outcome, macrostate=(*objects, wish)) for wish in wishes if wish != gesture]

    def _outcomes(self, macrostate: State, action: int) -> tuple[Outcome, ...]:
        objects = self.objects_after(macrostate, action)
        if not self.is_asked_for(macrostate, action):
            gesture = OPEN_PALM if HANDED_OVER in objects else WITHDRAWN
            return (Outcome(1.0, (*objects, gesture), WRONG_REWARD, terminated=True, success=False),)
        if action == HAND_OVER:
            return (Outcome(1.0, (*objects, OPEN_PALM), HANDOVER_REWARD, terminated=True, success=True),)
        if PICKED not in objects:
            unchanged = macrostate[N_OBJECTS]
            return (Outcome(1.0, (*objects, unchanged), PLACE_REWARD, terminated=False, success=False),)
        wishes = self._wishes(action)
        return tuple(
            Outcome(1.0 / len(wishes), (*objects, wish), PICK_REWARD, terminated=False, success=False)
            for wish in wishes
        )

    def judge(self, macrostate: State, action: int, reached: State) -> Outcome:
        """The outcome that was reached; whatever is none of them counts as a wrong action."""
        for outcome in self.outcomes(macrostate, action):
            if outcome.macrostate == reached:
                return outcome
        return Outcome(1.0, reached, WRONG_REWARD, terminated=True, success=False)
