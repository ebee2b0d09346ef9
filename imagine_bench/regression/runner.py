"""One run of a regression bench: one regressor, one seed, its networks on every variant, measured.

What a variant gave is written when it is measured, so a run that was killed and started again does only the variant
anew at which it was, and ends in the same bits as one that was not; only CPU times differ.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import Prediction, RegressorContext
from imagine_bench.protocols.data import OnProgress, Phase, Progress, RunSpec, TaskType
from imagine_bench.regression.calibration import calibrate
from imagine_bench.regression.protocol import PRESETS, RegressionProtocol, plan
from imagine_bench.regression.results import (
    EVALUATION,
    METRICS,
    RegressionRun,
    Row,
    begun,
    load_result,
    load_run,
    write,
)
from imagine_bench.seeding import SeedTree
from imagine_bench.store import run_folder


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
    rows, evaluations = begun(folder)

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
        write(folder, rows, evaluations)
    recorder = task.recorder or next(iter(spec.observers), None)
    if recorder is not None and protocol.recorded:
        tell("recording", "recording")
        path = run_folder.recording_path(folder)
        registry.load(recorder)(evaluations, task=task, name=spec.agent, path=path)
    run_folder.mark_done(folder, ["config.json", METRICS, EVALUATION])
    tell("done", "done")


def _learn(
    spec: RunSpec[RegressionProtocol], folder: Path, variant: str, tell: Callable[[Phase, str, float], None]
) -> tuple[list[Row], Arrays]:
    """Train a regressor on a variant and measure it: a row a network, and arrays, calibration's below their name."""
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
        return regressor.predict(inputs, seeds.child("predict", variant, name).generator())

    begun_s = time.process_time()
    shared: Row = {**regressor.train(on_epoch)}  # of all networks together; the CPU seconds are a network's share
    trained_s = time.process_time()
    tell("testing", f"{variant}, measuring", 0.9)
    rng = seeds.child("calibration", variant).generator()
    rows, arrays = calibrate(task, regressor, variant, networks, points=protocol.test_points, rng=rng)
    arrays |= task.evaluate(variant, predict, networks)
    shared["train_cpu_s"] = (trained_s - begun_s) / protocol.networks
    shared["measure_cpu_s"] = (time.process_time() - trained_s) / protocol.networks
    return [{"variant": variant, "network": index, **row, **shared} for index, row in enumerate(rows)], arrays


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
