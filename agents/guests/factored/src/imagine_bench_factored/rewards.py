"""Rewards that chance changes, as a few classes: transitions of one class are worth the mean of their rewards.

Rewards are exact unless most sightings of the same transition brought different ones, or hardly any reward came twice.
Where hardly any transition was seen twice, small differences that no macro-action and value, nor two values, explain
are noise, too. Then the mean rewards of transitions are merged, the nearest ones first (Ward 1963), to the number of
classes that the integrated classification likelihood prefers (Biernacki, Celeux & Govaert 2000). An end of an episode
is a class of its own: where chance decides about ends, nothing is merged.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations_with_replacement, pairwise
from typing import NamedTuple

import numpy as np

from imagine_bench.arrays import Floats, Ints

from .factors import Code, CodeTransition

_FEWEST = 8
"""Rewards with an end, or without, that tell whether rewards come twice; pairs of rewards that tell whether two values
explain them.
"""
_DIFFERENT = 0.5
"""Share of different ones among these above which rewards are noisy."""
_PAIRS = 3
"""Pairs of sightings of one transition that tell how different its rewards are."""
_MANY = 0.25
"""Share of these pairs that differ where a few amounts are drawn."""
_TOLD = 16
"""Fewest rewards that tell whether anything explains them; before, it is known whether any came twice."""
_LITTLE = 0.1
"""Share of the range of all rewards that these differ by; by more, something that is not seen decides."""
_NEAR = 0.25
"""Share of this range within which rewards are compared if nothing was seen twice: it is small before a first success.
"""
_NORMAL = 0.954
"""Median of the absolute difference of two normal variables, in standard deviations."""
_LEAST = 1e-6
"""The least variance."""
_OF_EACH = 4
"""Rewards that a class has on average at least; two classes may have fewer."""
_FAR = 6.0
"""Standard deviations from any class beyond which a reward is new."""
Key = tuple[Code, int, Code, bool]
"""A code, an action, the next code, and whether the episode ended."""


class RewardClasses(NamedTuple):
    """The classes of the rewards that were seen; without any, rewards are exact."""

    of_key: Mapping[Key, float] = {}  #: the reward of the class of a transition that was seen
    centers: Mapping[bool, Floats] = {}  #: the rewards of all classes with an end, and without
    reach: float = 0.0  #: how far a reward of a class may be from the class's

    def reward(self, row: CodeTransition) -> float:
        """The reward of the class of a transition; its own, if it fits none."""
        if not self.centers:
            return row.reward
        known = self.of_key.get(_key(row))
        if known is not None:
            return known
        centers = self.centers.get(row.terminated, np.zeros(0))
        near = np.abs(centers - row.reward)
        return float(centers[near.argmin()]) if len(near) and near.min() <= self.reach else row.reward

    def of(self, rows: Sequence[CodeTransition]) -> list[CodeTransition]:
        """Transitions with the rewards of their classes."""
        return [row._replace(reward=self.reward(row)) for row in rows]


EXACT = RewardClasses()


def reward_classes(rows: Sequence[CodeTransition]) -> RewardClasses:
    """The classes of the rewards of transitions; exact ones, unless they are noisy."""
    told = [row for row in rows if row.has_reward and row.is_clear]
    sightings: dict[Key, list[float]] = {}
    for row in told:
        sightings.setdefault(_key(row), []).append(row.reward)
    is_continuous = _is_continuous(told)
    noise = _noise(list(sightings.values()))
    if noise is None:
        noise = 0.0 if is_continuous else _unexplained(told)
    if noise == 0.0 and not is_continuous:
        return EXACT
    of_key: dict[Key, float] = {}
    centers: dict[bool, Floats] = {}
    width = noise
    by_end = {ends: [key for key in sightings if key[-1] == ends] for ends in (False, True)}
    for ends, keys in sorted(by_end.items(), key=lambda each: -len(each[1])):
        if keys:
            means = np.array([np.mean(sightings[key]) for key in keys])
            times = np.array([len(sightings[key]) for key in keys])
            inside = sum(float(np.var(sightings[key])) * len(sightings[key]) for key in keys)
            group, width = _classes(means, times, inside, width)
            centers[ends] = np.bincount(group, means * times) / np.bincount(group, times)
            of_key.update(zip(keys, centers[ends][group].tolist(), strict=True))
    return RewardClasses(of_key, centers, _FAR * width)


def _key(row: CodeTransition) -> Key:
    return row.code, row.action, row.following, row.terminated


def _noise(sightings: Sequence[Sequence[float]]) -> float | None:
    """Standard deviation of the rewards of one transition, as most have it; None where too few were seen again.

    If not most of them differ, but many do by little, they have the noise that differs: a few amounts may come twice.
    """
    apart = _apart(sightings)
    if len(apart) < _PAIRS:
        return None
    differ = apart[apart > 0.0]
    most = float(np.median(apart))
    seen = [reward for rewards in sightings for reward in rewards]
    if most == 0.0 and len(differ) >= _MANY * len(apart) and np.median(differ) <= _LITTLE * np.ptp(seen):
        most = float(np.median(differ))
    return most / _NORMAL


def _apart(sightings: Iterable[Sequence[float]]) -> Floats:
    """How far the rewards of successive sightings are apart."""
    return np.array([abs(one - other) for rewards in sightings for one, other in pairwise(rewards)])


def _unexplained(rows: Sequence[CodeTransition]) -> float:
    """Standard deviation of rewards of which many differ by little, whichever two values of a transition are the same.

    Its values are those of the code, the macro-action, and those of the next code. 0 if any two of them, or one alone,
    may explain the rewards. Two that are hardly ever the same again tell nothing, nor do large differences.
    """
    if len(rows) < _TOLD:
        return 0.0
    little = _NEAR * np.ptp([row.reward for row in rows])
    values = np.array([(*row.code, row.action, *row.following) for row in rows])
    found: list[float] = []
    for pair in combinations_with_replacement(range(values.shape[1]), 2):
        sightings: dict[tuple[int, ...], list[float]] = {}
        for row, same in zip(rows, values[:, pair].tolist(), strict=True):
            sightings.setdefault((*same, row.terminated), []).append(row.reward)
        apart = _apart(sightings.values())
        near = apart[apart <= little]
        differ = near[near > 0.0]
        if len(near) >= _FEWEST:
            if len(differ) < _MANY * len(near):
                return 0.0
            found.append(float(np.median(differ)))
    return float(np.median(found)) / _NORMAL if found else 0.0


def _is_continuous(rows: Sequence[CodeTransition]) -> bool:
    """Whether hardly any reward came twice."""
    found = ([row.reward for row in rows if row.terminated == ends] for ends in (False, True))
    return any(len(each) >= _FEWEST and len(set(each)) > _DIFFERENT * len(each) for each in found)


def _classes(means: Floats, times: Ints, inside: float, noise: float) -> tuple[Ints, float]:
    """Classes (M,) of transitions with these mean rewards, and the standard deviation within them.

    Args:
        means: Mean rewards of M transitions.
        times: How often each was seen.
        inside: Sum of the squared distances of all rewards from the means of their transitions.
        noise: Standard deviation that rewards of a class have at least; fewer rewards tell less of it than more do.
    """
    order = np.argsort(means, kind="stable")
    center, weight, count = means[order], times[order].astype(np.float64), np.ones(len(means))
    first = np.arange(len(means))  # of each class, the place of its least mean
    total = float(times.sum())
    spread = inside
    best = (np.inf, first, 0.0)
    most = max(2.0, total / _OF_EACH)
    while True:
        variance = max(spread / total, noise**2, _LEAST)
        unsure = -2.0 * float((count * np.log(count / len(means))).sum())
        cost = total * np.log(variance) + unsure + 2.0 * len(count) * np.log(total)
        if cost <= best[0] and len(count) <= most:
            best = (cost, first, float(np.sqrt(variance)))
        if len(count) == 1:
            break
        gain = weight[:-1] * weight[1:] / (weight[:-1] + weight[1:]) * np.diff(center) ** 2
        at = int(gain.argmin())
        spread += float(gain[at])
        both = weight[at] + weight[at + 1]
        center[at] = (center[at] * weight[at] + center[at + 1] * weight[at + 1]) / both
        weight[at] = both
        count[at] += count[at + 1]
        kept = np.arange(len(count)) != at + 1
        center = center[kept]
        weight = weight[kept]
        count = count[kept]
        first = first[kept]
    group = np.empty(len(means), dtype=np.int64)
    group[order] = np.searchsorted(best[1], np.arange(len(means)), side="right") - 1
    return group, best[2]
