"""Runs of a regression bench, and their results: each is one regressor, one seed, its networks on every variant.

The result of a variant is written when it is measured, so a run that was killed and started again does only the variant
anew at which it was, and ends in the same bits as one that was not; only CPU times differ.

Networks that say how sure they are, are asked on points that they have never seen whether they are right about that
(Gneiting & Raftery, "Strictly proper scoring rules, prediction, and estimation", 2007).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Bools, Floats, read_only
from imagine_bench.interfaces.regression import (
    Mixtures,
    Prediction,
    RegressionData,
    RegressionSpec,
    Regressor,
    RegressorContext,
)
from imagine_bench.protocols.data import OnProgress, Phase, Progress, RunSpec, TaskType
from imagine_bench.regression.protocol import PRESETS, RegressionProtocol, plan
from imagine_bench.seeding import SeedTree
from imagine_bench.statistics import auroc
from imagine_bench.store import run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, read_protocol_as
from imagine_bench.store.files import read_arrays, reading, table_rows, table_text, write_arrays, write_bytes
from imagine_bench.store.results import AllRuns, OneRun
from imagine_bench.values import grouped, numbers, pack

LEVELS = (0.5, 0.8, 0.95)
"""Probabilities of the central intervals whose coverage is reported."""
METRICS = "metrics.csv"
EVALUATION = "evaluation.npz"
Row = dict[str, float | str]
"""One network of one variant: ``variant``, ``network``, and every measure by name."""


@dataclass(frozen=True, kw_only=True)
class RegressionRun(OneRun):
    """One finished run of a regressor."""

    rows: Sequence[Row]  #: one a variant and network
    evaluations: Mapping[str, Arrays]  #: the task's own measurements by variant


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
        return {
            (agent, variant): PairResult(agent, variant, self.of(agent))
            for agent in self.protocol.agents
            for variant in self.protocol.variants
        }


def _begun(folder: Path) -> tuple[list[Row], dict[str, Arrays]]:
    """The rows and measurements of the variants that a run has done, in their order."""
    if not (folder / EVALUATION).exists():
        return [], {}
    evaluations = grouped(read_arrays(folder / EVALUATION))
    with reading(folder / METRICS, "the table of a run of a regressor"):
        rows: list[Row] = table_rows((folder / METRICS).read_text(), texts=("variant",))
        return [row for row in rows if row["variant"] in evaluations], evaluations


def load_run(folder: Path) -> RegressionRun:
    """Read a finished run.

    Raises:
        ArtefactError: It is unfinished, damaged or made by something else; the message names the file.
    """
    config = run_folder.require_done(folder)
    recording = run_folder.recording_path(folder)
    rows, evaluations = _begun(folder)
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


def run(spec: RunSpec[RegressionProtocol], folder: Path, on_progress: OnProgress) -> RegressionRun:
    """Do a run, or finish one that was begun, and load its result. A finished run is only loaded.

    Raises:
        BusyError: Another process is at this run.
        ArtefactError: The folder holds something damaged, foreign or begun with other settings.
        DivergedError: A likelihood is no longer finite.
        SetupError: The folder cannot be written.
    """
    with run_folder.unfinished(folder) as left:
        if left:
            _go_on(spec, folder, on_progress)
    return load_run(folder)


def _go_on(spec: RunSpec[RegressionProtocol], folder: Path, on_progress: OnProgress) -> None:
    protocol = spec.protocol
    task = registry.regression(protocol.task)
    rows, evaluations = _begun(folder)

    def tell(phase: Phase, detail: str, share: float = 0.0) -> None:
        """Tell how far the run is: ``share`` counts within the running variant."""
        done = int(spec.work * (len(evaluations) + share) / len(protocol.variants))
        progress = Progress(
            agent=spec.agent,
            seed=spec.seed,
            bench=protocol.hash,
            phase=phase,
            done=done,
            work=spec.work,
            detail=detail,
        )
        on_progress(progress)

    for variant in protocol.variants[len(evaluations) :]:
        measured, arrays = _learn(spec, folder, variant, tell)
        rows += measured
        evaluations[variant] = arrays
        write_bytes(folder / METRICS, table_text(rows).encode())  # first: the arrays say which variants are done
        write_arrays(folder / EVALUATION, pack(evaluations)[1])
    if task.recorder is not None and protocol.recorded:
        tell("recording", "recording")
        path = run_folder.recording_path(folder)
        registry.load(task.recorder)(evaluations, task=task, name=spec.agent, path=path)
    run_folder.mark_done(folder, ["config.json", METRICS, EVALUATION])
    tell("done", "done")


def _learn(
    spec: RunSpec[RegressionProtocol], folder: Path, variant: str, tell: Callable[[Phase, str, float], None]
) -> tuple[list[Row], Arrays]:
    """Train a regressor on a variant and measure it: a row a network, and the task's own arrays."""
    protocol = spec.protocol
    task = registry.regression(protocol.task)
    seeds = SeedTree(spec.seed)
    networks = tuple(seeds.child("network", index) for index in range(protocol.networks))
    # the task's own measurements draw the same data again, from the same node
    context = RegressorContext(
        datasets=tuple(task.training(variant, node.child("data").generator()) for node in networks),
        seeds=tuple(node.child("regressor", variant) for node in networks),
        hyperparameters=protocol.hyperparameters,
        overrides=protocol.overrides_of(spec.agent),
        device=protocol.device,
    )
    regressor = registry.make_regressor(spec.agent, context)
    run_folder.check_config(folder, spec, regressor)

    def on_epoch(done: int, epochs: int) -> None:
        if done % max(1, epochs // 100) == 0:
            tell("training", f"{variant}, epoch {done} of {epochs}", 0.9 * done / epochs)

    def predict(inputs: Floats, name: str) -> Prediction:
        return regressor.predict(read_only(inputs), seeds.child("predict", variant, name).generator())

    begun_s = time.process_time()
    # of all networks together; the CPU seconds are a network's share
    shared: Row = {**numbers(regressor.train(on_epoch))}
    trained_s = time.process_time()
    tell("testing", f"{variant}, measuring", 0.9)
    tests = [task.testing(variant, node.child("test", variant).generator(), protocol.test_points) for node in networks]
    measured = calibrate(task, variant, tests, regressor, seeds.child("calibration", variant).generator())
    arrays = task.evaluate(variant, predict, networks)
    shared["train_cpu_s"] = (trained_s - begun_s) / protocol.networks
    shared["measure_cpu_s"] = (time.process_time() - trained_s) / protocol.networks
    rows: list[Row] = []
    for index in range(protocol.networks):
        own = {name: float(values[index]) for name, values in measured.items()}
        rows.append({"variant": variant, "network": index, **own, **shared})
    return rows, arrays


def calibrate(
    task: RegressionSpec, variant: str, tests: list[RegressionData], regressor: Regressor, rng: np.random.Generator
) -> dict[str, Floats]:
    """Measure every network on unseen points of its own.

    The predictive distribution that is judged is the one from which the regressor samples its predictions.

    Args:
        task: Says how wrong a prediction is.
        variant: Of the task.
        tests: The points of each network, E times N rows.
        regressor: E networks, trained on ``variant``.
        rng: Samples the predictions.

    Returns:
        Measures of every network, (E,), by name.
    """
    inputs = np.stack([test.inputs for test in tests])
    targets = np.stack([test.targets for test in tests])
    prediction = regressor.predict(read_only(inputs), rng)
    error = np.stack([task.errors(variant, *pair) for pair in zip(inputs, prediction.prediction, strict=True)])
    wrong = error > task.wrong_above
    measured = {
        "error_mean": error.mean(axis=1),
        "error_median": np.median(error, axis=1),
        "wrong": wrong.mean(axis=1),
        "log_score": log_score(prediction, targets).mean(axis=1),
        **{f"coverage_{level:g}": coverage(prediction, targets, level).mean(axis=(1, 2)) for level in LEVELS},
    }
    for name, values in prediction.scores.items():
        measured[f"auroc_{name}"] = np.array([auroc(*pair) for pair in zip(values, wrong, strict=True)])
    return measured


def coverage(mixtures: Mixtures, outcomes: Floats, level: float) -> Bools:
    """Whether each of the outcomes (..., D) lies inside its central predictive interval of probability ``level``."""
    of_each = scipy.stats.norm.cdf(outcomes[..., None, :], mixtures.means, mixtures.sigmas)  # [..., K, D]
    below = (mixtures.weights[..., None] * of_each).sum(axis=-2)
    return np.abs(below - 0.5) <= 0.5 * level


def log_score(mixtures: Mixtures, outcomes: Floats) -> Floats:
    """Negative log density of the whole outcome, all dimensions together, in nats. Outcomes (..., D), result (...)."""
    of_each = scipy.stats.norm.logpdf(outcomes[..., None, :], mixtures.means, mixtures.sigmas)  # [..., K, D]
    return np.asarray(-scipy.special.logsumexp(of_each.sum(axis=-1), axis=-1, b=mixtures.weights))


REGRESSION = TaskType(
    tasks=registry.regressions,
    learners=registry.regressors,
    draws=False,
    protocol=RegressionProtocol,
    presets=PRESETS,
    plan=plan,
    run=run,
    load_so_far=load_result,
)
"""Regression tasks, which are learned from data, as a type of task."""
