"""How often a policy carries out a single macro-action that it is asked for: tries, not retries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.scenes.constants import CONTROL_CAMERAS, FRAME_PX

from imagine_bench.errors import InvalidValueError, require_integer

from .cloning import Clone
from .skills import begin, images_of, skill_env

MOST_PERIODS = 75
"""Periods that a try may last: 3 s. Planned, the event comes after 1.6 s."""


@dataclass(frozen=True, kw_only=True)
class Try:
    """One try."""

    macro_action: int
    appearance: str
    done: bool  #: whether the first event was the macro-action that was asked for
    periods: int
    fault: str  #: the fault, or another event, or no event; empty where it was done


def one_try(env: Any, clone: Clone, macro_action: int, rng: np.random.Generator, other: MotionEnv | None = None) -> Try:
    """One try from a start that is drawn. The images are those of ``other``, if it is given.

    The other environment has a start of its own, and its arm is given the same commands: only the objects differ.
    """
    if other is not None:
        elsewhere = images_of(begin(other, macro_action, rng))
    observation = begin(env, macro_action, rng)
    clone.begin(env.task.action_names[macro_action])
    appearance = env.world.level.name
    period = 0
    over = False
    while period < MOST_PERIODS and not over:
        if other is not None:
            observation = {**observation, **elsewhere}
        command = clone.act(observation)
        observation, _, _, truncated, info = env.step(command)
        if other is not None:
            elsewhere = images_of(other.step(command)[0])
        period += 1
        over = bool(info["event"]) or truncated
    done = bool(info["event"]) and int(info["macro_action"]) == macro_action
    fault = "" if done else info["fault_reason"] or ("another macro-action" if info["event"] else "no event")
    return Try(macro_action=macro_action, appearance=appearance, done=done, periods=period, fault=fault)


def tries(
    clone: Clone,
    count: int,
    *,
    seed: int,
    appearances: Sequence[str] = ("clean", "mild"),
    swapped: bool = False,
    **options: Any,
) -> list[Try]:
    """Tries over all macro-actions and appearances in turn, from starts that are drawn.

    Args:
        clone: The policy.
        count: Of tries.
        seed: Of everything random.
        appearances: Levels, in turn.
        swapped: Whether the policy sees images of another start: one that uses its images fails then.
        **options: Of :func:`.skills.skill_env`, the size of images too.

    Raises:
        InvalidValueError: A policy without images, and ``swapped``; or no try.
    """
    require_integer("count", count, 1)
    require_integer("seed", seed, 0)
    if swapped and not set(CONTROL_CAMERAS) & set(clone.observation.split(",")):
        raise InvalidValueError(f"The policy sees {clone.observation}, so there are no images to swap; leave it out.")
    rng = np.random.default_rng(seed)
    options = {"size": clone.about.get("size_px", FRAME_PX), **options}
    envs, others = ([skill_env(clone.observation, each, **options) for each in appearances] for _ in range(2))
    found = []
    for index in range(count):
        which = index % len(envs)
        env = envs[which]
        other = others[which] if swapped else None
        found.append(one_try(env, clone, index // len(envs) % env.task.n_actions, rng, other))
    return found


def share_done(found: Sequence[Try]) -> float:
    """Share of tries that were done."""
    return sum(each.done for each in found) / len(found)


def summary(found: Sequence[Try]) -> dict[str, Any]:
    """Counts of tries in all, by appearance and by macro-action, and every try that failed: plain values."""
    return {
        "count": len(found),
        "done": sum(each.done for each in found),
        "mean_periods": round(float(np.mean([each.periods for each in found])), 2),
        "by_appearance": _counts(found, "appearance"),
        "by_macro_action": _counts(found, "macro_action"),
        "failed": [asdict(each) for each in found if not each.done],
    }


def _counts(found: Sequence[Try], name: str) -> dict[str, tuple[int, int]]:
    """Tries that were done, and all, by the value of a field."""
    groups: dict[str, list[bool]] = {}
    for each in found:
        groups.setdefault(str(getattr(each, name)), []).append(each.done)
    return {key: (sum(done), len(done)) for key, done in groups.items()}
