"""A bench as one table of results: as far as it has come, as it is kept for good, or several benches as one.

A bench is kept for good in two files, ``bench.json`` and ``results.csv`` (docs/reference/formats.md). Every success
rate, length and cost is in them; images, imaginations and checkpoints are not. A report writes both, so a bench is kept
by copying them.

Benches that are merged were each measured by its own command: other agents on the same test, or other seeds of the
same. The latter is how a bench is shared out among machines that have no disk in common.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

from imagine_bench import registry, statistics
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import digest
from imagine_bench.registry.entries import agent_label, file_name
from imagine_bench.seeding import seeds_text
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import KEPT, BenchStore, bench_facts, is_archive, read_control
from imagine_bench.store.files import json_text, reading, table_rows, table_text
from imagine_bench.store.results import BenchResult, Checkpoint, RunResult
from imagine_bench.values import unpack

Runs = Mapping[tuple[str, int], RunResult | None]
"""Runs by agent and seed, None where there is nothing yet."""
_RESULTS = "results.csv"
_COLUMNS = (
    "agent",
    "seed",
    "episodes",
    "env_steps",
    "test_episodes",
    "successes",
    # these three are for a reader's comfort: they are computed anew from the counts
    "success_rate",
    "wilson_low",
    "wilson_high",
    "mean_return",
    "mean_length",
    "faults",
    "train_cpu_s",
    "eval_cpu_s",
    "solved",
)
"""Columns of every table of results; those of diagnostics follow."""
_APART = "diagnostics/"
"""Before the name of a diagnostic that is also that of another column, or begins so."""
_OWN = ("agents", "seeds", "budgets", "agent_names", "code", "evaluation_episodes", "few_seeds", "headlines")
"""Fields in which merged benches may differ; their encoders must agree where both have one."""


def load_so_far(folder: Path) -> BenchResult:
    """Read a bench of agents, finished or not, or one that is kept for good.

    Of an unfinished one, the budgets and seeds are taken at which every agent was tested: as many results as possible,
    and no agent has more seeds or episodes than another. Agents without any result are left out where all others are
    finished.

    Raises:
        ArtefactError: It is no bench of agents, no seed has brought every agent to the first budget, or a file is
            damaged.
    """
    whole = read_control(folder)
    if is_archive(folder):
        return _largest_part(whole, _kept_runs(folder, whole), folder)
    store = BenchStore(folder, whole)
    part = _largest_part(whole, store.load(run_folder.load_so_far), folder)
    if part.missing:
        return part
    last = tuple(f"{agent} seed {seed}: its recording" for agent, seed in store.missing())  # tested, but not at its end
    return dataclasses.replace(part, whole=whole if last else None, missing=last)


def _kept_runs(folder: Path, whole: Protocol) -> Runs:
    """The runs of a bench that is kept for good, as far as its table goes."""
    rows: dict[tuple[str, int], list[Checkpoint]] = {}
    with reading(folder / _RESULTS, "the table of a bench of agents"):
        for row in table_rows((folder / _RESULTS).read_text(), ("agent", "solved")):
            diagnostics = {_name_of(name): float(value) for name, value in row.items() if name not in _COLUMNS}
            agent = agent_label(row["agent"], {"agent_names": whole.agent_names})
            checkpoint = unpack(Checkpoint, {**row, "diagnostics": diagnostics}, {})
            rows.setdefault((agent, row["seed"]), []).append(checkpoint)
    return {
        (agent, seed): RunResult(agent=agent, seed=seed, checkpoints=tuple(found), folder=folder)
        for (agent, seed), found in rows.items()
    }


def archive_files(result: BenchResult) -> dict[str, str]:
    """The two files in which a bench of agents is kept for good, by name."""
    environment = dict(result.environment)
    sessions = environment.pop("sessions", [{"wall_s": result.wall_s}])  # merged benches have their own
    facts = {
        "protocol": (result.whole or result.protocol).as_dict(),
        "protocol_hash": result.protocol_hash,
        "environment": environment,
        "sessions": sessions,
    }
    if result.certificate is not None:
        facts["certificate"] = dataclasses.asdict(result.certificate)
    return {KEPT: json_text(facts), _RESULTS: results_csv(result)}


def results_csv(result: BenchResult) -> str:
    """One row an agent, seed and budget; every diagnostic the agents report has its column."""
    names = sorted({name for _, checkpoint in result.rows for name in checkpoint.diagnostics})
    protocol = result.whole or result.protocol
    rows: list[dict[str, float | str]] = []
    for run, checkpoint in result.rows:
        low, high = statistics.wilson(checkpoint.successes, checkpoint.test_episodes)
        derived = {"success_rate": checkpoint.success_rate, "wilson_low": low, "wilson_high": high}
        known = {**vars(checkpoint), **derived, "agent": protocol.written_name(run.agent), "seed": run.seed}
        known["solved"] = checkpoint.solved or ""
        diagnostics = {_column_of(name): checkpoint.diagnostics.get(name, "") for name in names}
        rows.append({name: known[name] for name in _COLUMNS} | diagnostics)
    return table_text(rows)


def _column_of(diagnostic: str) -> str:
    """The column of a diagnostic, whatever name an agent gave it."""
    return f"{_APART}{diagnostic}" if diagnostic in _COLUMNS or diagnostic.startswith(_APART) else diagnostic


def _name_of(column: str) -> str:
    """The inverse of :func:`_column_of`."""
    return column.removeprefix(_APART)


def _largest_part(whole: Protocol, runs: Runs, folder: Path) -> BenchResult:
    """Return the complete part of a bench: all of it, or the table of seeds and budgets with the most results.

    Raises:
        ArtefactError: No seed has brought every agent to the first budget, or a file is damaged.
    """
    last = whole.budgets[-1]
    reached = _reached(whole, runs)
    tried = tuple(agent for agent in whole.agents if any(reached[agent, seed] for seed in whole.seeds_of(agent)))
    finished = all(reached[agent, seed] == last for agent in tried for seed in whole.seeds_of(agent))
    part = _largest_table(dataclasses.replace(whole, agents=tried) if tried and finished else whole, reached)
    missing = tuple(
        f"{agent} seed {seed}: {at:,} of {last:,} real episodes" for (agent, seed), at in reached.items() if at < last
    )
    return BenchResult(
        protocol=part,
        runs=_runs_of(part, runs),
        **bench_facts(folder),
        whole=whole if missing else None,
        missing=missing,
    )


def _reached(whole: Protocol, runs: Runs) -> dict[tuple[str, int], int]:
    """The last budget at which each run of a protocol was tested, 0 before the first."""
    reached = dict.fromkeys(whole.runs, 0)
    return reached | {pair: run.checkpoints[-1].episodes for pair, run in runs.items() if run and run.checkpoints}


def _largest_table(whole: Protocol, reached: Mapping[tuple[str, int], int]) -> Protocol:
    """Return the complete protocol that has most results, among all cuts through the budgets."""
    tables = []
    for count, budget in enumerate(whole.budgets, start=1):
        short = {seed for agent, seed in whole.runs if reached[agent, seed] < budget}
        seeds = tuple(seed for seed in whole.seeds if seed not in short)
        runs = [len({*seeds} & {*whole.seeds_of(agent)}) for agent in whole.agents]
        if all(runs):
            tables.append((count * sum(runs), count, seeds))
    if not tables:
        raise ArtefactError(
            f"No seed of this bench has brought every agent to {whole.budgets[0]} real episodes yet, so there is "
            "nothing to compare. Run the same bench command again to go on."
        )
    _, count, seeds = max(tables)
    return dataclasses.replace(whole, seeds=seeds, budgets=whole.budgets[:count])


def _runs_of(part: Protocol, runs: Runs) -> tuple[RunResult, ...]:
    """The runs of a protocol, as far as it goes."""
    return tuple(cut(run, part) for pair in part.runs if (run := runs.get(pair)))


def cut(result: RunResult, part: Protocol) -> RunResult:
    """Return a run with the budgets of ``part`` alone, and if it goes further, without the measurements of its end."""
    episodes = part.budgets[-1]
    whole = result.checkpoints[-1].episodes == episodes
    return dataclasses.replace(
        result,
        checkpoints=tuple(row for row in result.checkpoints if row.episodes in part.budgets),
        training_success=result.training_success[:episodes],
        training_length=result.training_length[:episodes],
        imagined=result.imagined if whole else (),
        sampled_rollouts=result.sampled_rollouts if whole else (),
        recorded=result.recorded if whole else (),
    )


def merge(results: Sequence[BenchResult], root: Path) -> BenchResult:
    """Several benches, or parts of them, that differ only in agents or in seeds, as one in a new folder below ``root``.

    Shown are the seeds that every agent has, and the budgets that all benches have; ``left_out`` names the other runs.
    An agent of fewer seeds in one of them needs only its first ones; a person, or another player that is no agent,
    needs one run. Where one bench has fewer tests, the first ones of all count: they begin alike.

    Raises:
        InvalidValueError: They differ in more, an agent's seed is in two of them, or no budget is in all.
        ArtefactError: No seed is in all, two runs of an agent had other settings, or tests are not kept one by one.
    """
    protocol = _merged(results, [result.protocol for result in results])
    runs = {(run.agent, run.seed): _of_first(run, protocol) for result in results for run in result.runs}
    if len(runs) < sum(len(result.runs) for result in results):
        raise InvalidValueError(
            "Several of the benches have the same seed of the same agent; give benches of different agents, or of "
            "different seeds of the same agents."
        )
    try:
        part = _largest_table(protocol, _reached(protocol, runs))
    except ArtefactError as error:
        seeds = {agent: seeds_text(sorted(seed for other, seed in runs if other == agent)) for agent in protocol.agents}
        raise ArtefactError(
            f"No seed of the benches that are merged has brought every agent to {protocol.budgets[0]} real episodes: "
            f"{'; '.join(f'{agent} has {its}' for agent, its in seeds.items())}. Run the seeds that an agent lacks, or "
            "leave its bench out."
        ) from error
    commands = "; ".join(str(result.environment.get("command", "")) for result in results)
    benches = {f"bench {number}": dict(result.environment) for number, result in enumerate(results, start=1)}
    missing = tuple(sentence for result in results for sentence in result.missing)
    return BenchResult(
        protocol=part,
        runs=_runs_of(part, runs),
        environment={"command": commands, **benches},
        folder=root / file_name(part.task) / f"merged-{part.hash}",
        wall_s=sum(result.wall_s for result in results),
        certificate=next((result.certificate for result in results if result.certificate is not None), None),
        whole=_merged(results, [result.whole or result.protocol for result in results]) if missing else None,
        missing=missing,
        left_out=tuple(f"{agent} seed {seed}" for agent, seed in sorted(runs.keys() - {*part.runs})),
    )


def _of_first(run: RunResult, protocol: Protocol) -> RunResult:
    """A run with as many tests as a protocol has."""
    tests = protocol.evaluation_episodes
    rows = (row if row.test_episodes == tests else row.of_first(tests) for row in run.checkpoints)
    return dataclasses.replace(run, checkpoints=tuple(rows))


def _merged(results: Sequence[BenchResult], protocols: Sequence[Protocol]) -> Protocol:
    """The protocol of all agents and seeds of these benches, of each its protocol or that of its whole."""
    encoder = next((protocol.encoder for protocol in protocols if protocol.encoder), None)
    codes = next((protocol.codes for protocol in protocols if protocol.codes), None)
    protocols = [
        dataclasses.replace(each, encoder=each.encoder or encoder, codes=each.codes or codes) for each in protocols
    ]
    first = protocols[0]
    same_agents = len({frozenset(protocol.agents) for protocol in protocols}) == 1
    may_differ = _OWN if same_agents else (*_OWN, "settings_digest")
    for result, protocol in zip(results, protocols, strict=True):
        for name, value in vars(protocol).items():
            if name not in may_differ and value != getattr(first, name):
                raise InvalidValueError(
                    f"{result.folder} has {name} {value!r} where {results[0].folder} has {getattr(first, name)!r}; "
                    "benches that are merged differ in their agents or in their seeds only."
                )
    digests = [protocol.settings_digest for protocol in protocols]
    code = sorted({pair for protocol in protocols for pair in protocol.code})
    if len(dict(code)) < len(code):
        raise InvalidValueError("An agent's code was another one in each of the benches; they cannot be merged.")
    budgets = set.intersection(*(set(protocol.budgets) for protocol in protocols))
    if not budgets:
        each = "; ".join(
            f"{result.folder} {protocol.budgets}" for result, protocol in zip(results, protocols, strict=True)
        )
        raise InvalidValueError(f"No budget is in all of the benches that are merged: {each}.")
    return dataclasses.replace(
        first,
        agent_names=max(protocol.agent_names for protocol in protocols),
        agents=tuple(dict.fromkeys(agent for protocol in protocols for agent in protocol.agents)),
        code=tuple(code),
        settings_digest=first.settings_digest if same_agents else digest(digests),
        seeds=tuple(sorted({seed for protocol in protocols for seed in protocol.seeds})),
        budgets=tuple(sorted(budgets)),
        evaluation_episodes=min(protocol.evaluation_episodes for protocol in protocols),
        headlines=tuple(dict.fromkeys(pair for protocol in protocols for pair in protocol.headlines)),
        few_seeds=_few_seeds(protocols),
    )


def _few_seeds(protocols: Sequence[Protocol]) -> tuple[tuple[str, int], ...]:
    """The agents of few seeds, players among them, each with the last of the first seeds that it has without a gap."""
    seeds = sorted({seed for protocol in protocols for seed in protocol.seeds})
    found: dict[str, int] = {}
    few = dict.fromkeys(agent for protocol in protocols for agent, _ in protocol.few_seeds)
    players = (agent for protocol in protocols for agent in protocol.agents if registry.is_player(agent))
    for agent in dict.fromkeys((*few, *players)):
        its = {seed for protocol in protocols if agent in protocol.agents for seed in protocol.seeds_of(agent)}
        found[agent] = max(itertools.takewhile(its.__contains__, seeds), default=max(its))
    return tuple((agent, last) for agent, last in found.items() if last < seeds[-1])
