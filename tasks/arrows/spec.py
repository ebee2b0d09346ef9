"""Arrow puzzles (thesis, chapter 5): the bench's description of each world, and the environments.

Worlds of as many cubes share scene and encoders, whatever their goals and other parameters. An agent's knowledge of how
one of them moves is true in every other one with the same turns.

Importing this module is cheap: MuJoCo loads when an environment or a frame is made.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.wrappers import TimeLimit

from imagine_bench.arrays import Observed
from imagine_bench.interfaces import PerformanceTargets, TaskSpec
from imagine_bench.preprocessing import gray_name
from imagine_bench.rules import facts
from imagine_bench.values import Setting

from .. import specs
from .rules import ArrowRules, Arrows, Goal

if TYPE_CHECKING:
    from ..macro_env import MacroEnv

_DIRECTIONS = ("toward the human", "right", "toward the agent", "left")
_CUBES = {1: ("only",), 2: ("left", "right"), 3: ("left", "middle", "right")}
_COUNTED = ("one", "two", "three", "four", "five", "six")
_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth")
_FORBIDDEN = {
    "none": "",
    "equal": ", and no two arrows may ever point the same way",
    "neighbours": ", and no two neighbouring arrows may ever point the same way",
}
_NAMED = {
    Arrows(): ("arrows", "Arrows", "Arrows"),
    Arrows(horizon=10): ("arrow_puzzle", "Arrow puzzle", "ArrowPuzzle"),
    Arrows(forbid="equal+agent", horizon=10): ("arrow_puzzle_hard", "Arrow puzzle, hard", "ArrowPuzzleHard"),
    Arrows(goal="toward_agent", horizon=10): (
        "arrow_puzzle_toward",
        "Arrow puzzle, toward the agent",
        "ArrowPuzzleToward",
    ),
    Arrows(goal="clockwise", horizon=10): ("arrow_puzzle_clockwise", "Arrow puzzle, clockwise", "ArrowPuzzleClockwise"),
    Arrows(cubes=1, horizon=2): ("arrow_puzzle_easy", "Arrow puzzle, easy", "ArrowPuzzleEasy"),
}
"""Registered points of the family: name, title, and Gymnasium's name of the task."""
_IN_THESIS = ("arrow_puzzle", "arrow_puzzle_hard")
_TARGETS = PerformanceTargets(
    objects=("cube_0", "cube_1", "cube_2"),
    as_ruled=0.999,
    other_objects_mm=1.0,
    error_deg=1.0,
    physics_per_cpu_s=120,
    kinematic_per_cpu_s=6_000,
    encoders={"clean": 0.995, "mild": 0.995, "strong": 0.98, "photo": 0.94},
    goes_on=True,
)
"""The first task's; the others that are registered share its physics and its encoders."""


def _described(world: Arrows, goal: Goal) -> str:
    if goal.pointed is not None:
        wanted = f"The arrow of the cube pointed at must come to point {_DIRECTIONS[goal.pointed]}"
    else:
        wanted = f"The arrows must come to point {', '.join(_DIRECTIONS[each] for each in goal.pattern)}"
    absent = "".join(f", with no arrow {_DIRECTIONS[each]}" for each in goal.absent)
    forbidden = "".join(_FORBIDDEN.get(part, "") for part in world.forbidden if world.cubes > 1)
    carry = "cube carries an arrow" if world.cubes == 1 else "cubes carry an arrow each"
    also = " and the next one with it" if world.coupling == "neighbour" else ""
    return (
        f"{_COUNTED[world.cubes - 1].capitalize()} {carry} and a human points at one of them; the arm turns one cube"
        f"{also} by a quarter a time. {wanted}{absent}{forbidden}."
    )


def spec_of(**world: Setting) -> TaskSpec:
    """A world of the family, by the fields of :class:`.rules.Arrows`.

    Raises:
        InvalidValueError: No such world, or one whose goal cannot be reached from anywhere.
        UnknownNameError: An unknown goal, forbid or coupling.
    """
    return _spec(Arrows.taken_from(world))


@functools.cache
def _spec(world: Arrows) -> TaskSpec:
    rules = ArrowRules(world)
    unnamed = (str(world), f"Arrows ({world.words})", f"Arrows-{world.hash}")
    name, title, gymnasium_name = _NAMED.get(world, unnamed)
    cubes = _CUBES.get(world.cubes, _ORDINALS[: world.cubes])
    return TaskSpec(
        id=name,
        title=title,
        description=_described(world, rules.goal),
        env_id=f"imagine_bench/{gymnasium_name}-v0",
        horizon=rules.horizon if rules.start_states else 0,
        action_names=tuple(
            f"turn the {cubes[turn.cube]} cube {'clockwise' if turn.clockwise else 'counter-clockwise'}"
            for turn, *_ in world.turns
        ),
        macrostate_names=(*(f"{cube} arrow" for cube in cubes), "pointed cube"),
        macrostate_values=(_DIRECTIONS,) * world.cubes + (cubes,),
        preprocessing=gray_name(world.cubes),
        encoder=("arrow_puzzle" if world.cubes == Arrows.cubes else f"arrows_{world.cubes}") + world.encoder_suffix,
        rules=rules,
        sight=world.observation_model(),
        facts=functools.partial(facts, rules, rules.horizon),
        render_macrostates=functools.partial(specs.render_macrostates, rules),
        reference=name if name in _IN_THESIS else None,
        targets=_targets(world, name),
    )


def _targets(world: Arrows, name: str) -> PerformanceTargets | None:
    if name == "arrow_puzzle":
        return _TARGETS
    objects = tuple(f"cube_{cube}" for cube in range(world.cubes))
    return None if world in _NAMED else replace(_TARGETS, objects=objects, encoders={})


def make_env(**options: Any) -> MacroEnv:
    """A world of the family, without a time limit.

    Args:
        **options: Fields of :class:`.rules.Arrows`, and the keyword arguments of MacroEnv.

    Raises:
        InvalidValueError, UnknownNameError: As :func:`spec_of`.
    """
    return specs.make_env(Arrows, _spec, options)


def make_limited_env(**options: Any) -> TimeLimit[Observed, np.int64]:
    """As :func:`make_env`, truncated at the world's own horizon."""
    env = make_env(**options)
    return TimeLimit(env, env.horizon)
