"""The arrow puzzle (thesis, chapter 5) and its hard variant: what the bench needs to know, and the environments.

Importing this module is cheap: MuJoCo loads when an environment or a frame is made.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, Promises, TaskSpec

from .arrow_rules import N_CUBES, ArrowPuzzleRules
from .rules import facts

if TYPE_CHECKING:
    from .macro_env import MacroEnv

HORIZON = 10
_DIRECTIONS = ("toward the human", "right", "toward the agent", "left")
_CUBES = ("left", "middle", "right")
_PLAY = (
    "Three cubes carry an arrow each and a human points at one of them; the arm turns one cube by a quarter a time. "
    "The arrow of the cube pointed at must come to point toward the human{extra}, and no two arrows may ever point "
    "the same way."
)


_PROMISES = Promises(
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
    from .arrow_world import ArrowWorld  # noqa: PLC0415  (MuJoCo loads on the first frame)
    from .studio import frames_of  # noqa: PLC0415

    return frames_of(ArrowWorld, SPEC.rules, macrostates, appearance, rng)


def _spec(*, hard: bool) -> TaskSpec:
    rules = ArrowPuzzleRules(hard=hard)
    return TaskSpec(
        id="arrow_puzzle_hard" if hard else "arrow_puzzle",
        title="Arrow puzzle, hard" if hard else "Arrow puzzle",
        description=_PLAY.format(extra=", no arrow toward the agent" if hard else ""),
        env_id="imagine_bench/ArrowPuzzleHard-v0" if hard else "imagine_bench/ArrowPuzzle-v0",
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
        reference="arrow_puzzle_hard" if hard else "arrow_puzzle",
        promises=None if hard else _PROMISES,
    )


SPEC = _spec(hard=False)
HARD_SPEC = _spec(hard=True)


def _make(spec: TaskSpec, options: dict[str, Any]) -> MacroEnv:
    from .arrow_world import ArrowWorld  # noqa: PLC0415  (MuJoCo loads with the first environment)
    from .macro_env import MacroEnv  # noqa: PLC0415

    return MacroEnv(spec, ArrowWorld, **options)


def make_env(**options: Any) -> MacroEnv:
    """The arrow puzzle; ``options`` are the keyword arguments of MacroEnv."""
    return _make(SPEC, options)


def make_hard_env(**options: Any) -> MacroEnv:
    """The hard variant; ``options`` are the keyword arguments of MacroEnv."""
    return _make(HARD_SPEC, options)
