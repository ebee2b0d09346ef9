"""The goal of a macrostate in words: the pointing hand says it without words."""

from __future__ import annotations

from imagine_bench.arrays import State
from imagine_bench.interfaces import TaskSpec

from ..arrows.rules import ArrowRules, Goal
from ..pick_place.rules import OPEN_PALM, WITHDRAWN, held_object
from ..scenes.objects import OBJECTS


def instruction(task: TaskSpec, macrostate: State) -> str:
    """The wish of the person in a macrostate, such as "Turn the left arrow toward the human."."""
    if isinstance(task.rules, ArrowRules):
        return _turn(task, task.rules.goal, macrostate)
    return _pick(macrostate)


def _turn(task: TaskSpec, goal: Goal, macrostate: State) -> str:
    directions, cubes = task.macrostate_values[0], task.macrostate_values[-1]
    if goal.pattern:
        wanted = [f"the {cube} arrow {directions[each]}" for cube, each in zip(cubes, goal.pattern, strict=True)]
        return f"Turn {', '.join(wanted)}."
    assert goal.pointed is not None
    words = f"Turn the {cubes[macrostate[-1]]} arrow {directions[goal.pointed]}"
    absent = "".join(f", with no arrow {directions[each]}" for each in goal.absent)
    return f"{words}{absent}."


def _pick(macrostate: State) -> str:
    gesture = macrostate[-1]
    held = held_object(macrostate)
    if gesture == WITHDRAWN:
        return "Stop."
    if gesture == OPEN_PALM:
        return "Hand it over." if held is None else f"Hand the {OBJECTS[held].name} over."
    wanted = f"Pick the {OBJECTS[gesture].name} up."
    return wanted if held is None else f"Put the {OBJECTS[held].name} back. {wanted}"
