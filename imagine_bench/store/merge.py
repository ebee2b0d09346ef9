"""Several runs as one table: of an unfinished bench the largest complete one, and several benches as one.

Benches that are merged were each measured by its own command: other agents on the same test, or other seeds of the
same. The latter is how a bench is shared out among machines that have no disk in common.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import digest
from imagine_bench.registry.entries import file_name
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_control
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult

Value = TypeVar("Value", int, str)
_MEANS = ("time/", "loss/", "imagination/")
"""Diagnostics that are means since the test before."""
_OWN = ("agents", "seeds", "budgets", "settings_digest", "encoder", "codes", "agent_names")
"""Fields in which such benches may differ; their encoders must agree where both have one."""


def load_so_far(folder: Path) -> BenchResult:
    """Read a bench of agents, finished or not.

    Of an unfinished one, the budgets and seeds are taken at which every agent was tested: as many results as possible,
    and no agent has more seeds or episodes than another. Agents without any result are left out where all others are
    finished.

    Raises:
        ArtefactError: It is not a bench, no seed has brought every agent to the first budget, or a file is damaged.
    """
    whole = read_control(folder)
    store = BenchStore(folder, whole)
    part = largest_part(whole, store.load(run_folder.load_so_far), folder)
    if part.missing:
        return part
    last = tuple(f"{agent} seed {seed}: its recording" for agent, seed in store.missing())  # tested, but not at its end
    return dataclasses.replace(part, whole=whole if last else None, missing=last)


def largest_part(
    whole: Protocol, runs: Mapping[tuple[str, int], RunResult | None], folder: Path, made_with: str = ""
) -> BenchResult:
    """Return what is complete of a bench: all of it, or the table of seeds and budgets with the most results.

    ``runs`` has every agent and seed, None where there is nothing yet.

    Raises:
        ArtefactError: No seed has brought every agent to the first budget, or a file is damaged.
    """
    pairs = [(agent, seed) for agent in whole.agents for seed in whole.seeds]
    reached = {pair: _reached(runs.get(pair)) for pair in pairs}
    part = _largest_table(_without_failed(whole, reached), reached)
    found = [runs.get((agent, seed)) for agent in part.agents for seed in part.seeds]
    missing = tuple(
        f"{agent} seed {seed}: {at:,} of {whole.budgets[-1]:,} real episodes"
        for (agent, seed), at in reached.items()
        if at < whole.budgets[-1]
    )
    return BenchResult(
        protocol=part,
        runs=tuple(cut(run, part) for run in found if run is not None),
        **bench_facts(folder),
        whole=whole if missing else None,
        missing=missing,
        made_with=made_with,
    )


def _reached(run: RunResult | None) -> int:
    """Return the last budget at which a run was tested, 0 before the first."""
    return run.checkpoints[-1].episodes if run is not None and run.checkpoints else 0


def _without_failed(whole: Protocol, reached: Mapping[tuple[str, int], int]) -> Protocol:
    """Leave out agents without any result where all others are finished."""
    tried = [agent for agent in whole.agents if any(reached[agent, seed] for seed in whole.seeds)]
    finished = all(reached[agent, seed] == whole.budgets[-1] for agent in tried for seed in whole.seeds)
    return dataclasses.replace(whole, agents=tuple(tried)) if tried and finished else whole


def _largest_table(whole: Protocol, reached: Mapping[tuple[str, int], int]) -> Protocol:
    """Return the complete protocol that has most results, among all cuts through the budgets."""

    def seeds_at(budget: int) -> tuple[int, ...]:
        return tuple(seed for seed in whole.seeds if all(reached[agent, seed] >= budget for agent in whole.agents))

    budgets = whole.budgets
    count = max(range(1, len(budgets) + 1), key=lambda count: (count * len(seeds_at(budgets[count - 1])), count))
    seeds = seeds_at(budgets[count - 1])
    if not seeds:
        raise ArtefactError(
            f"No seed of this bench has brought every agent to {budgets[0]} real episodes yet, so there is nothing to "
            "compare. Run the same bench command again to go on."
        )
    return dataclasses.replace(whole, seeds=seeds, budgets=budgets[:count])


def cut(result: RunResult, part: Protocol) -> RunResult:
    """Return a run with the budgets of ``part`` alone; what it imagined at its end is left out if it goes further."""
    episodes = part.budgets[-1]
    whole = result.checkpoints[-1].episodes == episodes
    return dataclasses.replace(
        result,
        checkpoints=_at_budgets(result.checkpoints, part.budgets),
        training_success=result.training_success[:episodes],
        training_length=result.training_length[:episodes],
        imagined=result.imagined if whole else (),
        sampled_rollouts=result.sampled_rollouts if whole else (),
    )


def _at_budgets(rows: Sequence[Checkpoint], budgets: Collection[int]) -> tuple[Checkpoint, ...]:
    """Return the rows at some budgets; diagnostics of a test that is left out count for the next one."""
    kept = list[Checkpoint]()
    since = list[Checkpoint]()
    before = 0
    for row in rows:
        since.append(row)
        if row.episodes in budgets:
            kept.append(row if len(since) == 1 else _over(since, before))
            since = []
            before = row.env_steps
    return tuple(kept)


def _over(rows: Sequence[Checkpoint], before: int) -> Checkpoint:
    """Return the last row with the mean times a real step over all of them, who began after ``before`` steps.

    Means over losses and over imagined transitions are left out: how many there were of these is not kept.
    """
    last = rows[-1]
    steps = np.diff([before, *(row.env_steps for row in rows)])
    diagnostics = {name: value for name, value in last.diagnostics.items() if not name.startswith(_MEANS)}
    for name in {name for row in rows for name in row.diagnostics if name.startswith("time/")}:
        values = np.array([row.diagnostics.get(name, np.nan) for row in rows])
        if np.isfinite(values).any() and steps.sum() > 0:
            diagnostics[name] = float(np.nansum(values * steps) / steps.sum())
    return dataclasses.replace(last, diagnostics=diagnostics)


def merge(results: Sequence[BenchResult], root: Path) -> BenchResult:
    """Several benches, or parts of them, that differ only in agents or in seeds, as one in a new folder below ``root``.

    Of benches of different agents, seeds are those that all of them have; of benches of the same agents, those that any
    has. Budgets are those of all.

    Raises:
        InvalidValueError: They differ in more, an agent's seed is in two of them, or no seed or budget is in all.
        ArtefactError: Two runs of an agent had other settings.
    """
    protocol = _merged(results)
    commands = "; ".join(str(result.environment.get("command", "")) for result in results)
    benches = {f"bench {number}": dict(result.environment) for number, result in enumerate(results, start=1)}
    return BenchResult(
        protocol=protocol,
        runs=tuple(cut(run, protocol) for result in results for run in result.runs if run.seed in protocol.seeds),
        environment={"command": commands, **benches},
        folder=root / file_name(protocol.task) / f"merged-{protocol.hash}",
        wall_s=sum(result.wall_s for result in results),
        certificate=next((result.certificate for result in results if result.certificate is not None), None),
        missing=tuple(sentence for result in results for sentence in result.missing),
    )


def _merged(results: Sequence[BenchResult]) -> Protocol:
    """The protocol of all of them together."""
    protocols = [result.protocol for result in results]
    first = protocols[0]
    same = len({frozenset(protocol.agents) for protocol in protocols}) == 1
    for result in results:
        for field in dataclasses.fields(Protocol):
            ours = getattr(first, field.name)
            theirs = getattr(result.protocol, field.name)
            if field.name not in _OWN and ours != theirs:
                raise InvalidValueError(
                    f"{result.folder} has {field.name} {theirs!r} where {results[0].folder} has {ours!r}; benches that "
                    "are merged differ in their agents or in their seeds only."
                )
    digests = [protocol.settings_digest for protocol in protocols]
    seeds = [protocol.seeds for protocol in protocols]
    return dataclasses.replace(
        first,
        agent_names=max(protocol.agent_names for protocol in protocols),
        agents=first.agents if same else _all([protocol.agents for protocol in protocols], "an agent"),
        settings_digest=_one(digests, "are of different settings") or "" if same else digest(digests),
        seeds=tuple(sorted(_all(seeds, "a seed"))) if same else _common(seeds, "seeds"),
        budgets=_common([protocol.budgets for protocol in protocols], "budgets"),
        encoder=_one([protocol.encoder for protocol in protocols], "see through different encoders"),
        codes=_one([protocol.codes for protocol in protocols], "see through different encoders"),
    )


def _one(values: Sequence[str | None], complaint: str) -> str | None:
    found = sorted({value for value in values if value is not None})
    if len(found) > 1:
        raise InvalidValueError(
            f"The benches {complaint} ({', '.join(value or 'unknown' for value in found)}); give those of one."
        )
    return found[0] if found else None


def _all(values: Sequence[tuple[Value, ...]], name: str) -> tuple[Value, ...]:
    found = tuple(value for each in values for value in each)
    twice = sorted({value for value in found if found.count(value) > 1})
    if twice:
        raise InvalidValueError(
            f"The benches have {name} in common ({', '.join(map(str, twice))}). Give benches of different agents, or "
            "of different seeds of the same agents."
        )
    return found


def _common(values: Sequence[tuple[int, ...]], name: str) -> tuple[int, ...]:
    kept = tuple(value for value in values[0] if all(value in other for other in values))
    if not kept:
        raise InvalidValueError(f"The benches have no {name} in common: {values}.")
    return kept
