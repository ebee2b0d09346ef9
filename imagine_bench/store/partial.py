"""A bench that is not finished: the largest complete table of seeds and budgets in it, and what it lacks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from imagine_bench.bench.protocol import Protocol
from imagine_bench.bench.runs import Counters
from imagine_bench.errors import ArtefactError
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, load_bench, read_protocol
from imagine_bench.store.checkpoints import has_checkpoint, load_newest
from imagine_bench.store.files import read_json, reading
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult

_MEANS = ("time/", "loss/", "imagination/")
"""Diagnostics that are means since the test before."""


def load_so_far(folder: Path) -> BenchResult:
    """Read a bench, finished or not.

    Of an unfinished one, the budgets and seeds are taken at which every agent was tested: as many results as possible,
    and no agent has more seeds or episodes than another.

    Raises:
        ArtefactError: It is not a bench, no seed has brought every agent to the first budget, or a file is damaged.
    """
    whole = read_protocol(folder)
    store = BenchStore(folder, whole)
    if not store.missing():
        return load_bench(folder)
    reached = {(agent, seed): _reached(store, agent, seed) for agent in whole.agents for seed in whole.seeds}
    part = largest_part(whole, reached, lambda agent, seed: _load(store.run_folder(agent, seed)), folder)
    if part.missing:
        return part
    last = tuple(f"{agent} seed {seed}: its recording" for agent, seed in store.missing())  # tested, but not at its end
    return dataclasses.replace(part, whole=whole if last else None, missing=last)


def largest_part(
    whole: Protocol,
    reached: Mapping[tuple[str, int], int],
    load: Callable[[str, int], RunResult],
    folder: Path,
    made_with: str = "",
) -> BenchResult:
    """What is complete of a bench: all of it, or the table of seeds and budgets with the most results.

    Args:
        whole: Its protocol.
        reached: The last budget with results of every agent and seed; 0 where there are none.
        load: Reads the run of an agent and seed.
        folder: Where the bench's files lie.
        made_with: See :class:`BenchResult`.

    Raises:
        ArtefactError: No seed has brought every agent to the first budget, or a file is damaged.
    """
    part = _largest_table(whole, reached)
    missing = tuple(
        f"{agent} seed {seed}: {at:,} of {whole.budgets[-1]:,} real episodes"
        for (agent, seed), at in reached.items()
        if at < whole.budgets[-1]
    )
    return BenchResult(
        protocol=part,
        runs=tuple(cut(load(agent, seed), part) for agent in part.agents for seed in part.seeds),
        **bench_facts(folder),
        whole=whole if missing else None,
        missing=missing,
        made_with=made_with,
    )


def _reached(store: BenchStore, agent: str, seed: int) -> int:
    """The last budget of which a run has results; they lie in its newest checkpoint until it is done."""
    folder = store.run_folder(agent, seed)
    return run_folder.reached(folder) if run_folder.is_done(folder) or has_checkpoint(folder / "checkpoints") else 0


def _largest_table(whole: Protocol, reached: Mapping[tuple[str, int], int]) -> Protocol:
    """The protocol that is complete: among all cuts through the budgets, the one that leaves most results."""

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


def _load(folder: Path) -> RunResult:
    return run_folder.load_run(folder) if run_folder.is_done(folder) else _unfinished(folder)


def cut(result: RunResult, part: Protocol) -> RunResult:
    """A run as if it had only the budgets of ``part``; what it imagined at its end is left out if it goes further."""
    kept = _as_if_untested(result.checkpoints, part.budgets)
    episodes, whole = part.budgets[-1], result.checkpoints[-1].episodes == part.budgets[-1]
    return dataclasses.replace(
        result,
        checkpoints=kept,
        training_success=result.training_success[:episodes],
        training_length=result.training_length[:episodes],
        imagined=result.imagined if whole else (),
        sampled_rollouts=result.sampled_rollouts if whole else (),
    )


def _as_if_untested(rows: Sequence[Checkpoint], budgets: Collection[int]) -> tuple[Checkpoint, ...]:
    """The rows at some budgets; what agents said of the time since a test that is left out counts for the next."""
    kept, since, before = list[Checkpoint](), list[Checkpoint](), 0
    for row in rows:
        since.append(row)
        if row.episodes in budgets:
            kept.append(row if len(since) == 1 else _over(since, before))
            since, before = [], row.env_steps
    return tuple(kept)


def _over(rows: Sequence[Checkpoint], before: int) -> Checkpoint:
    """The last of some rows with the mean times a real step of all of them, who began after ``before`` steps.

    Means over losses and over imagined transitions are left out: how many there were of these is not kept.
    """
    last, steps = rows[-1], np.diff([before, *(row.env_steps for row in rows)])
    said = {name: value for name, value in last.diagnostics.items() if not name.startswith(_MEANS)}
    for name in {name for row in rows for name in row.diagnostics if name.startswith("time/")}:
        values = np.array([row.diagnostics.get(name, np.nan) for row in rows])
        if np.isfinite(values).any() and steps.sum() > 0:
            said[name] = float(np.nansum(values * steps) / steps.sum())
    return dataclasses.replace(last, diagnostics=said)


def _unfinished(folder: Path) -> RunResult:
    snapshot = load_newest(folder / "checkpoints")
    if snapshot is None:  # it had one a moment ago
        raise ArtefactError(f"{folder} is being begun anew; give the same command again.")
    config = read_json(folder / "config.json", "a run's configuration")
    with reading(folder / "checkpoints", "a run's checkpoint"):
        counters = Counters.of(snapshot)
    with reading(folder / "config.json", "a run's configuration"):
        agent, seed, settings = config["agent"], config["seed"], config["settings"]
    training = counters.training()
    return RunResult(
        agent=agent,
        seed=seed,
        checkpoints=tuple(counters.rows),
        settings=settings,
        training_success=training["success"],
        training_length=training["length"],
        imagined=(),
        folder=folder,
        recording=None,
    )
