"""What a regression bench measured: written by its runner, read by its report and recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Floats
from imagine_bench.regression.protocol import RegressionProtocol
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_protocol_as
from imagine_bench.store.files import grouped, read_arrays, table_rows, table_text, write_arrays, write_bytes
from imagine_bench.store.results import AllRuns, OneRun

METRICS = "metrics.csv"
EVALUATION = "evaluation.npz"
Row = dict[str, float | str]
"""One network of one variant: ``variant``, ``network``, and every measure by name."""


@dataclass(frozen=True, kw_only=True)
class RegressionRun(OneRun):
    """One finished run of a regressor."""

    rows: Sequence[Row]  #: one a variant and network
    #: The task's own measurements by variant, and under ``calibration/`` those of calibration.
    evaluations: Mapping[str, Arrays]


@dataclass(frozen=True)
class PairResult:
    """All networks of one regressor on one variant, those of the first seed first."""

    agent: str
    variant: str
    runs: tuple[RegressionRun, ...]  #: in the order of the protocol's seeds

    @property
    def title(self) -> str:
        """Name of the regressor for people."""
        return registry.regressor_entry(self.agent).title

    @property
    def label(self) -> str:
        """Title of the regressor, and the variant."""
        return f"{self.title}, {self.variant}"

    def values(self, name: str) -> Floats:
        """One measure of every network. Shape (seeds E,)."""
        rows = [row for run in self.runs for row in run.rows]
        return np.array([float(row[name]) for row in rows if row["variant"] == self.variant])

    def arrays(self, name: str) -> Floats:
        """A measurement of the task whose first axis is the network. Shape (seeds E, ...)."""
        return np.concatenate([run.evaluations[self.variant][name] for run in self.runs])

    @property
    def first(self) -> Arrays:
        """Everything measured in the run of the first seed."""
        return self.runs[0].evaluations[self.variant]


class RegressionResult(AllRuns[RegressionProtocol, RegressionRun]):
    """All runs of a bench of regressors."""

    @property
    def pairs(self) -> dict[tuple[str, str], PairResult]:
        """Every regressor on every variant, by both."""
        keys = [(agent, variant) for agent in self.protocol.agents for variant in self.protocol.variants]
        return {(agent, variant): PairResult(agent, variant, self.of(agent)) for agent, variant in keys}


def write(folder: Path, rows: Sequence[Row], evaluations: Mapping[str, Arrays]) -> None:
    """Write what a run has measured so far; :func:`begun` reads it, and the rows are on disk first."""
    write_bytes(folder / METRICS, table_text(rows).encode())
    named = {f"{variant}/{name}": arrays[name] for variant, arrays in evaluations.items() for name in arrays}
    write_arrays(folder / EVALUATION, named)


def begun(folder: Path) -> tuple[list[Row], dict[str, Arrays]]:
    """The rows and measurements of the variants that a run has done, in their order."""
    if not (folder / EVALUATION).exists():
        return [], {}
    evaluations = grouped(read_arrays(folder / EVALUATION))
    rows: list[Row] = table_rows((folder / METRICS).read_text(), texts=("variant",))
    return [row for row in rows if row["variant"] in evaluations], evaluations


def load_run(folder: Path) -> RegressionRun:
    """Read a finished run.

    Raises:
        ArtefactError: It is unfinished, damaged or made by something else; the message names the file.
    """
    config = run_folder.require_done(folder)
    recording = run_folder.recording_path(folder)
    rows, evaluations = begun(folder)
    return RegressionRun(
        agent=config["agent"],
        seed=config["seed"],
        settings=config["settings"],
        rows=rows,
        evaluations=evaluations,
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
