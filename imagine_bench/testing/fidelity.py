"""Does contact physics do what the rules say? Long random walks beside a perfect execution."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import APPEARANCES, State, TaskSpec
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree, episode_seed

_CLEAN, _ACTIONS_A_WALK, _ACTIONS_A_VARIED_WALK = APPEARANCES[0], 200, 5
"""Macro-actions between two resets: errors may accumulate; where poses vary, a turn undoes what the reset drew."""
_STANDS_M = 0.02
"""An object so near to its height on the table stands there."""
_QUARTER_RAD = np.pi / 2


@dataclass
class Fidelity:
    """What a walk showed."""

    actions: int = 0  #: macro-actions done
    as_ruled: int = 0  #: how many ended as the rules say, without a fault
    faults: list[str] = field(default_factory=list)  #: reasons of the others
    other_objects_mm: float = 0.0  #: the furthest that an object moved which the action should leave where it stood
    #: Of each object acted on, its distance from where a perfect execution leaves it.
    error_mm: list[float] = field(default_factory=list)
    #: Its yaw from there, to the nearest quarter turn, since objects have no marked side.
    error_deg: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)  #: CPU seconds of each macro-action, frame included
    #: Of each macro-action that might slip: whether it did, and the probability that the rules gave to that.
    slips: list[tuple[bool, float]] = field(default_factory=list)
    slipped_mm: float = 0.0  #: the furthest that an object moved whose macro-action slipped


def measure_fidelity(spec: TaskSpec, actions: int, appearance: str = _CLEAN) -> Fidelity:
    """Walk at random in contact physics, judged by the objects' poses in the simulation and not by ``info`` alone.

    Of a task without ``targets`` no object is known, and ``info`` alone judges.

    Args:
        spec: The task.
        actions: Macro-actions of the measurement.
        appearance: Says how far from their places a reset puts objects.
    """
    objects = () if spec.targets is None else spec.targets.objects
    goes_on = spec.targets is not None and spec.targets.goes_on
    real, perfect = (
        gymnasium.make(spec.env_id, execution=execution, appearance=appearance, disable_env_checker=True).unwrapped
        for execution in ("physics", "kinematic")
    )
    found, rng = Fidelity(), SeedTree(0).child("speed", "physics", spec.id).generator()
    walk = _ACTIONS_A_WALK if appearance == _CLEAN else _ACTIONS_A_VARIED_WALK
    play = [state for state in states_of(spec.rules) if not spec.rules.is_terminal(state)]
    real.reset(seed=episode_seed("tuning", 0, actions))
    standing_m = _poses(real, objects)[:, 2]  # every start has all objects on the table
    fresh = True
    for step in range(actions):
        if fresh or step % walk == 0:
            options = {"macrostate": play[int(rng.integers(len(play)))]}
            for env in (perfect, real):
                _, info = env.reset(seed=episode_seed("tuning", 0, step), options=options)
        before, state = _poses(real, objects), tuple(int(value) for value in info["macrostate"])
        action = int(rng.integers(spec.n_actions))
        *_, wanted = perfect.step(action)
        start = time.process_time()
        _, _, terminated, _, info = real.step(action)
        found.cpu_s.append(time.process_time() - start)
        right = not info["fault"] and np.array_equal(info["macrostate"], wanted["macrostate"])
        found.actions, found.as_ruled = found.actions + 1, found.as_ruled + right
        if right:
            after, reached = _poses(real, objects), info["macrostate"][: len(before)]
            moves, slip = _may_move(spec, state, action, len(after))
            moved = np.not_equal(state[: len(after)], reached)
            if 0 < slip < 1:
                found.slips.append((not moved.any(), slip))
            if not moved.any():
                shifts_mm = 1e3 * np.linalg.norm(after[moves, :3] - before[moves, :3], axis=1)
                found.slipped_mm = max(found.slipped_mm, float(shifts_mm.max(initial=0.0)))
            _compare(found, moved, moves, standing_m, before, after, _poses(perfect, objects))
        else:
            found.faults.append(info.get("fault_reason", f"{wanted['macrostate']} was to be reached"))
        fresh = not right or (terminated and not goes_on)
    for env in (real, perfect):
        env.close()
    return found


def _poses(env: Any, objects: Sequence[str]) -> NDArray[np.float64]:
    """Positions and quaternions of the named bodies, now. Shape (N, 7)."""
    if not objects:
        return np.empty((0, 7))
    motion = env.motion()
    return np.asarray(motion.poses_in_world[-1][[motion.body_names.index(name) for name in objects]])


def _may_move(spec: TaskSpec, state: State, action: int, objects: int) -> tuple[NDArray[np.bool_], float]:
    """Which of so many objects the rules let a macro-action move (N,), and the probability that it moves none."""
    outcomes = spec.rules.outcomes(state, action)
    moved = [np.not_equal(state, each.macrostate)[:objects] for each in outcomes]
    stays = [each.probability for each, objects_moved in zip(outcomes, moved, strict=True) if not objects_moved.any()]
    return np.logical_or.reduce(moved), float(sum(stays))


def _compare(
    found: Fidelity,
    moved: NDArray[np.bool_],
    may_move: NDArray[np.bool_],
    standing_m: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    perfect: NDArray[np.float64],
) -> None:
    """Take in where the objects are after a macro-action that ended as the rules say.

    Args:
        found: Changed in place.
        moved: Objects whose coordinate changed. Shape (N,).
        may_move: Objects that the action can move. Shape (N,).
        standing_m: Height of each on the table. Shape (N,).
        before: Poses before the action. Shape (N, 7).
        after: Poses after it. Shape (N, 7).
        perfect: Poses after a perfect execution. Shape (N, 7).
    """
    stood = (np.abs(before[:, 2] - standing_m) < _STANDS_M) & (np.abs(after[:, 2] - standing_m) < _STANDS_M)
    for index in np.flatnonzero(moved):
        found.error_mm.append(1e3 * float(np.linalg.norm(after[index, :3] - perfect[index, :3])))
        off_rad = (_yaw_rad(after[index]) - _yaw_rad(perfect[index]) + _QUARTER_RAD / 2) % _QUARTER_RAD
        found.error_deg.append(abs(float(np.degrees(off_rad - _QUARTER_RAD / 2))))
    for index in np.flatnonzero(stood & ~may_move):
        moved_mm = 1e3 * float(np.abs(after[index, :3] - before[index, :3]).max())
        found.other_objects_mm = max(found.other_objects_mm, moved_mm)


def _yaw_rad(pose: NDArray[np.float64]) -> float:
    """Yaw of a pose (position, quaternion w x y z) about the world's vertical."""
    w, x, y, z = pose[3:]
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
