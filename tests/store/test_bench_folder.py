"""The bench folder: one protocol each, one process at a time, nothing overwritten, nothing silently missing."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from small_runs import do, same_but_for_time, small

from imagine_bench.errors import ArtefactError, BusyError
from imagine_bench.running.bench import bench
from imagine_bench.running.launchers.jobs import launcher
from imagine_bench.running.task_types import load_bench
from imagine_bench.store.bench_folder import BenchStore, bench_folder, newest_bench, newest_recording
from imagine_bench.store.codec import pack, unpack
from imagine_bench.store.files import write_json
from imagine_bench.store.results import Checkpoint, OpenLoop

_ENVIRONMENT = {"command": "imagine-bench bench", "commit": "abc", "versions": {"torch": "1"}, "gl_renderer": "x"}


def opened(root: Path, **changes: object) -> BenchStore:
    protocol = small(**changes)
    store = BenchStore(bench_folder(root, protocol), protocol)
    store.open()
    return store


def test_a_finished_bench_is_read_back(tmp_path: Path) -> None:
    store = opened(tmp_path, seeds=(0, 2))
    assert store.begin_session(_ENVIRONMENT) == []
    assert store.missing() == [("table", 0), ("table", 2)]
    runs = [do(store.run_folder("table", seed), seed=seed, seeds=(0, 2)) for seed in (0, 2)]
    assert store.missing() == []
    result = load_bench(store.folder)
    assert result.protocol == store.protocol
    assert all(same_but_for_time(a, b) for a, b in zip(runs, result.runs, strict=True))
    assert result.environment["commit"] == "abc"
    assert newest_bench(tmp_path) == store.folder == tmp_path / "arrow_puzzle" / f"smoke-{store.protocol.hash}"


def test_a_missing_run_is_an_error_that_says_how_to_go_on(tmp_path: Path) -> None:
    store = opened(tmp_path, seeds=(0, 2))
    store.begin_session(_ENVIRONMENT)
    do(store.run_folder("table", 0), seeds=(0, 2))
    sentence = r"lacks table seed 2: 0 of 9 real episodes\. Run the same bench command again"
    with pytest.raises(ArtefactError, match=sentence):
        load_bench(store.folder)


def test_a_whole_bench_says_that_nothing_was_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = small(agents=("random",))
    for _ in range(2):
        folder = bench(wanted, {}, root=tmp_path, launcher=launcher("local", 1)).folder
    assert capsys.readouterr().out == f"All runs lie in {folder} already; nothing was run.\n"
    monkeypatch.setattr("imagine_bench.registry.machine.commit", lambda: "another")
    bench(wanted, {}, root=tmp_path, launcher=launcher("local", 1))
    assert f"Note: {folder} was begun with another commit." in capsys.readouterr().out


def test_other_settings_live_elsewhere(tmp_path: Path) -> None:
    assert opened(tmp_path).folder != opened(tmp_path, budgets=(4, 10)).folder
    assert opened(tmp_path).folder != opened(tmp_path, encoder="other@0123456789ab").folder


def test_two_benches_in_one_folder_are_refused(tmp_path: Path) -> None:
    store = opened(tmp_path)
    with store.lock(), pytest.raises(BusyError, match=r"The bench folder .* is in use by process \d+"):
        with opened(tmp_path).lock():
            pass
    with store.lock():
        pass  # and afterwards it is free


def test_a_tuple_among_the_settings_is_the_list_of_its_file(tmp_path: Path) -> None:
    protocol = small(overrides=(("controller.hidden", (64, 64)),))
    for _ in range(2):
        BenchStore(bench_folder(tmp_path, protocol), protocol).open()
    kept = json.loads((bench_folder(tmp_path, protocol) / "protocol.json").read_text())
    assert kept == json.loads(json.dumps(protocol.as_dict())) and [64, 64] in kept["overrides"][0]


def test_a_foreign_protocol_is_named_and_untouched(tmp_path: Path) -> None:
    store = opened(tmp_path)
    path = store.folder / "protocol.json"
    other = small(budgets=(1, 2)).as_dict()
    path.write_text(json.dumps(other))
    with pytest.raises(
        ArtefactError, match=r"protocol\.json is damaged: .* stands for another protocol.* left untouched"
    ):
        store.open()
    path.write_text('{"task": "arrow_puzzle", "color": "red"}')
    with pytest.raises(ArtefactError, match=r"protocol\.json is damaged: .* stands for another protocol"):
        load_bench(store.folder)
    assert "color" in path.read_text()


def test_a_session_elsewhere_is_noticed(tmp_path: Path) -> None:
    opened(tmp_path).begin_session(_ENVIRONMENT)
    changed = opened(tmp_path).begin_session({**_ENVIRONMENT, "versions": {"torch": "2"}, "command": "other"})
    assert changed == ["versions"]
    sessions = json.loads((opened(tmp_path).folder / "sessions.json").read_text())["sessions"]
    assert [session["changed"] for session in sessions] == [{}, {"versions": {"torch": "2"}}]
    elsewhere = {**_ENVIRONMENT, "machine": {"cpu": "another", "cores": 2}}
    assert opened(tmp_path).begin_session(elsewhere) == ["cpu"]


def test_a_session_killed_at_any_write_can_begin_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for survived in (0, 1):
        writes = iter(range(10))

        def killed(path: Path, value: object, survived: int = survived, writes: Iterator[int] = writes) -> None:
            if next(writes) == survived:
                raise KeyboardInterrupt
            write_json(path, value)

        folder = opened(tmp_path / str(survived))
        monkeypatch.setattr("imagine_bench.store.bench_folder.write_json", killed)
        with pytest.raises(KeyboardInterrupt):
            folder.begin_session(_ENVIRONMENT)
        monkeypatch.undo()
        again = opened(tmp_path / str(survived))
        assert again.begin_session(_ENVIRONMENT) == []
        assert {path.name for path in again.folder.iterdir()} >= {"environment.json", "sessions.json"}


@pytest.mark.parametrize("content", ["[{}]", "[1]", '[{"wall_s": null}]'])
def test_sessions_that_say_nothing_are_named(tmp_path: Path, content: str) -> None:
    store = opened(tmp_path)
    store.begin_session(_ENVIRONMENT)
    (store.folder / "sessions.json").write_text(content)
    with pytest.raises(ArtefactError, match=r"sessions\.json"):
        store.begin_session(_ENVIRONMENT)


@pytest.mark.parametrize(("name", "content"), [("sessions.json", "null"), ("environment.json", "[]")])
def test_a_damaged_session_is_named(tmp_path: Path, name: str, content: str) -> None:
    store = opened(tmp_path)
    store.begin_session(_ENVIRONMENT)
    (store.folder / name).write_text(content)
    with pytest.raises(ArtefactError, match=rf"{name} is not a bench's .*: it holds a .* left untouched"):
        store.begin_session(_ENVIRONMENT)


def test_no_bench_and_no_recording(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="There is no bench below"):
        newest_bench(tmp_path)
    with pytest.raises(ArtefactError, match=r"no such bench below .*robot_ik; run one with .* --task robot_ik"):
        newest_bench(tmp_path, ("robot_ik",))
    with pytest.raises(ArtefactError, match="There is no recording below"):
        newest_recording(tmp_path)


def test_the_newest_recording_may_be_a_plan_s(tmp_path: Path) -> None:
    run = tmp_path / "arrow_puzzle/quick-0123456789ab/imagine/seed_0/recording.rrd"
    plan = run.parent / "plans/physics-100/recording.rrd"
    for age_s, path in ((10.0, run), (0.0, plan)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.utime(path, (1e9 - age_s, 1e9 - age_s))
    assert newest_recording(tmp_path) == plan
    os.utime(run, (1e9 + 1.0, 1e9 + 1.0))
    assert newest_recording(tmp_path) == run
    other = tmp_path / "robot_ik/quick-0123456789ab/ensemble/seed_0/recording.rrd"
    other.parent.mkdir(parents=True)
    other.touch()
    assert newest_recording(tmp_path) == other and newest_recording(tmp_path, "arrow_puzzle") == run
    with pytest.raises(ArtefactError, match=r"below .*pick_place; run a bench with .*--task pick_place'"):
        newest_recording(tmp_path, "pick_place")


def test_imagined_rollouts_and_open_loop_come_back(tmp_path: Path) -> None:
    result = do(tmp_path / "run", "imaginer", agents=("imaginer",), open_loop_starts=6)
    assert len(result.imagined) == 5
    assert result.imagined[0].rollout.frames.dtype == np.float32
    assert result.imagined[0].real_frames.shape == (10, 64, 64, 3)
    for row in result.checkpoints:
        assert isinstance(row.open_loop, OpenLoop)
        assert row.open_loop.count.tolist() == [6] * 10
        assert row.open_loop.accepted.tolist() == [1.0] * 3 + [0.0] * 7
        values, arrays = pack(row)
        again = unpack(Checkpoint, json.loads(json.dumps(values)), arrays)
        assert again.open_loop is not None
        np.testing.assert_array_equal(again.open_loop.correct_accepted, row.open_loop.correct_accepted)
        assert np.isnan(row.open_loop.correct_accepted[3:]).all()
