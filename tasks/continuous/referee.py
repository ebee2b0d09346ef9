"""Reads motion as the rules see it: an object that has come to another value is an event, judged as a macro-action."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Floats, Ints, State
from imagine_bench.interfaces import Outcome, Rules

from ..scenes.constants import TABLE_HEIGHT_M
from ..world import World

FAULT_REWARD = -5.0
"""Of an end that no macro-action leads to: as much as the rules of both tasks take for a wrong macro-action."""
_LEFT, _RIGHT, _OTHER = 1, 2, 4
GRIPPED = _LEFT | _RIGHT
"""Bits of the parts that touch an object: either finger, and the rest of the arm."""
_STILL_M_S = 0.01
_STILL_RAD_S = 0.2
_STILL = np.array([_STILL_M_S] * 3 + [_STILL_RAD_S] * 3)
"""An object that moves and turns more slowly, along and about each axis, is at rest."""
_FALLEN_M = TABLE_HEIGHT_M - 0.05


class Touch:
    """The parts of the robot that touch each object of a world."""

    def __init__(self, world: World) -> None:
        model = world.model
        self._data = world.data
        self._count = len(world.object_bodies)
        body_of = model.geom_bodyid
        self._object = np.full(model.ngeom, self._count)  # the last place is for everything else
        for index, body in enumerate(world.object_bodies):
            self._object[body_of == body] = index
        self._robot = np.zeros(model.ngeom, dtype=np.int64)
        self._robot[model.body_rootid[body_of] == model.body("base").id] = _OTHER
        for name, bit in (("finger_left", _LEFT), ("finger_right", _RIGHT)):
            self._robot[body_of == model.body(name).id] = bit

    def bits(self) -> Ints:
        """For each object, which parts of the robot touch it in the latest step of the simulation. Shape (N,)."""
        touched = np.zeros(self._count + 1, dtype=np.int64)
        geoms = self._data.contact.geom
        robot = self._robot[geoms]
        for contact, side in np.transpose(robot.nonzero()).tolist():
            touched[self._object[geoms[contact, 1 - side]]] |= robot[contact, side]
        return touched[:-1]


@dataclass(frozen=True, kw_only=True)
class Event:
    """A change of the macrostate, as the rules judge it."""

    action: int  #: the macro-action that it amounts to, or -1
    outcome: Outcome
    fault: str | None  #: why it is no macro-action, in words, or None


class Referee:
    """Watches the objects of a world, and says when and how the macrostate has changed.

    An object at rest that no part of the robot touches has the value that is read of its pose. One that is touched or
    moves has its value of before, until it has passed another one: a cube that is turned on its place by more than a
    quarter and 20 degrees, an object that is gripped and lifted. So one grasp cannot skip a macrostate: a skipped part
    beside its place is a fault when the object comes to rest. Where one object changes, all others must stand, or be
    held, as the macrostate says.

    Args:
        world: The scene.
        rules: Its task's.
        values: Names of the values of each coordinate of a macrostate.
    """

    def __init__(self, world: World, rules: Rules, values: Sequence[Sequence[str]]) -> None:
        self._world = world
        self._rules = rules
        self._values = values
        self._touch = Touch(world)
        self._speeds = world.object_qvel
        self._at_rest: tuple[State, bytes] | None = None

    def touched(self) -> Ints:
        """As :meth:`Touch.bits`."""
        return self._touch.bits()

    def event(self, macrostate: State, rng: np.random.Generator) -> Event | None:
        """The event of the control period that is over, if there was one.

        Args:
            macrostate: Where the episode is.
            rng: Draws the human's answer where the rules leave a choice.
        """
        poses = self._world.object_poses()
        stands = (macrostate, poses.tobytes())
        if stands == self._at_rest:  # nothing has moved since it was found to be so
            return None
        touched = self.touched().tolist()
        moving = self._moving().tolist()
        objects = list(macrostate[:-1])
        changed = []
        problems = []
        disturbed = []
        for index, pose in enumerate(poses.tolist()):
            problem = None
            if pose[2] < _FALLEN_M:
                value = objects[index]
                problem = f"{self._world.object_names[index]} fell off the table"
            elif touched[index] or moving[index]:
                gripped = bool(touched[index] & GRIPPED == GRIPPED)
                value = self._world.value_in_hand(index, pose, objects[index], gripped=gripped)
                if not touched[index] or self._world.read_object(index, pose) != (value, None):
                    disturbed.append(index)
            else:
                value, problem = self._world.read_object(index, pose)
            if problem is not None:
                problems.append(problem)
            if value != objects[index]:
                changed.append(index)
                objects[index] = value
        if not changed and not problems:
            self._at_rest = None if any(touched) or any(moving) else stands
            return None
        at_once = [self._world.object_names[index] for index in sorted({*changed, *disturbed})]
        if not problems and len(at_once) > 1:
            problems.append(f"{' and '.join(at_once)} moved at once")
        return self._judged(macrostate, tuple(objects), problems, rng)

    def _moving(self) -> NDArray[np.bool_]:
        speeds: Floats = np.abs(self._world.data.qvel[self._speeds])
        return np.asarray((speeds > _STILL).any(axis=1))

    def _judged(self, before: State, objects: State, problems: Sequence[str], rng: np.random.Generator) -> Event:
        if not problems:
            for action in range(self._rules.n_actions):
                fitting = [each for each in self._rules.outcomes(before, action) if each.macrostate[:-1] == objects]
                if fitting:
                    return Event(action=action, outcome=_drawn(fitting, rng), fault=None)
            problems = [self._impossible(index, before[index], then) for index, then in enumerate(objects)]
        reached = Outcome(1.0, (*objects, before[-1]), FAULT_REWARD, terminated=True, success=False)
        return Event(action=-1, outcome=reached, fault="; ".join(filter(None, problems)))

    def _impossible(self, index: int, before: int, then: int) -> str:
        """How an object changed that no macro-action changes so; empty for one that did not change."""
        if before == then:
            return ""
        values = self._values[index]
        return f"{self._world.object_names[index]} went from {values[before]} to {values[then]} in one motion"


def _drawn(outcomes: Sequence[Outcome], rng: np.random.Generator) -> Outcome:
    """One of several outcomes, by their chances."""
    which = 0
    if len(outcomes) > 1:
        chances = np.array([each.probability for each in outcomes])
        which = int(rng.choice(len(outcomes), p=chances / chances.sum()))
    return replace(outcomes[which], probability=1.0)
