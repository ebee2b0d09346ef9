"""A judgement that is interrupted or killed ends at once, leaves no process, and goes on to the same figures."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
import pytest
from fake_reader import NO_ERRORS

from imagine_bench import registry
from imagine_bench.errors import BusyError
from imagine_bench.judge import judgement
from imagine_bench.judge.judgement import Judgement, judge
from imagine_bench.store.files import lock, make_folder

pytestmark = pytest.mark.slow
_MODEL = """
import os, time
import numpy as np
from imagine_bench.interfaces.model import Imagined
from imagine_bench.registry import WorldModelEntry

class Waits:
    def fit(self, dataset, rng):
        if len(dataset.actions) == 40:
            open(os.environ["BEGUN"], "a").write("begun ")
            time.sleep(float(os.environ["WAITS_S"]))

    def imagine(self, frames, actions, samples, rng):
        depth = actions.shape[1] - frames.shape[1] + 1
        pictures = frames[:, -1][np.arange(len(frames)), None, None].repeat(samples, 1).repeat(depth, 2)
        return Imagined(pictures=pictures, epistemic=rng.random((len(frames), depth)))

    def parameters(self):
        return 0

def make(context):
    return Waits()

ENTRY = WorldModelEntry(make="waits:make", title="waits")
"""


def _put_reader(root: Path) -> None:
    """A reader that takes all for the same, so that none is trained."""
    one = Judgement(task="pick_place", models=("copy",), sizes=(20, 40), samples=2)
    folder = make_folder(root / one.folder_name)
    reader = registry.load("imagine_bench.agents.world_models.reader").Reader((3, 3, 3, 5))
    for parameter in reader.network.parameters():
        parameter.data.zero_()
    reader.references = parameter.new_zeros(1, 1024)
    (folder / "reader.json").write_text(json.dumps(NO_ERRORS))
    (folder / "reader.safetensors").write_bytes(reader.content())


class Judge:
    """The command in a process of its own, with a model that waits in its second fit."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.begun = folder / "begun"
        facts = folder / "waits-1.dist-info"
        facts.mkdir()
        (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: waits\nVersion: 1\n")
        (facts / "entry_points.txt").write_text("[imagine_bench.world_models]\nwaits = waits:ENTRY\n")
        (folder / "waits.py").write_text(_MODEL)

    def start(
        self, out: str, *, waits_s: float, workers: int, seeds: Sequence[str] = ("0", "1")
    ) -> subprocess.Popen[str]:
        words = ["judge", "pick_place", "--models", "waits", "copy", "--sizes", "20", "40", "--seeds", *seeds]
        words += ["--samples", "2", "--workers", str(workers), "--out", str(self.folder / out)]
        _put_reader(self.folder / out)
        return subprocess.Popen(
            [sys.executable, "-m", "imagine_bench", *words],
            env={
                **os.environ,
                "PYTHONPATH": str(self.folder),
                "BEGUN": str(self.begun),
                "WAITS_S": str(waits_s),
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def waiting(self, judge: subprocess.Popen[str]) -> list[psutil.Process]:
        """All processes below it, once a model waits."""
        deadline_s = time.monotonic() + 200
        while not self.begun.exists():
            assert judge.poll() is None and time.monotonic() < deadline_s, judge.communicate()
            time.sleep(0.1)
        return psutil.Process(judge.pid).children(recursive=True)

    def scores(self, out: str) -> dict[str, object]:
        timed = ("fit_s", "imagine_s_per_1000", "seal")
        found = {}
        for file in (self.folder / out).glob("*/*-seed*.json"):
            cell = json.loads(file.read_text())
            found[file.name] = {name: value for name, value in cell.items() if name not in timed}
        return found


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Judge]:
    heed = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background may ignore Ctrl-C
    yield Judge(tmp_path)
    signal.signal(signal.SIGINT, heed)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_it_ends_at_once_with_all_its_processes(command: Judge, workers: int, number: signal.Signals) -> None:
    judge = command.start("cut", waits_s=600.0, workers=workers)
    family = command.waiting(judge)
    assert len(family) > workers
    begun_s = time.monotonic()
    judge.send_signal(number)
    _, errors = judge.communicate(timeout=60)
    assert time.monotonic() - begun_s < 30, "the queue is not finished first"
    assert psutil.wait_procs(family, timeout=30)[1] == []
    assert judge.returncode == (130 if number == signal.SIGINT else -number) and "Traceback" not in errors
    if workers == 2 and number == signal.SIGKILL:
        assert len(command.scores("cut")) < 8
        for out in ("cut", "whole"):
            output = command.start(out, waits_s=0.0, workers=1).communicate(timeout=300)
            assert "waits" in output[0], output
        assert len(command.scores("whole")) == 8
        assert command.scores("cut") == command.scores("whole"), "to the bit"


def test_a_worker_that_is_killed_costs_one_cell(command: Judge) -> None:
    judge = command.start("killed", waits_s=600.0, workers=2, seeds=("0",))
    command.waiting(judge)
    deadline_s = time.monotonic() + 200
    while len(command.scores("killed")) < 3:
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
    (worker,) = (each for each in psutil.Process(judge.pid).children() if each.children())
    guests = worker.children(recursive=True)
    worker.kill()
    assert psutil.wait_procs([*guests, worker], timeout=30)[1] == []
    output, errors = judge.communicate(timeout=300)
    assert judge.returncode == 1 and "copy the last frame" in output
    assert "World model waits: its process ended early with exit code -9 (-9: it was killed" in errors
    assert len(command.scores("killed")) == 3


def test_two_at_once_in_one_folder_share_its_cells_and_keep_the_figures_of_one(command: Judge) -> None:
    for out in ("shared", "alone"):
        judges = [command.start(out, waits_s=0.0, workers=1) for _ in range(2 if out == "shared" else 1)]
        for process in judges:
            output, errors = process.communicate(timeout=300)
            assert process.returncode == 0 and "copy the last frame" in output, errors
            assert "Traceback" not in errors and "damaged" not in errors
    assert len(command.scores("alone")) == 8
    assert command.scores("shared") == command.scores("alone"), "to the bit"


def test_who_waits_too_long_for_another_judgement_is_told_which_process_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = Judgement(task="arrows:cubes=1", models=("copy",), sizes=(5,), seeds=(0,), samples=1)
    folder = make_folder(tmp_path / one.folder_name)
    hold = "import sys, time; from pathlib import Path; from imagine_bench.store.files import lock\n"
    hold += "with lock(Path(sys.argv[1]), 'it'):\n    print('held', flush=True)\n    time.sleep(600)"
    holder = subprocess.Popen([sys.executable, "-c", hold, folder / ".lock"], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    monkeypatch.setattr(judgement, "_PATIENCE_S", 0.1)
    try:
        with pytest.raises(BusyError, match=rf"^The folder .* is in use by process {holder.pid} on .*; wait for it,"):
            judge(one, tmp_path, workers=1)
    finally:
        holder.kill()
        holder.communicate()
    with lock(folder / ".lock", "it"):
        pass  # the system let go of it
