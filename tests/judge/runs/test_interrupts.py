"""A judgement that is interrupted or killed ends at once, leaves no process, and goes on to the same figures."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from fake_reader import NO_ERRORS

from imagine_bench import registry
from imagine_bench.judge.judgement import Judgement
from imagine_bench.store.files import make_folder

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


class Command:
    """``judge`` in processes of its own, with a model that waits in its second fit."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.begun = folder / "begun"
        facts = folder / "waits-1.dist-info"
        facts.mkdir()
        (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: waits\nVersion: 1\n")
        (facts / "entry_points.txt").write_text("[imagine_bench.world_models]\nwaits = waits:ENTRY\n")
        (folder / "waits.py").write_text(_MODEL)

    def start(self, out: str, *, waits_s: float = 0.0, workers: int = 1) -> subprocess.Popen[str]:
        words = "judge pick_place --models waits copy --sizes 20 40 --seeds 0 1 --samples 2".split()
        words += ["--workers", str(workers), "--out", str(self.folder / out)]
        _put_reader(self.folder / out)
        own = {"PYTHONPATH": str(self.folder), "BEGUN": str(self.begun), "WAITS_S": str(waits_s)}
        return subprocess.Popen(
            [sys.executable, "-m", "imagine_bench", *words], env={**os.environ, **own}, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip

    def waiting(self, judge: subprocess.Popen[str]) -> list[psutil.Process]:
        """All processes below it, once a model waits."""
        deadline_s = time.monotonic() + 200
        while not self.begun.exists():
            assert judge.poll() is None and time.monotonic() < deadline_s, judge.communicate()
            time.sleep(0.1)
        return psutil.Process(judge.pid).children(recursive=True)

    def scores(self, out: str, *judges: subprocess.Popen[str]) -> dict[str, object]:
        """All figures but times, once judgements have ended well."""
        for judge in judges:
            output, errors = judge.communicate(timeout=300)
            assert judge.returncode == 0 and "copy the last frame" in output, errors
            assert "Traceback" not in errors and "damaged" not in errors
        cells = {file.name: json.loads(file.read_text()) for file in (self.folder / out).glob("*/*-seed*.json")}
        for cell in cells.values():
            for name in ("fit_s", "imagine_s_per_1000", "seal"):
                del cell[name]
        return cells


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Command]:
    heed = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background may ignore Ctrl-C
    yield Command(tmp_path)
    signal.signal(signal.SIGINT, heed)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_it_ends_at_once_with_all_its_processes(command: Command, workers: int, number: signal.Signals) -> None:
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
        cut, whole = (command.scores(out, command.start(out)) for out in ("cut", "whole"))
        assert len(whole) == 8 and cut == whole, "to the bit"


def test_two_judges_in_one_folder_share_its_cells(command: Command) -> None:
    shared = command.scores("shared", *[command.start("shared") for _ in range(2)])
    alone = command.scores("alone", command.start("alone"))
    assert len(alone) == 8 and shared == alone, "to the bit"
