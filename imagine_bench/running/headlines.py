"""The comparisons that a bench was made for: its protocol declares them, its runs decide them, or more seeds are run.

A headline is an agent and the agent that it should beat at the last budget. The p-values of the headlines are corrected
for one another alone (Holm); whatever else a report compares is corrected by itself and takes nothing from them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from imagine_bench import registry, statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import require_seeds
from imagine_bench.statistics import LEVEL, Estimate
from imagine_bench.store.loading import merge
from imagine_bench.store.results import BenchResult

STAGE = 3
"""Seeds that each further stage adds."""


class Headline(NamedTuple):
    """A headline, as the runs so far decide it."""

    agent: str
    base: str  #: The agent that it should beat
    found: Estimate  #: Difference of success at the last budget, its 95 % interval, and the corrected p-value
    more: int  #: How many more seeds would about decide it; 0 where it is decided or nobody can say

    @property
    def decided(self) -> bool:
        """Whether a difference is shown, in either direction."""
        return self.found.p < 1.0 - LEVEL


def headlines(result: BenchResult) -> list[Headline]:
    """The headlines of a bench, those whose agents are in it.

    A bench that may be looked at several times, with more seeds each time, has each p-value multiplied by the number of
    looks. So the chance that any look of a bench without a difference claims one is at most 5 %: each look does so with
    probability 5 % / looks (Bonferroni), whatever the looks before have shown and whenever one stops.
    """
    protocol = result.protocol
    pairs = [pair for pair in protocol.headlines if set(pair) <= set(protocol.agents)]
    trials = protocol.evaluation_episodes
    runs = [[result.success_rates(agent)[:, -1] for agent in pair] for pair in pairs]
    found = [statistics.difference(*pair, trials=trials) for pair in runs]
    adjusted = protocol.most_looks * statistics.holm([each.p for each in found])
    cells = len(pairs) * protocol.most_looks
    lines = []
    for (agent, base), both, each, p in zip(pairs, runs, found, adjusted.clip(max=1.0).tolist(), strict=True):
        more = 0 if p < 1.0 - LEVEL else statistics.more_seeds(*both, cells=cells, trials=trials)
        lines.append(Headline(agent, base, each._replace(p=p), more))
    return lines


def decided(result: BenchResult) -> bool:
    """Whether every headline is decided."""
    return all(each.decided for each in headlines(result))


def stages(first: int, most: int) -> list[int]:
    """How many seeds a bench has at each look, from ``first`` to at most ``most``.

    Raises InvalidValueError: fewer than the first.
    """
    if most < first:
        raise InvalidValueError(f"--most-seeds {most} is fewer than the bench begins with; give at least {first}.")
    return [*range(first, most, STAGE), most]


def until_decided(plan: Callable[..., BenchResult], first: Protocol, *, most: int, root: Path) -> list[BenchResult]:
    """Run seeds in stages until every headline is decided, or ``most`` seeds are done.

    Each stage is made of benches of their own, so whatever was run before is only read: an interrupted call, made
    again, goes on and ends in the same results. From the second stage on the agents of headlines alone are run, each
    with as many more seeds as the others.

    Args:
        plan: Runs a bench with changes to fields of ``first``, or reads it where it is finished.
        first: The protocol of the first stage.
        most: Most seeds of the agent that has most of them.
        root: Folder of all benches.

    Returns:
        The bench of the first stage, those of all further seeds, and last, if there are any, all as one bench.

    Raises:
        InvalidValueError: The protocol has no headline, ``most`` is less than its seeds, or tuning seeds would be added
            to reported ones.
    """
    if not first.headlines:
        raise InvalidValueError(
            "This bench has no headlines, so there is nothing to decide; leave --until-decided out. The preset quick "
            "has two if --agents is left out."
        )
    counts = stages(len(first.seeds), most)
    seeds = (*first.seeds, *range(first.seeds[-1] + 1, first.seeds[-1] + 1 + most - len(first.seeds)))
    require_seeds(seeds)
    few = {agent: len(first.seeds_of(agent)) for agent, _ in first.few_seeds}
    whole = plan(seeds=first.seeds, most_looks=len(counts), few_seeds=few)
    parts = [whole]
    for before, count in itertools.pairwise(counts):
        if decided(whole):
            break
        parts += _stage(plan, first, seeds, before, count, most_looks=len(counts))
        whole = merge(parts, root)
    return parts if whole is parts[0] else [*parts, whole]


def _stage(
    plan: Callable[..., BenchResult],
    first: Protocol,
    seeds: Sequence[int],
    before: int,
    count: int,
    *,
    most_looks: int,
) -> list[BenchResult]:
    """The benches that take the agent of most seeds from ``before`` to ``count`` of them, and others as far."""
    groups: dict[int, list[str]] = {}
    for agent in dict.fromkeys(agent for pair in first.headlines for agent in reversed(pair)):
        fewer = len(first.seeds) - len(first.seeds_of(agent))
        groups.setdefault(fewer, []).append(agent)
    found = []
    for fewer, agents in groups.items():
        known = {name for agent in agents for name in registry.setting_names(agent) - registry.inert_settings(agent)}
        part = plan(
            agents=tuple(agents),
            seeds=seeds[before - fewer : count - fewer],
            headlines=first.headlines,
            most_looks=most_looks,
            overrides=tuple(pair for pair in first.overrides if pair[0] in known),  # others are of other agents
        )
        found.append(dataclasses.replace(part, protocol=dataclasses.replace(part.protocol, overrides=first.overrides)))
    return found
