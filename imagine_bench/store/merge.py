"""Several benches as one, each measured by its own command: other agents on the same test, or other seeds of the same.

The latter is how a bench is shared out among machines that have no disk in common.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imagine_bench.bench.protocol import Protocol, digest
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.store.archive import is_archive, load_archive
from imagine_bench.store.bench_folder import read_protocol
from imagine_bench.store.partial import cut, load_so_far
from imagine_bench.store.results import BenchResult

_OWN = ("agents", "seeds", "budgets", "settings_digest", "encoder", "codes")
"""Fields in which such benches may differ; their encoders must agree where both have one."""


def load_merged(folders: Sequence[Path], root: Path) -> BenchResult:
    """Read several benches, finished or not or in the form they are kept in, that differ only in agents or in seeds.

    Of benches of different agents, seeds are those that all of them have; of benches of the same agents, those that
    any has. Budgets are those of all.

    Args:
        folders: Theirs.
        root: Folder of all benches; the result's own is a new one in it, named by what was compared.

    Raises:
        InvalidValueError: They differ in more, an agent's seed is in two of them, or no seed or budget is in all.
        ArtefactError: One is no bench of control, has nothing to show, or is damaged.
    """
    for folder in folders:
        if not isinstance(read_protocol(folder), Protocol):
            raise ArtefactError(f"{folder} is no bench of agents; only those can be shown together.")
    results = [load_archive(folder) if is_archive(folder) else load_so_far(folder) for folder in folders]
    protocol = _joined([result.protocol for result in results], folders)
    return BenchResult(
        protocol=protocol,
        runs=tuple(cut(run, protocol) for result in results for run in result.runs if run.seed in protocol.seeds),
        environment=_environment(results),
        folder=root / protocol.task / f"together-{protocol.hash}",
        wall_s=sum(result.wall_s for result in results),
        missing=tuple(sentence for result in results for sentence in result.missing),
    )


def _joined(protocols: Sequence[Protocol], folders: Sequence[Path]) -> Protocol:
    first, same = protocols[0], len({frozenset(protocol.agents) for protocol in protocols}) == 1
    agents = first.agents if same else _all([protocol.agents for protocol in protocols], "an agent")
    digests = [protocol.settings_digest for protocol in protocols]  # empty, so unknown, in the oldest ones
    seeds = [protocol.seeds for protocol in protocols]
    for protocol, folder in zip(protocols, folders, strict=True):
        for field in dataclasses.fields(Protocol):
            ours, theirs = getattr(first, field.name), getattr(protocol, field.name)
            if field.name not in _OWN and ours != theirs:
                raise InvalidValueError(
                    f"{folder} has {field.name} {theirs!r} where {folders[0]} has {ours!r}; benches that are shown "
                    "together differ in their agents or in their seeds only."
                )
    return dataclasses.replace(
        first,
        agents=agents,
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


def _all(values: Sequence[tuple[Any, ...]], name: str) -> tuple[Any, ...]:
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


def _environment(results: Sequence[BenchResult]) -> dict[str, Any]:
    benches = {f"bench {number}": dict(result.environment) for number, result in enumerate(results, start=1)}
    return {
        "command": "; ".join(str(result.environment.get("command", "")) for result in results),
        **benches,
    }
