"""Environments of continuous control, without images, and the expert's macro-actions in them."""

from __future__ import annotations

import functools
from typing import Any

from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.continuous.spec import make_arrows, make_pick_place

FAMILIES = {"arrows": make_arrows, "pick_place": make_pick_place}
FREE: dict[str, dict[str, Any]] = {"arrows": {"goal": "000", "forbid": "none"}, "pick_place": {}}
"""Options of worlds in which nothing but the goal, or a wrong pick, ends an episode."""
STARTS = {"arrows": (1, 2, 3, 0), "pick_place": (0, 0, 0, 0)}
"""A macrostate of each, from which macro-action 0 goes on."""


@functools.cache
def environment(family: str, **options: Any) -> tuple[MotionEnv, Expert]:
    """An environment, shared by tests that reset it, and an expert of it."""
    env = FAMILIES[family](**{"observation": "proprio,objects", **options})
    return env, Expert(env)


def carry_out(env: MotionEnv, expert: Expert, action: int) -> list[dict[str, Any]]:
    """A macro-action by the expert; the info of every event."""
    expert.begin(action)
    seen = []
    while not expert.is_done:
        _, reward, terminated, truncated, info = env.step(expert.act())
        if info["event"]:
            seen.append({**info, "reward": reward})
        if terminated or truncated:
            break
    return seen
