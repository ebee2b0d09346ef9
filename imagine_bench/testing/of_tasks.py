"""What must hold of a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any, SupportsFloat

import numpy as np
from gymnasium.utils.env_checker import check_env

from imagine_bench.environments import Env
from imagine_bench.interfaces import TaskSpec
from imagine_bench.rules import facts, states_of
from imagine_bench.testing.common import NotOffered, make_env, require

_MOST = 200
"""Starts and macro-actions tried."""
_KEYS = {"macrostate", "is_success", "legal", "fault"}


def _rules(spec: TaskSpec) -> None:
    found = facts(spec.rules, spec.horizon)
    require(found.optimum > 0.0, "an optimal agent never succeeds within the horizon")


def _frames(spec: TaskSpec) -> None:
    states = np.array(states_of(spec.rules)[:_MOST])
    one, other = (spec.render_macrostates(states, "clean", np.random.default_rng(0)) for _ in range(2))
    given = f"{one.dtype} of shape {one.shape}"
    require(one.dtype == np.uint8 and one.shape == (len(states), 64, 64, 3), f"{len(states)} frames are {given}")
    require(np.array_equal(one, other), "two calls with equal generators differ")


def _gymnasium(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as env:
        check_env(env.unwrapped, skip_render_check=True)


def _starts(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as env:
        states = states_of(spec.rules)
        for start in (*spec.rules.start_states[:_MOST], *states[:: 1 + len(states) // _MOST]):
            _, info = env.reset(seed=0, options={"macrostate": start})
            require(info.keys() >= _KEYS, f"info lacks {sorted(_KEYS - info.keys())}")
            told = tuple(np.asarray(info["macrostate"]).tolist())
            require(told == start, f"begun in {start}, it tells {told}")


def _steps(spec: TaskSpec) -> None:
    rng = np.random.default_rng(0)
    over = True
    state = spec.rules.start_states[0]
    with closing(make_env(spec)) as env:
        for _ in range(_MOST):
            if over:
                state = tuple(np.asarray(env.reset(seed=int(rng.integers(1 << 30)))[1]["macrostate"]).tolist())
            action = int(rng.integers(spec.n_actions))
            _, reward, terminated, truncated, info = env.step(action)
            end = tuple(np.asarray(info["macrostate"]).tolist())
            found = (end, float(reward), terminated, bool(info["is_success"]))
            allowed = [(o.macrostate, o.reward, o.terminated, o.success) for o in spec.rules.outcomes(state, action)]
            words = f"action {action} in {state} gave {found}, the rules allow {allowed}"
            require(found in allowed or bool(info["fault"]), words)
            state = end
            over = terminated or truncated


def _episode(env: Env, seed: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    found: list[Any] = [env.reset(seed=seed)[0]]
    over = False
    while not over:
        frame, reward, terminated, truncated, _ = env.step(int(rng.integers(env.action_space.n)))  # type: ignore[attr-defined]
        found += [frame, reward]
        over = terminated or truncated
    return found


def _repeats(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as one, closing(make_env(spec)) as other:
        _episode(other, 1)
        for seed in range(3):
            pairs = zip(_episode(one, seed), _episode(other, seed), strict=True)
            require(all(np.array_equal(a, b) for a, b in pairs), f"two episodes of seed {seed} differ")


def _kept(spec: TaskSpec) -> None:
    with closing(make_env(spec)) as one, closing(make_env(spec)) as other:
        env = one.unwrapped
        twin = other.unwrapped
        if not (hasattr(env, "get_state") and hasattr(env, "set_state")):
            raise NotOffered("the environment has no get_state and set_state")
        env.reset(seed=1)
        twin.reset(seed=2)
        env.step(0)
        state = env.get_state()
        walked = _walk(env, spec)
        for again, where in ((env, "in the same environment"), (twin, "in another")):
            again.set_state(state)
            require(_walk(again, spec) == walked, f"put back {where}, it goes on otherwise")


def _walk(env: Env, spec: TaskSpec) -> list[tuple[bytes, SupportsFloat, bool, list[int]]]:
    """What follows on some random macro-actions, to the end of the episode at most."""
    rng = np.random.default_rng(0)
    found = list[tuple[bytes, SupportsFloat, bool, list[int]]]()
    over = False
    while not over and len(found) < spec.horizon:
        frame, reward, over, _, info = env.step(int(rng.integers(spec.n_actions)))
        found.append((np.asarray(frame).tobytes(), reward, over, np.asarray(info["macrostate"]).tolist()))
    return found


TASK_CHECKS: Mapping[str, Callable[[TaskSpec], None]] = {
    "its rules are distributions, reach an end and can be won": _rules,
    "its frames are 64 x 64 RGB bytes and the same for the same generator": _frames,
    "Gymnasium's checker is content": _gymnasium,
    "every macrostate is begun in, and told": _starts,
    "macro-actions end as the rules say": _steps,
    "the same seed gives the same episode": _repeats,
    "in the middle of an episode its state is kept and put back, to the bit": _kept,
}
"""What must hold of a task, a sentence each."""
