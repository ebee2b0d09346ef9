"""The arrow puzzle (thesis, chapter 5) and its family: what the bench needs to know, and the environments.

The members of the family share scene, macro-actions and the illegal rule, and so encoders and everything that moves;
they differ in the goal alone: what has been learned of the world in one of them is true in every other.

Importing this module is cheap: MuJoCo loads when an environment or a frame is made.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import require_known
from imagine_bench.interfaces import Frame, PerformanceTargets, TaskSpec
from imagine_bench.rules import facts

from .rules import GOALS, N_CUBES, TURNS, ArrowPuzzleRules, Goal

if TYPE_CHECKING:
    from ..macro_env import MacroEnv

HORIZON = 10
_DIRECTIONS = ("toward the human", "right", "toward the agent", "left")
_CUBES = ("left", "middle", "right")
_FAMILY = {
    "toward_human": ("arrow_puzzle", "Arrow puzzle", "ArrowPuzzle"),
    "toward_human_alone": ("arrow_puzzle_hard", "Arrow puzzle, hard", "ArrowPuzzleHard"),
    "toward_agent": ("arrow_puzzle_toward", "Arrow puzzle, toward the agent", "ArrowPuzzleToward"),
    "left": ("arrow_puzzle_clockwise", "Arrow puzzle, clockwise", "ArrowPuzzleClockwise"),
}
"""By goal: name, title, and Gymnasium's name of the task."""
_IN_THESIS = ("arrow_puzzle", "arrow_puzzle_hard")
_TARGETS = PerformanceTargets(
    objects=tuple(f"cube_{cube}" for cube in range(N_CUBES)),
    as_ruled=0.999,
    other_objects_mm=1.0,
    error_deg=1.0,
    physics_per_cpu_s=120,
    kinematic_per_cpu_s=6_000,
    encoders={"clean": 0.995, "mild": 0.995, "strong": 0.98, "photo": 0.94},
    goes_on=True,
)
"""The first task's; the others share its physics and its encoders."""


def render_macrostates(macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
    """Frames of macrostates in the kinematic mode; see :func:`.frames.frames_of`."""
    from ..frames import frames_of  # noqa: PLC0415
    from .world import ArrowWorld  # noqa: PLC0415  (MuJoCo loads on the first frame)

    return frames_of(ArrowWorld, ArrowPuzzleRules(), macrostates, appearance, rng)


def _described(goal: Goal) -> str:
    alone = "" if goal.absent is None else f" with no arrow {_DIRECTIONS[goal.absent]},"
    return (
        "Three cubes carry an arrow each and a human points at one of them; the arm turns one cube by a quarter a "
        f"time. The arrow of the cube pointed at must come to point {_DIRECTIONS[goal.pointed]},{alone} and no two "
        "arrows may ever point the same way."
    )


@functools.cache
def spec_of(goal: str = "toward_human") -> TaskSpec:
    """The member of the family with a goal.

    Raises:
        UnknownNameError: No such goal; the message lists all of them.
    """
    name, title, gymnasium_name = _FAMILY[require_known("goal", goal, _FAMILY)]
    rules = ArrowPuzzleRules(GOALS[goal])
    return TaskSpec(
        id=name,
        title=title,
        description=_described(rules.goal),
        env_id=f"imagine_bench/{gymnasium_name}-v0",
        horizon=HORIZON,
        action_names=tuple(
            f"turn the {_CUBES[turn.cube]} cube {'clockwise' if turn.clockwise else 'counter-clockwise'}"
            for turn in TURNS
        ),
        macrostate_names=(*(f"{cube} arrow" for cube in _CUBES), "pointed cube"),
        macrostate_values=(_DIRECTIONS,) * N_CUBES + (_CUBES,),
        preprocessing="gray_strips",
        encoder="arrow_puzzle",
        rules=rules,
        facts=functools.partial(facts, rules, HORIZON),
        render_macrostates=render_macrostates,
        reference=name if name in _IN_THESIS else None,
        targets=_TARGETS if name == "arrow_puzzle" else None,
    )


def make_env(*, goal: str = "toward_human", **options: Any) -> MacroEnv:
    """A member of the family.

    Args:
        goal: A name in :data:`.rules.GOALS`.
        **options: The keyword arguments of MacroEnv.

    Raises:
        UnknownNameError: No such goal; the message lists all of them.
    """
    from ..macro_env import MacroEnv  # noqa: PLC0415
    from .world import ArrowWorld  # noqa: PLC0415  (MuJoCo loads with the first environment)

    return MacroEnv(spec_of(goal), ArrowWorld, **options)
