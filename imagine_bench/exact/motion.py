"""The certificate of continuous control: at most as the rules say, at least as measured motions show.

No motion beats the rules, so the optimum of their macro-actions, of which there may be as many as one likes, is an
upper bound. The lower bound composes segments, each of which is one planned macro-action that was carried out in
physics, by dynamic programming over the rules.

It assumes that a pair (arrangement of objects, macro-action) without a failure fails no more often than all segments
together, for which the lower end of Wilson's 95 % interval is taken; that a failure loses the episode; that every
macro-action takes as long as the longest one; and that objects which were moved stand as those of a start do.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np

from imagine_bench.interfaces import TaskSpec
from imagine_bench.rules import RuleTables, horizon_optimum, tabulate
from imagine_bench.statistics import wilson

_UNLIMITED = 20
"""Horizons after which further macro-actions solve no further episodes that count."""


@dataclass(frozen=True, kw_only=True)
class MotionCertificate:
    """Both bounds of a task at one appearance, and their evidence."""

    optimum: float  #: largest success probability with any number of macro-actions
    shown: float  #: that planned motions reach within the time limit, at 95 % confidence
    segments: int
    as_ruled: int
    pairs: int  #: that there are; ``measured_pairs`` of them were measured
    measured_pairs: int
    mean_s: float  #: duration of a segment, with the way back to the observation pose
    mean_low_s: float  #: 95 % interval of the mean over the pairs
    mean_high_s: float
    longest_s: float
    least_s: float  #: mean over the same segments of a lower bound of their durations, for any controller
    time_limit_s: float
    macro_actions: int  #: of the longest duration that the time limit has room for
    episodes: int  #: whole ones, of planned motions one after another
    solved: int
    random_episodes: int
    random_solved: int


def measured(task: str) -> dict[str, Any]:
    """The measurements of a task: by appearance, with the command, commit, machine and seed; empty if nothing was."""
    file = resources.files(__package__).joinpath("measured", f"{task}.json")
    return dict(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else {}


def certificate(spec: TaskSpec, found: dict[str, Any]) -> MotionCertificate:
    """Both bounds, from the rules and from the measurements at one appearance (``Measured`` of continuous control)."""
    tables = tabulate(spec.rules)
    tries, as_ruled, mean_s, longest_s, ends = np.array([each[2:] for each in found["segments"]]).T
    whole_s = mean_s[ends == ends.min()]
    count = max(1, int(found["time_limit_s"] / longest_s.max()))
    spread_s = 1.96 * float(whole_s.std()) / np.sqrt(len(whole_s))
    return MotionCertificate(
        optimum=_success(tables, _UNLIMITED * spec.horizon),
        shown=_success(_as_measured(tables, found), count),
        segments=int(tries.sum()),
        as_ruled=int(as_ruled.sum()),
        pairs=found["pairs"],
        measured_pairs=len(mean_s),
        mean_s=float(whole_s.mean()),
        mean_low_s=float(whole_s.mean() - spread_s),
        mean_high_s=float(whole_s.mean() + spread_s),
        longest_s=float(longest_s.max()),
        least_s=float(np.mean(found["least_s"], where=ends == ends.min())),
        time_limit_s=found["time_limit_s"],
        macro_actions=count,
        **{name: found[name] for name in ("episodes", "solved", "random_episodes", "random_solved")},
    )


def _success(tables: RuleTables, horizon: int) -> float:
    return float(horizon_optimum(tables, horizon).success[tables.starts].mean())


def _as_measured(tables: RuleTables, found: dict[str, Any]) -> RuleTables:
    """A machine in which macro-actions fail as segments did, and a failure ends the episode.

    The share of each pair is scaled as the lower end of the interval of all segments is to their share. No pair has
    more than this lower end.
    """
    tries = sum(each[2] for each in found["segments"])
    as_ruled = sum(each[3] for each in found["segments"])
    low, _ = wilson(as_ruled, tries)
    works = {
        (tuple(each[0]), each[1]): each[3] / each[2] * low * tries / max(as_ruled, 1) for each in found["segments"]
    }
    unmeasured = low if len(works) < found["pairs"] else 0.0
    share = np.array(
        [
            [works.get((state[:-1], action), unmeasured) for state in tables.index]
            for action in range(len(tables.reward))
        ]
    ).clip(0.0, low)
    alive = tables.alive.multiply(share.ravel()[:, None]).tocsr()
    return replace(tables, alive=alive, success=share * tables.success)


def evidence(found: MotionCertificate) -> str:
    """The measurements behind the lower bound, in words."""
    sampled = "" if found.measured_pairs == found.pairs else f" ({found.measured_pairs:,} of {found.pairs:,} pairs)"
    return (
        f"{found.as_ruled:,} of {found.segments:,} macro-actions{sampled} as ruled, {found.solved:,} of "
        f"{found.episodes:,} episodes solved; {found.mean_low_s:.2f} to {found.mean_high_s:.2f} s a macro-action on "
        f"average, {found.longest_s:.1f} s at most; any hand needs at least {found.least_s:.2f} s"
    )


def chance(found: MotionCertificate) -> str:
    """The success of random hand twists, with its 95 % interval, in words."""
    if not found.random_episodes:
        return "chance not measured"
    low, high = wilson(found.random_solved, found.random_episodes)
    return (
        f"chance {100 * found.random_solved / found.random_episodes:.2g} % [{100 * low:.2g}, {100 * high:.2g}] "
        f"({found.random_episodes:,} episodes of random twists, a new one a period)"
    )


def rows(spec: TaskSpec, name: str) -> dict[str, str]:
    """The certificate in words, by heading; ``name`` is that of the environment in commands."""
    levels = {level: certificate(spec, found) for level, found in measured(spec.id).get("appearances", {}).items()}
    if not levels:
        return {"by hand": f"not measured; imagine-bench check {name} --physics measures how far it can be solved"}
    first = next(iter(levels.values()))
    shown = ", ".join(f"{100 * each.shown:.1f} % ({level})" for level, each in levels.items())
    multiple = first.time_limit_s / spec.horizon / first.mean_s
    return {
        "by hand": f"optimum {100 * first.optimum:.4g} %, shown reachable {shown}, "
        f"at least {first.least_s:.2f} s a macro-action, shown {first.mean_s:.2f} s, {chance(first)}",
        "shown by": "; ".join(f"{level}: {evidence(each)}" for level, each in levels.items()),
        "time limit": f"{first.time_limit_s:g} s, {multiple:.1f} times the mean for each macro-action of the horizon; "
        f"room for {first.macro_actions} macro-actions of the longest",
    }
