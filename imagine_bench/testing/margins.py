"""How far each physics setting that makes a grasp hold may go before macro-actions fail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np

from imagine_bench import statistics
from imagine_bench.errors import DivergedError
from imagine_bench.interfaces import SENSES, PhysicsSettings, State, TaskSpec
from imagine_bench.seeding import SeedTree, episode_seed

SWEEPS: dict[str, tuple[float, ...]] = {
    "pad_friction": (1.2, 0.6, 0.3, 0.2, 0.1, 0.05, 0.03, 0.01, 0.003, 0.001),
    "finger_force_n": (30, 10, 5, 3, 2, 1.5, 1, 0.9, 0.7, 0.5, 0.3, 0.1),
    "object_mass": (1, 3, 5, 10, 15, 20, 30, 35, 40, 60),
    "plan_error_mm": (0, 2, 4, 6, 8, 10, 12, 14, 17, 20, 25, 30, 40),
    "plan_error_deg": (0, 5, 10, 15, 20, 25, 30, 32, 35, 40, 45),
}
"""Values of each setting, the first as built. Beyond 45 degrees a cube looks as if turned the other way."""
_WALKS, _WALK_ACTIONS = 5, 200
_STANDS_M = 0.02
"""An object so near to its first height stands."""


def measure_margins(spec: TaskSpec, trials: int, show: Callable[[str], None]) -> dict[str, Any]:
    """Sweep each setting alone, walk with true and nominal poses, show a Markdown table and return the figures.

    A task whose environment takes no ``physics`` has none. A trial is one macro-action from a start that moves an
    object if it succeeds. The same starts, actions and seeds serve every value.
    """
    try:
        _env(spec, PhysicsSettings()).close()
    except TypeError:  # Gymnasium's, for a keyword that the environment does not take
        show(f"No margins: the environment of {spec.id} takes no physics settings.")
        return {}
    show("| setting | value | as ruled | 95 % (Wilson) |\n|---|---|---|---|")
    curves: dict[str, list[dict[str, float]]] = {name: [] for name in SWEEPS}
    for name, values in SWEEPS.items():
        for value in values:
            right = as_ruled(spec, PhysicsSettings.of({name: float(value)}), trials)
            low, high = statistics.wilson(right, trials)
            point = {"value": float(value), "as_ruled": right, "trials": trials, "low": low, "high": high}
            curves[name].append(point)
            show(f"| {name} | {value:g} | {right} of {trials} | {low:.3f} to {high:.3f} |")
    walks = [walk(spec, sense) for sense in SENSES]
    for each in walks:
        show(f"| sense | {each['sense']} | {each['as_ruled']} of {each['actions']} | {len(each['faults'])} faults |")
    return {"built": asdict(PhysicsSettings()), "curves": curves, "walks": walks}


def as_ruled(spec: TaskSpec, settings: PhysicsSettings, trials: int) -> int:
    """How many of so many macro-actions end as the rules say and without a fault."""
    env = _env(spec, settings)
    rng, right = SeedTree(0).child("margins", spec.id).generator(), 0
    for trial in range(trials):
        start = spec.rules.start_states[int(rng.integers(len(spec.rules.start_states)))]
        action = int(rng.choice(_moves(spec, start)))
        env.reset(seed=episode_seed("tuning", 0, trial), options={"macrostate": start})
        try:
            *_, info = env.step(action)
        except DivergedError:
            continue
        right += not info["fault"]
    env.close()
    return right


def walk(spec: TaskSpec, sense: str) -> dict[str, Any]:
    """Walk at random, without a reset, among actions that move an object and leave one to move; a fault ends a walk.

    Returns:
        The sense; macro-actions done, and as ruled; of each walk its length and what ended it early; and in mm the
        furthest that a standing object came from where it stood at first.
    """
    env, rng = _env(spec, PhysicsSettings(sense=sense)), SeedTree(0).child("margins", "walk", spec.id).generator()
    lengths, faults, drift_m = [], [], 0.0
    for number in range(_WALKS):
        _, info = env.reset(seed=episode_seed("tuning", 1, number))
        at_first, length = env.world.object_poses(), 0
        while length < _WALK_ACTIONS and not info["fault"]:
            state = tuple(info["macrostate"].tolist())
            going_on = [a for a in _moves(spec, state) if all(_moves(spec, then) for then in _after(spec, state, a))]
            *_, info = env.step(int(rng.choice(going_on)))
            length += 1
            off_m = env.world.object_poses() - at_first  # [N, 7]
            standing = (np.abs(off_m[:, 2]) < _STANDS_M) & (not info["fault"])  # [N]
            drift_m = max(drift_m, float(np.linalg.norm(off_m[standing, :2], axis=1).max(initial=0.0)))
        lengths.append(length)
        faults += [info["fault_reason"]] if info["fault"] else []
    env.close()
    done = {"sense": sense, "actions": sum(lengths), "as_ruled": sum(lengths) - len(faults)}
    return {**done, "lengths": lengths, "faults": faults, "drift_mm": 1e3 * drift_m}


def _env(spec: TaskSpec, settings: PhysicsSettings) -> Any:
    return gymnasium.make(spec.env_id, physics=settings, disable_env_checker=True).unwrapped


def _after(spec: TaskSpec, state: State, action: int) -> list[State]:
    return [outcome.macrostate for outcome in spec.rules.outcomes(state, action)]


def _moves(spec: TaskSpec, state: State) -> Sequence[int]:
    """Actions that change an object's coordinate, whatever people answer; people's is the last one."""
    n = len(state) - 1
    return [a for a in range(spec.n_actions) if all(then[:n] != state[:n] for then in _after(spec, state, a))]
