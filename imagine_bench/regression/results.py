"""What a regression bench measured: written by its runner, read by its report and recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Floats
from imagine_bench.regression.protocol import RegressionProtocol
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_protocol_as
from imagine_bench.store.files import grouped, read_arrays, table_rows, table_text, write_arrays, write_bytes
from imagine_bench.store.results import require_every_run
from imagine_bench.values import Setting

METRICS = "metrics.csv"
EVALUATION = "evaluation.npz"
Row = dict[str, float | str]
"""One network of one variant: ``variant``, ``network``, and every measure by name."""


@dataclass(frozen=True, kw_only=True)
class RegressionRun:
    """One finished run of a registered regressor."""

    agent: str
    seed: int
    settings: Mapping[str, Setting]
    rows: tuple[Row, ...]  #: one a variant and network
    #: The task's own measurements by variant, and under ``calibration/`` those of calibration.
    evaluations: Mapping[str, Arrays]
    folder: Path  #: where the run's files lie
    recording: Path | None  #: its Rerun recording, or None


@dataclass(frozen=True)
class PairResult:
    """All networks of one regressor on one variant, those of the first seed first."""

    agent: str
    variant: str
    runs: tuple[RegressionRun, ...]  #: in the order of the protocol's seeds

    @property
    def label(self) -> str:
        """Title of the regressor, and the variant."""
        return f"{registry.regressor_entry(self.agent).title}, {self.variant}"

    def values(self, name: str) -> Floats:
        """One measure of every network. Shape (seeds E,)."""
        rows = [row for run in self.runs for row in run.rows]
        return np.array([float(row[name]) for row in rows if row["variant"] == self.variant])

    def mean(self, name: str) -> float:
        """Mean of one measure over the networks of which it is a number; not a number where it is one of none."""
        values = self.values(name)
        known = values[np.isfinite(values)]
        return float(known.mean()) if known.size else np.nan

    def arrays(self, name: str) -> Floats:
        """A measurement of the task whose first axis is the network. Shape (seeds E, ...)."""
        return np.concatenate([run.evaluations[self.variant][name] for run in self.runs])

    @property
    def first(self) -> Arrays:
        """Everything measured in the run of the first seed."""
        return self.runs[0].evaluations[self.variant]


@dataclass(frozen=True, kw_only=True)
class RegressionResult:
    """All runs of a protocol.

    Raises:
        ArtefactError: A run is missing or doubled, or two runs of a regressor had different settings.
    """

    protocol: RegressionProtocol
    runs: tuple[RegressionRun, ...]
    environment: Mapping[str, Any]  #: command, commit, versions, machine; JSON-like
    folder: Path  #: where the bench's files lie
    wall_s: float  #: wall seconds of the bench, over all its sessions
    missing: tuple[str, ...] = ()  #: sentences about runs that a part lacks; a regression bench is whole

    def __post_init__(self) -> None:
        runs = [(run.agent, run.seed, run.folder, run.settings) for run in self.runs]
        require_every_run(self.folder, self.protocol, runs)

    @property
    def protocol_hash(self) -> str:
        """The hash of the protocol, which names the bench's folder."""
        return self.protocol.hash

    @property
    def titles(self) -> dict[str, str]:
        """The names of the regressors for people."""
        return {agent: registry.regressor_entry(agent).title for agent in self.protocol.agents}

    def of(self, agent: str) -> tuple[RegressionRun, ...]:
        """The runs of one regressor, in the order of the protocol's seeds."""
        by_seed = {run.seed: run for run in self.runs if run.agent == agent}
        return tuple(by_seed[seed] for seed in self.protocol.seeds)

    def by_variant(self, agent: str) -> dict[str, PairResult]:
        """The networks of one regressor, by the variant that they learned from."""
        return {variant: PairResult(agent, variant, self.of(agent)) for variant in self.protocol.variants}

    @property
    def pairs(self) -> list[PairResult]:
        """Every regressor on every variant."""
        return [pair for agent in self.protocol.agents for pair in self.by_variant(agent).values()]


def write_rows(folder: Path, rows: Sequence[Row]) -> None:
    """Write one row a variant and network, atomically."""
    write_bytes(folder / METRICS, table_text(rows).encode())


def finish(folder: Path, rows: Sequence[Row], evaluations: Mapping[str, Arrays]) -> None:
    """Write the results of a run and mark it as done."""
    write_rows(folder, rows)
    write_arrays(folder / EVALUATION, flattened(evaluations))
    run_folder.mark_done(folder, ["config.json", METRICS, EVALUATION])


def flattened(evaluations: Mapping[str, Arrays]) -> Arrays:
    """Arrays by ``variant/name``, those of a variant sorted, for a checkpoint gives them back in any order."""
    return {f"{variant}/{name}": arrays[name] for variant, arrays in evaluations.items() for name in sorted(arrays)}


def load_run(folder: Path) -> RegressionRun:
    """Read a finished run.

    Raises:
        ArtefactError: It is unfinished, damaged or made by something else; the message names the file.
    """
    config = run_folder.require_done(folder)
    recording = run_folder.recording_path(folder)
    return RegressionRun(
        agent=config["agent"],
        seed=config["seed"],
        settings=config["settings"],
        rows=tuple(table_rows((folder / METRICS).read_text(), texts=("variant",))),
        evaluations=grouped(read_arrays(folder / EVALUATION)),
        folder=folder,
        recording=recording if recording.is_file() else None,
    )


def load_result(folder: Path) -> RegressionResult:
    """Read a finished bench of regressors.

    Raises:
        ArtefactError: It is no bench of regressors, a run is missing, or a file is damaged.
    """
    protocol = read_protocol_as(folder, RegressionProtocol)
    found = BenchStore(folder, protocol).load(lambda run: load_run(run) if run_folder.is_done(run) else None)
    runs = tuple(run for run in found.values() if run is not None)
    return RegressionResult(protocol=protocol, runs=runs, **bench_facts(folder))
