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

from imagine_bench.interfaces import Frame, PerformanceTargets, TaskSpec
from imagine_bench.rules import facts

from .rules import (
    N_CUBES,
    ArrowPuzzleRules,
    Goal,
    left_and_clear_clockwise,
    toward_agent,
    toward_human,
    toward_human_alone,
)

if TYPE_CHECKING:
    from ..macro_env import MacroEnv

HORIZON = 10
_DIRECTIONS = ("toward the human", "right", "toward the agent", "left")
_CUBES = ("left", "middle", "right")
_PLAY = (
    "Three cubes carry an arrow each and a human points at one of them; the arm turns one cube by a quarter a time. "
    "{wanted}, and no two arrows may ever point the same way."
)


_PROMISES = PerformanceTargets(
    objects=tuple(f"cube_{cube}" for cube in range(N_CUBES)),
    as_ruled=0.999,
    bystander_mm=1.0,
    error_deg=1.0,
    physics_per_cpu_s=120,
    kinematic_per_cpu_s=6_000,
    encoders={"clean": 0.995, "mild": 0.995, "strong": 0.98},
    goes_on=True,
)


def render_macrostates(macrostates: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
    """Frames of macrostates in the kinematic mode; see :func:`.studio.frames_of`."""
    from ..frames import frames_of  # noqa: PLC0415
    from .world import ArrowWorld  # noqa: PLC0415  (MuJoCo loads on the first frame)

    return frames_of(ArrowWorld, SPEC.rules, macrostates, appearance, rng)


def _spec(
    name: str,
    title: str,
    env_id: str,
    goal: Goal,
    wanted: str,
    *,
    reference: str | None,
    targets: PerformanceTargets | None,
) -> TaskSpec:
    rules = ArrowPuzzleRules(goal)
    return TaskSpec(
        id=name,
        title=title,
        description=_PLAY.format(wanted=wanted),
        env_id=env_id,
        horizon=HORIZON,
        action_names=tuple(
            f"turn the {cube} cube {way}" for cube in _CUBES for way in ("clockwise", "counter-clockwise")
        ),
        macrostate_names=(*(f"{cube} arrow" for cube in _CUBES), "pointed cube"),
        macrostate_values=(_DIRECTIONS,) * N_CUBES + (_CUBES,),
        preprocessing="gray_strips",
        encoder="arrow_puzzle",
        rules=rules,
        facts=functools.partial(facts, rules, HORIZON),
        render_macrostates=render_macrostates,
        reference=reference,
        targets=targets,
    )


SPEC = _spec(
    "arrow_puzzle",
    "Arrow puzzle",
    "imagine_bench/ArrowPuzzle-v0",
    toward_human,
    "The arrow of the cube pointed at must come to point toward the human",
    reference="arrow_puzzle",
    targets=_PROMISES,
)
HARD_SPEC = _spec(
    "arrow_puzzle_hard",
    "Arrow puzzle, hard",
    "imagine_bench/ArrowPuzzleHard-v0",
    toward_human_alone,
    "The arrow of the cube pointed at must come to point toward the human, no arrow toward the agent",
    reference="arrow_puzzle_hard",
    targets=None,
)
TOWARD_SPEC = _spec(
    "arrow_puzzle_toward",
    "Arrow puzzle, toward the agent",
    "imagine_bench/ArrowPuzzleToward-v0",
    toward_agent,
    "The arrow of the cube pointed at must come to point toward the agent",
    reference=None,
    targets=None,
)
CLOCKWISE_SPEC = _spec(
    "arrow_puzzle_clockwise",
    "Arrow puzzle, clockwise",
    "imagine_bench/ArrowPuzzleClockwise-v0",
    left_and_clear_clockwise,
    "The arrow of the cube pointed at must come to point left, with no arrow a quarter turn clockwise of it",
    reference=None,
    targets=None,
)


def _make(spec: TaskSpec, options: dict[str, Any]) -> MacroEnv:
    from ..macro_env import MacroEnv  # noqa: PLC0415
    from .world import ArrowWorld  # noqa: PLC0415  (MuJoCo loads with the first environment)

    return MacroEnv(spec, ArrowWorld, **options)


def make_env(**options: Any) -> MacroEnv:
    """The arrow puzzle; ``options`` are the keyword arguments of MacroEnv."""
    return _make(SPEC, options)


def make_hard_env(**options: Any) -> MacroEnv:
    """The hard variant; ``options`` are the keyword arguments of MacroEnv."""
    return _make(HARD_SPEC, options)


def make_toward_env(**options: Any) -> MacroEnv:
    """The arrow pointed at toward the agent; ``options`` are the keyword arguments of MacroEnv."""
    return _make(TOWARD_SPEC, options)


def make_clockwise_env(**options: Any) -> MacroEnv:
    """The arrow pointed at to the left, nothing clockwise of it; ``options`` are the keyword arguments of MacroEnv."""
    return _make(CLOCKWISE_SPEC, options)
