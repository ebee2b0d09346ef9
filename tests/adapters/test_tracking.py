"""Metrics of a bench in TensorBoard, read back by it, and in the files of Weights & Biases, read by its messages."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from types import SimpleNamespace

import pytest
from small_runs import small

from imagine_bench.adapters.tracking import Tracked, track
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.protocols.data import Failure, Job, Progress, RunSpec

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


def scalars(folder):
    """The steps and values of each scalar that TensorBoard reads of a run."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(each.step, round(float(each.tensor_proto.float_val[0]), 6)) for each in events.Tensors(tag)]
        for tag in events.Tags()["tensors"]
    }


def test_tensorboard_reads_the_scalars_back(bench, capsys):
    for _ in range(2):  # the second time it is written anew
        assert main(["report", str(bench), "--track", "tensorboard"]) == 0
        assert str(bench / "tensorboard") in capsys.readouterr().out
    assert sorted(path.parent.name for path in bench.glob("tensorboard/*/*/*")) == ["seed_0", "seed_3"]
    found = scalars(bench / "tensorboard/random/seed_3")
    assert found["success_rate"] == [(2, 0.05), (4, 0.25)]
    assert found["mean_return"] == [(2, -2.5), (4, 3.0)]
    assert found["diagnostics/loss/bellman"] == [(4, 0.5)]
    assert "solved" not in found


class Told:
    """A launcher that says twice how two runs go in turn, tests one of them after two episodes, and fails the other."""

    def __init__(self, look):
        self.look = look

    def launch(self, jobs, on_progress):
        for episode in (1, 2, 3):
            for job in jobs:
                spec = job.spec
                job.folder.mkdir(parents=True, exist_ok=True)
                if episode == 3 and spec.seed == 0:
                    (job.folder / "metrics.csv").write_text("episodes,test_episodes,successes,solved\n2,20,5,1\n")
                told = {"agent": spec.agent, "seed": spec.seed, "bench": spec.protocol.hash, "done": episode, "work": 9}
                for _ in range(2):
                    on_progress(Progress(**told, phase="training", episode=episode, success=episode / 10))
                self.look(job, episode)
        on_progress(Failure(job=jobs[1], reason="it broke").progress)
        return (Failure(job=jobs[1], reason="it broke"),)


def jobs_of(folder, seeds=(0, 1)):
    protocol = small(seeds=seeds)
    specs = [RunSpec(protocol=protocol, agent="table", seed=seed) for seed in protocol.seeds]
    return [Job(spec=spec, folder=folder / f"bench/table/seed_{spec.seed}") for spec in specs]


def tracked(folder, tool, look=lambda job, episode: None):
    return Tracked(Told(look), tool, "arrow_puzzle").launch(jobs_of(folder), lambda progress: None)


def test_tensorboard_sees_training_and_tests_while_the_runs_go_on(tmp_path):
    seen = []

    def look(job, episode):
        found = scalars(tmp_path / f"bench/tensorboard/table/seed_{job.spec.seed}")
        seen.append((len(found["training/recent_success"]), found.get("success_rate")))

    (failure,) = tracked(tmp_path, "tensorboard", look)
    assert failure.reason == "it broke"
    assert seen == [(1, None), (1, None), (2, None), (2, None), (3, [(2, 0.25)]), (3, None)]


def test_the_command_for_runs_of_merged_benches_names_each_bench(tmp_path, capsys):
    """As with --until-decided: the merged folder itself has no runs."""
    tracked = Tracked(Told(None), "tensorboard", "arrow_puzzle")
    runs = [SimpleNamespace(folder=tmp_path / bench / "dqn/seed_0") for bench in ("one", "two", "two")]
    tracked.note(SimpleNamespace(runs=runs, folder=tmp_path / "merged"))
    said = capsys.readouterr().out
    assert all(f"'imagine-bench report {tmp_path / bench} --track tensorboard'" in said for bench in ("one", "two"))
    assert "Note: 3 of 3 runs" in said and "merged" not in said


def test_runs_of_every_stage_are_tracked_and_no_others(tmp_path, capsys):
    """A bench until its question is decided launches its runs in stages; one of seed 4 was finished before."""
    tracked = Tracked(Told(lambda job, episode: None), "tensorboard", "arrow_puzzle")
    for stage in ((0, 1), (2, 3)):
        tracked.launch(jobs_of(tmp_path, stage), lambda progress: None)
    runs = [SimpleNamespace(folder=tmp_path / f"bench/table/seed_{seed}") for seed in range(5)]
    tracked.note(SimpleNamespace(runs=runs[:4]))
    assert capsys.readouterr().out == ""
    tracked.note(SimpleNamespace(runs=runs))
    assert "Note: 1 of 5 runs were finished before" in capsys.readouterr().out
    for seed in range(4):
        assert scalars(tmp_path / f"bench/tensorboard/table/seed_{seed}")["training/recent_success"]


def test_a_tool_that_fails_costs_no_run(tmp_path, capsys):
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench" / "tensorboard").touch()  # where its folder is to be
    assert len(tracked(tmp_path, "tensorboard")) == 1
    assert capsys.readouterr().out.count("Note: tensorboard failed and is left alone") == 1


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


def histories(out):
    """The logged values of each run, whose file is whole."""
    from wandb.proto.wandb_internal_pb2 import Record

    found = {}
    for path in out.glob("wandb/offline-run-*/*.wandb"):
        records = [Record.FromString(content) for content in _records(path)]
        assert [each.exit.exit_code for each in records if each.HasField("exit")] == [0]
        (run,) = (each.run for each in records if each.HasField("run"))
        assert run.run_group == run.display_name.partition("/")[0], "seeds of an agent stand together"
        found[run.display_name] = [
            {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in each.history.item}
            for each in records
            if each.HasField("history")
        ]
    return found


def test_weights_and_biases_gets_two_runs_at_once(tmp_path):
    tracked(tmp_path, "wandb")
    found = histories(tmp_path / "bench/wandb")
    assert sorted(found) == ["table/seed_0", "table/seed_1"]
    training = [(row["_step"], row["training/recent_success"]) for row in found["table/seed_1"]]
    assert training == [(1, 0.1), (2, 0.2), (3, 0.3)]
    assert [row["success_rate"] for row in found["table/seed_0"] if "success_rate" in row] == [0.25]


def test_what_cannot_be_is_one_clear_error(tmp_path, bench):
    earlier = bench / "tensorboard/earlier"
    earlier.mkdir(parents=True)
    absent = "import sys; sys.modules['tensorboard'] = None; from imagine_bench.cli import main; main(sys.argv[1:])"
    words = [sys.executable, "-c", absent, "report", bench, "--track", "tensorboard"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "pip install 'imagine-bench[tracking]'" in done.stderr
    assert earlier.exists(), "what no tool can write anew stays"
    config = bench / "tensorboard/seed_0/config.json"
    config.parent.mkdir()
    config.touch()
    with pytest.raises(InvalidValueError, match="tensorboard holds the runs of an agent of this name"):
        track(bench, "tensorboard")
    assert config.exists()
    config.unlink()
    with pytest.raises(UnknownNameError, match="Known: tensorboard, wandb"):
        track(bench, "mlflow")
    with pytest.raises(InvalidValueError, match="has been tested yet"):
        track(tmp_path / "elsewhere", "tensorboard")
    (bench / "dqn/seed_0/metrics.csv").write_text("examples,error\n1,0.5")
    with pytest.raises(InvalidValueError, match="compares no agents"):
        track(bench, "tensorboard")
