"""Metrics of a bench in TensorBoard, read back by it, and in the files of Weights & Biases, read by its messages."""

from __future__ import annotations

import json
import struct
import sys

import pytest

from imagine_bench.adapters.tracking import track
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError, UnknownNameError

ROWS = (
    "episodes,test_episodes,successes,solved,mean_return,diagnostics/loss/bellman\n2,20,1,0{n},-2.5,\n4,20,5,1{n},3,0.5"
)


@pytest.fixture
def bench(tmp_path):
    """A bench with a run of two agents each, one of which is not tested yet."""
    for run in ("dqn/seed_0", "random/seed_3", "dqn/seed_1"):
        (tmp_path / run).mkdir(parents=True)
        if run != "dqn/seed_1":
            (tmp_path / run / "metrics.csv").write_text(ROWS.format(n="0" * 1000))
    return tmp_path


def test_tensorboard_reads_the_scalars_back(bench, capsys):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for _ in range(2):  # the second time it is written anew
        assert main(["report", str(bench), "--track", "tensorboard"]) == 0
        assert str(bench / "tensorboard") in capsys.readouterr().out
    assert sorted(path.parent.name for path in bench.glob("tensorboard/*/*/*")) == ["seed_0", "seed_3"]
    events = EventAccumulator(str(bench / "tensorboard/random/seed_3"))
    events.Reload()

    def values(tag):
        found = events.Tensors(tag)
        return [(each.step, pytest.approx(each.tensor_proto.float_val[0])) for each in found]

    assert values("success_rate") == [(2, 0.05), (4, 0.25)]
    assert values("mean_return") == [(2, -2.5), (4, 3.0)]
    assert values("diagnostics/loss/bellman") == [(4, 0.5)]
    assert "solved" not in events.Tags()["tensors"]


def _records(path):
    """The messages in a file: records of a LevelDB log, after a header of seven bytes, in blocks of 32 KiB."""
    content, at, part = path.read_bytes(), 7, b""
    while at + 7 <= len(content):
        if 32768 - at % 32768 < 7:
            at += 32768 - at % 32768
            continue
        _, length, kind = struct.unpack_from("<IHB", content, at)
        part += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in {1, 4}:  # whole, or the last of several
            yield part
            part = b""


def test_weights_and_biases_files_are_whole(bench):
    from wandb.proto.wandb_internal_pb2 import Record

    out = track(bench, "wandb")
    found = {}
    for path in out.glob("wandb/offline-run-*/*.wandb"):
        records = [Record.FromString(content) for content in _records(path)]
        assert [each.exit.exit_code for each in records if each.HasField("exit")] == [0]
        (run,) = (each.run for each in records if each.HasField("run"))
        found[run.display_name] = [
            {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in each.history.item}
            for each in records
            if each.HasField("history")
        ]
    assert sorted(found) == ["dqn/seed_0", "random/seed_3"]
    rows = [(row["_step"], row["success_rate"], row["mean_return"]) for row in found["random/seed_3"]]
    assert rows == [(2, 0.05, -2.5), (4, 0.25, 3.0)]


def test_what_cannot_be_is_one_clear_error(tmp_path, bench, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tensorboard.summary", None)
    assert main(["report", str(bench), "--track", "tensorboard"]) == 2
    assert "pip install 'imagine-bench[tracking]'" in capsys.readouterr().err
    with pytest.raises(UnknownNameError, match="Known: tensorboard, wandb"):
        track(bench, "mlflow")
    with pytest.raises(InvalidValueError, match="has been tested yet"):
        track(tmp_path / "elsewhere", "tensorboard")
    (bench / "dqn/seed_0/metrics.csv").write_text("examples,error\n1,0.5")
    with pytest.raises(InvalidValueError, match="compares no agents"):
        track(bench, "tensorboard")
