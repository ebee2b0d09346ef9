"""One run of a regression bench: one regressor, one seed, its networks on every variant, measured.

Whatever is needed to go on is in the newest checkpoint, so a run that was killed and started again ends in the same
bits as one that was not; only CPU times differ.
"""

from __future__ import annotations

import time
from pathlib import Path

from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.errors import DivergedError
from imagine_bench.interfaces import Floats
from imagine_bench.interfaces.regression import Prediction, Regressor, RegressorContext
from imagine_bench.protocols.runs import OnProgress, Phase, Progress, RunSpec
from imagine_bench.regression.calibration import calibrate
from imagine_bench.regression.protocol import RegressionProtocol, overrides_of
from imagine_bench.regression.results import RegressionRun, Row, finish, flattened, load_run, write_rows
from imagine_bench.seeding import SeedTree
from imagine_bench.store import run_folder
from imagine_bench.store.checkpoints import Snapshot, load_newest, save_snapshot
from imagine_bench.store.files import grouped, reading

TRAINING = 100
MEASURING = 10
"""Steps of progress of a variant."""


def run(spec: RunSpec[RegressionProtocol], folder: Path, on_progress: OnProgress) -> RegressionRun:
    """Do a run, or finish one that was begun, and load its result. A finished run is only loaded.

    Raises:
        BusyError: Another process is at this run.
        ArtefactError: The folder holds something damaged, foreign or begun with other settings.
        DivergedError: A likelihood is no longer finite; the message says where the state lies.
        SetupError: The folder cannot be written.
    """
    with run_folder.unfinished(folder) as left:
        if left:
            _Run(spec, folder, on_progress).execute()
    return load_run(folder)


class _Run:
    def __init__(self, spec: RunSpec[RegressionProtocol], folder: Path, on_progress: OnProgress) -> None:
        self.spec = spec
        self.folder = folder
        self.on_progress = on_progress
        self.protocol = spec.protocol
        self.task = registry.regression(spec.protocol.task)
        self.seeds = SeedTree(spec.seed)
        self.networks = tuple(self.seeds.child("network", index) for index in range(self.protocol.networks))
        self.rows: list[Row] = []
        self.evaluations: dict[str, Arrays] = {}
        self.train_cpu_s = 0.0
        self.snapshot = load_newest(folder / run_folder.CHECKPOINTS)
        if self.snapshot is not None:
            self.rows = list(self.snapshot.values["rows"])
            found = grouped(self.snapshot.arrays)  # files give arrays back in any order
            self.evaluations = {variant: found[variant] for variant in self.protocol.variants if variant in found}
        self.saved_s = time.monotonic()

    def execute(self) -> None:
        for variant in self.protocol.variants[len(self.evaluations) :]:
            regressor = self._regressor(variant)
            self._train(regressor, variant)
            self._measure(regressor, variant)
        recorder = self.task.recorder or next(iter(self.spec.observers), None)
        if recorder is not None and self.protocol.recorded:
            self._report("recording", "recording", 0)
            path = run_folder.recording_path(self.folder)
            registry.load(recorder)(self.evaluations, task=self.task, name=self.spec.agent, path=path)
        finish(self.folder, self.rows, self.evaluations)
        self._report("done", "done", 0)

    def _regressor(self, variant: str) -> Regressor:
        """A new regressor, or the one of the newest checkpoint where that was made in the middle of this variant."""
        # the task's own measurements draw the same data again, from the same node
        context = RegressorContext(
            datasets=tuple(self.task.training(variant, node.child("data").generator()) for node in self.networks),
            seeds=tuple(node.child("regressor", variant) for node in self.networks),
            hyperparameters=self.protocol.hyperparameters,
            overrides=overrides_of(self.protocol, self.spec.agent),
            device=self.protocol.device,
        )
        regressor = registry.make_regressor(self.spec.agent, context)
        run_folder.check_config(self.folder, self.spec, regressor)
        snapshot = self.snapshot
        self.snapshot = None
        self.train_cpu_s = 0.0
        if snapshot is not None and snapshot.values["variant"] == variant:
            with reading(self.folder / run_folder.CHECKPOINTS, f"a checkpoint of {self.spec.agent!r}"):
                regressor.restore(snapshot.agent)
            self.train_cpu_s = snapshot.values["train_cpu_s"]
        return regressor

    def _train(self, regressor: Regressor, variant: str) -> None:
        step = max(1, regressor.epochs // TRAINING)
        try:
            while regressor.epoch < regressor.epochs:
                start_s = time.process_time()
                regressor.train(min(step, regressor.epochs - regressor.epoch))
                self.train_cpu_s += time.process_time() - start_s
                done = TRAINING * regressor.epoch // regressor.epochs
                self._report("training", f"{variant}, epoch {regressor.epoch} of {regressor.epochs}", done)
                if time.monotonic() - self.saved_s >= self.spec.checkpoint_every_s:
                    self._save(regressor, variant)
        except DivergedError as error:
            where = self._save(regressor, variant, "diverged")
            raise DivergedError(f"{error} The state lies in {where}.") from error
        self._save(regressor, variant)

    def _measure(self, regressor: Regressor, variant: str) -> None:
        self._report("testing", f"{variant}, measuring", TRAINING)
        start_s = time.process_time()
        rng = self.seeds.child("calibration", variant).generator()
        points = self.protocol.test_points
        rows, arrays = calibrate(self.task, regressor, variant, self.networks, points=points, rng=rng)

        def predict(inputs: Floats, name: str) -> Prediction:
            return regressor.predict(inputs, self.seeds.child("predict", variant, name).generator())

        evaluation = self.task.evaluate(variant, predict, self.networks)
        shared: Row = {**regressor.diagnostics()}  # of all networks together; the CPU seconds are a network's share
        shared["train_cpu_s"] = self.train_cpu_s / self.protocol.networks
        shared["measure_cpu_s"] = (time.process_time() - start_s) / self.protocol.networks
        self.rows += [{"variant": variant, "network": index, **row, **shared} for index, row in enumerate(rows)]
        self.evaluations[variant] = {**evaluation, **{f"calibration/{name}": a for name, a in arrays.items()}}
        write_rows(self.folder, self.rows)
        self._save(regressor, "")

    def _save(self, regressor: Regressor, variant: str, folder: str = run_folder.CHECKPOINTS) -> Path:
        """Save everything that is needed to go on with ``variant``, empty where it is measured; where it lies."""
        values = {"variant": variant, "rows": self.rows, "train_cpu_s": self.train_cpu_s}
        arrays = flattened(self.evaluations)
        snapshot = Snapshot(episode=regressor.epoch, agent=regressor.state(), arrays=arrays, values=values)
        self.saved_s = time.monotonic()
        return save_snapshot(self.folder / folder, snapshot)

    def _report(self, phase: Phase, detail: str, done: int) -> None:
        """Tell how far the run is: ``done`` counts within the running variant."""
        progress = Progress(
            agent=self.spec.agent,
            seed=self.spec.seed,
            bench=self.protocol.hash,
            phase=phase,
            done=(TRAINING + MEASURING) * len(self.evaluations) + done,
            work=self.spec.work,
            detail=detail,
        )
        self.on_progress(progress)
