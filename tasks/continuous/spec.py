"""The environments of continuous control, a line for each family of worlds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import PhysicsSettings, TaskSpec

from ..arrows import spec as arrows
from ..arrows.rules import Arrows
from ..parameters.parameters import WorldParameters
from ..pick_place import spec as pick_place
from ..pick_place.rules import PickPlace
from ..specs import world_maker

if TYPE_CHECKING:
    from .env import MotionEnv


def make_arrows(**options: Any) -> MotionEnv:
    """A world of arrow cubes by hand commands.

    Args:
        **options: Fields of :class:`..arrows.rules.Arrows`, and the keyword arguments of :class:`.env.MotionEnv`.

    Raises:
        InvalidValueError, UnknownNameError: A value out of its range, or a parameter that has no meaning here.
    """
    return _make(Arrows, arrows.spec_of, options)


def make_pick_place(**options: Any) -> MotionEnv:
    """Pick-and-place with a human by hand commands; options as of :func:`make_arrows`, of its own world."""
    return _make(PickPlace, pick_place.spec_of, options)


def _require_no_planner(physics: PhysicsSettings) -> None:
    for name in ("plan_error_mm", "plan_error_deg", "sense"):
        if getattr(physics, name) != getattr(PhysicsSettings, name):
            raise InvalidValueError(
                f"Physics setting {name} is of the planner of macro-actions, and commands have none; leave it out."
            )


def _make(kind: type[WorldParameters], spec_of: Callable[..., TaskSpec], options: dict[str, Any]) -> MotionEnv:
    from .env import MotionEnv  # noqa: PLC0415  (MuJoCo loads with the first environment)
    from .instructions import instruction  # noqa: PLC0415  (likewise)

    world = kind.taken_from(options, MotionEnv.KEYWORDS)
    world.require_motion()
    _require_no_planner(PhysicsSettings.of(options.get("physics", {})))
    task = spec_of(**vars(replace(world, slip=0.0)))
    make_world = functools.partial(world_maker(world), control=True)
    return MotionEnv(task, make_world, instruct=functools.partial(instruction, task), slip=world.slip, **options)
