"""How often a policy carries out a single macro-action that it is asked for: tries, not retries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .cloning import Clone
from .skills import begin, skill_env

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


def one_try(env: Any, clone: Clone, macro_action: int, rng: np.random.Generator) -> Try:
    """One try from a start that is drawn."""
    observation = begin(env, macro_action, rng)
    clone.begin(env.task.action_names[macro_action])
    appearance = env.world.level.name
    period = 0
    over = False
    while period < MOST_PERIODS and not over:
        observation, _, _, truncated, info = env.step(clone.act(observation))
        period += 1
        over = bool(info["event"]) or truncated
    done = bool(info["event"]) and int(info["macro_action"]) == macro_action
    fault = "" if done else info["fault_reason"] or ("another macro-action" if info["event"] else "no event")
    return Try(macro_action=macro_action, appearance=appearance, done=done, periods=period, fault=fault)


def tries(
    clone: Clone, count: int, *, seed: int, appearances: Sequence[str] = ("clean", "mild"), **options: Any
) -> list[Try]:
    """Tries over all macro-actions and appearances in turn, from starts that are drawn."""
    rng = np.random.default_rng(seed)
    envs = [skill_env(clone.observation, appearance, **options) for appearance in appearances]
    found = []
    for index in range(count):
        env = envs[index % len(envs)]
        found.append(one_try(env, clone, index // len(envs) % env.task.n_actions, rng))
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
