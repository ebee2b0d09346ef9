"""Ids of environments, and their registration with Gymnasium."""

from __future__ import annotations

import gymnasium

from imagine_bench.registry.entries import TaskEntry


def register_env(entry: TaskEntry) -> None:
    """Register a task's environment with Gymnasium, unless its id is known already; a suite's own also as a vector."""
    if entry.env_id in gymnasium.registry:
        return
    gymnasium.register(
        entry.env_id,
        entry.env,
        reward_threshold=entry.reward_threshold,
        max_episode_steps=entry.horizon,
        kwargs=dict(entry.options),
    )
    own = entry.env.startswith("imagine_bench.")
    if own:
        _register_vector(entry.env_id, entry.env, entry, entry.horizon)
    if entry.motion:
        env_id = motion_id(entry.env_id)
        threshold = entry.reward_threshold
        gymnasium.register(env_id, entry.motion, reward_threshold=threshold, kwargs=dict(entry.options))
        if own:
            _register_vector(env_id, entry.motion, entry, None)


def _register_vector(env_id: str, env: str, entry: TaskEntry, horizon: int | None) -> None:
    gymnasium.register(
        vector_id(env_id),
        vector_entry_point="imagine_bench.tasks.vector_env:make",
        reward_threshold=entry.reward_threshold,
        max_episode_steps=horizon,
        kwargs={"env": env, **entry.options},
    )


def motion_id(env_id: str) -> str:
    """The id of a task's environment of continuous control, by that of its macro-actions."""
    name, _, version = env_id.rpartition("-v")
    return f"{name}Motion-v{version}"


def motion_name(env_id: str) -> str:
    """The name of an environment of continuous control on a command line: ``ArrowPuzzleMotion``."""
    return env_id.rpartition("/")[2].partition("-v")[0]


def vector_id(env_id: str) -> str:
    """The id of an environment's own vector environment; that of the single one keeps Gymnasium's default, sync."""
    name, _, version = env_id.rpartition("-v")
    return f"{name}-vector-v{version}"
