"""The comparisons that a bench was made for: its protocol declares them, its runs decide them, or more seeds are run.

A headline is an agent and the agent that it should beat at the last budget. The p-values of the headlines are corrected
for one another alone (Holm); whatever else a report compares is corrected by itself and takes nothing from them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from imagine_bench import registry, statistics
from imagine_bench.errors import InvalidValueError
from imagine_bench.protocols.control import Protocol
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


def until_decided(
    plan: Callable[..., BenchResult], first: Protocol, *, most: int, root: Path
) -> tuple[BenchResult, BenchResult]:
    """Run seeds in stages until every headline is decided, or ``most`` seeds are done.

    Each stage is a bench of its own, so whatever was run before is only read: an interrupted call, made again, goes on
    and ends in the same results. The agents of headlines have all seeds, and from the second stage on they alone are
    run.

    Args:
        plan: Runs a bench with changes to fields of ``first``, or reads it where it is finished.
        first: The protocol of the first stage.
        most: Most seeds an agent.
        root: Folder of all benches.

    Returns:
        The first stage, of all agents, and all stages as one bench of the agents of headlines.

    Raises:
        InvalidValueError: The protocol has no headline, or ``most`` is less than its seeds.
    """
    if not first.headlines:
        raise InvalidValueError(
            "This bench has no headlines, so there is nothing to decide; leave --until-decided out. The preset quick "
            "has two if --agents is left out."
        )
    counts = stages(len(first.seeds), most)
    agents = tuple(dict.fromkeys(agent for pair in first.headlines for agent in reversed(pair)))
    known = frozenset[str]().union(*map(registry.setting_names, agents))
    overrides = tuple(pair for pair in first.overrides if pair[0] in known)  # of the others no run is left
    few = {agent: len(first.seeds_of(agent)) for agent, _ in first.few_seeds if agent not in agents}
    begun = plan(seeds=first.seeds, most_looks=len(counts), few_seeds=few)
    parts: list[BenchResult] = []
    whole = begun
    for before, count in itertools.pairwise(counts):
        if decided(whole):
            break
        seeds = tuple(first.seeds[-1] + 1 + step for step in range(before - counts[0], count - counts[0]))
        changes = {"headlines": first.headlines, "most_looks": len(counts), "overrides": overrides}
        parts.append(plan(agents=agents, seeds=seeds, **changes))
        whole = merge([_of_agents(begun, parts[0].protocol), *parts], root)
    return begun, whole


def _of_agents(result: BenchResult, like: Protocol) -> BenchResult:
    """A bench with the agents of another protocol alone, which have the same settings there."""
    of_agents = {name: getattr(like, name) for name in ("agents", "settings_digest", "few_seeds", "overrides")}
    part = dataclasses.replace(result.protocol, **of_agents)
    runs = tuple(run for run in result.runs if run.agent in part.agents)
    return dataclasses.replace(result, protocol=part, runs=runs)
