"""Single macro-actions by hand commands: their environment, varied starts, and the words that ask for each."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from imagine_bench.tasks.continuous.controls import MOST_OPEN_M
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.spec import make_arrows, make_pick_place
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD
from numpy.typing import NDArray

from imagine_bench.errors import require_known
from imagine_bench.interfaces import State
from imagine_bench.rules import Rules, states_of

CONTROL = "joint"
"""The control of all commands here: joints (rad) and the grip, absolute, as in ACT. Errors do not add up."""
START_JOINTS_RAD = 0.08
"""The largest distance of each joint from the observation pose at a varied start: some 4 cm of the hand."""
PLACEMENT_M = 0.03
"""How far off their slots objects start by default, where policies are trained and tried."""
START_PERIODS = 8
"""Control periods in which the arm goes from the observation pose to a varied start."""
FAMILIES: Mapping[str, Callable[..., MotionEnv]] = {
    "arrows": functools.partial(make_arrows, horizon=10),
    "pick_place": make_pick_place,
}
HOME_COMMAND = np.array([*OBSERVATION_QPOS_RAD, 1.0], dtype=np.float32)
"""The command that keeps the arm at its observation pose, with open fingers."""
HELD_GRIP = 0.5
"""Fingers that are told to be nearer together than this at a start hold something."""
Observed = Mapping[str, NDArray[Any]] | NDArray[Any]
"""Several parts by name, or one."""
Command = NDArray[np.float32]
"""Joints (rad) and grip. Shape (8,)."""


def skill_env(observation: str, appearance: str = "clean", *, family: str = "arrows", **options: Any) -> MotionEnv:
    """A world for single macro-actions.

    Args:
        observation: The parts that a policy sees, as the environment takes them.
        appearance: How much the scene varies.
        family: ``"arrows"``: three arrow cubes; or ``"pick_place"``.
        **options: Other options of the family's world and of the environment.

    Raises:
        UnknownNameError: Another family.
    """
    make = FAMILIES[require_known("family", family, FAMILIES)]
    return make(control=CONTROL, observation=observation, appearance=appearance, **options)


def begin(env: MotionEnv, macro_action: int, rng: np.random.Generator) -> Any:
    """Start an episode anywhere, with the arm off its observation pose. Returns the observation.

    The macrostate is any of the rules' in which the macro-action moves an object. Joints are drawn, and the grip too
    unless the fingers hold something.
    """
    starts = _starts(env.task.rules, macro_action)
    start = starts[int(rng.integers(len(starts)))]
    observation, _ = env.reset(seed=int(rng.integers(2**31)), options={"macrostate": start})
    away_rad = rng.uniform(-START_JOINTS_RAD, START_JOINTS_RAD, len(OBSERVATION_QPOS_RAD))
    command = HOME_COMMAND.copy()
    command[:-1] += away_rad.astype(np.float32)
    grip = rng.uniform(0.0, 1.0)
    held = told_grip(env) < HELD_GRIP
    command[-1] = told_grip(env) if held else grip
    for _ in range(START_PERIODS):
        observation, *_ = env.step(command)
    return observation


def _starts(rules: Rules, macro_action: int) -> list[State]:
    moves = (
        (state, outcome.macrostate) for state in states_of(rules) for outcome in rules.outcomes(state, macro_action)
    )
    return list(dict.fromkeys(state for state, reached in moves if state[:-1] != reached[:-1]))


def told_grip(env: MotionEnv) -> float:
    """The fingers' command now, as a grip from -1 (closed) to 1 (open)."""
    return 2.0 * float(env.data.ctrl[-1]) / MOST_OPEN_M - 1.0


def numbers_of(observation: Observed) -> NDArray[np.float32]:
    """The parts of an observation that are no images, one after the other."""
    return np.concatenate([part.ravel() for _, part in _parts(observation) if part.ndim < 3], dtype=np.float32)


def images_of(observation: Observed) -> dict[str, NDArray[np.uint8]]:
    """The images of an observation by camera."""
    return {name: part for name, part in _parts(observation) if part.ndim == 3}


def _parts(observation: Observed) -> list[tuple[str, NDArray[Any]]]:
    """Each part by name, in alphabetical order; one alone has none."""
    return sorted(observation.items()) if isinstance(observation, Mapping) else [("", observation)]
