"""The bench folder: one protocol each, one process at a time, nothing overwritten, nothing silently missing."""

from __future__ import annotations

import itertools
import json
import os
import time
from pathlib import Path

import pytest
from small_runs import small

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError, BusyError
from imagine_bench.running.bench import load_bench
from imagine_bench.store.bench_folder import BenchStore, bench_facts, bench_folder, newest_bench, newest_recording
from imagine_bench.store.files import make_folder, sealed, write_json

_ENVIRONMENT = {"command": "imagine-bench bench", "commit": "abc", "versions": {"torch": "1"}, "gl_renderer": "x"}


def opened(root: Path, **changes: object) -> BenchStore:
    protocol = small(**changes)
    store = BenchStore(bench_folder(root, protocol), protocol)
    with store.held():
        return store


def test_another_protocol_has_another_folder_that_one_process_holds(tmp_path: Path) -> None:
    store = opened(tmp_path)
    assert store.folder != opened(tmp_path, budgets=(4, 10)).folder
    assert store.folder != opened(tmp_path, encoder="other@0123456789ab").folder
    with store.held(), pytest.raises(BusyError, match=r"The bench folder .* is in use by process \d+"):
        opened(tmp_path)
    opened(tmp_path)  # and afterwards it is free


def test_a_foreign_protocol_is_named_and_untouched(tmp_path: Path) -> None:
    store = opened(tmp_path)
    path = store.folder / "protocol.json"
    for text in (json.dumps(small(budgets=(1, 2)).as_dict()), '{"task": "arrow_puzzle", "color": "red"}'):
        path.write_text(text)
        for read in (lambda: opened(tmp_path), lambda: load_bench(store.folder)):
            with pytest.raises(ArtefactError, match=r"protocol\.json is damaged: .* stands for another protocol"):
                read()
        assert path.read_text() == text


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("judgement.json", "is a judgement of world models; 'imagine-bench judge'"),
        ("report/bench.json", "is a report of merged benches, which has no runs"),
        ("config.json", "is one run; give the folder of its bench"),
        ("study.json", "is a study, which has no runs"),
        ("report/suite.json", "is a suite, which has no runs"),
        ("card.json", "is a dataset; 'imagine-bench dataset --describe'"),
        ("other.json", "There is no "),
    ],
)
def test_a_folder_of_another_kind_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, words: str
) -> None:
    folder = tmp_path / "given"
    make_folder((folder / file).parent)
    write_json(folder / file, sealed({}))
    for command in ("report", "verify"):
        assert main([command, str(folder)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert words in line and str(folder) in line


def test_a_session_elsewhere_is_noticed(tmp_path: Path) -> None:
    opened(tmp_path).begin_session(_ENVIRONMENT)
    torch = {"versions": {"torch": "2"}}
    changes = [({**torch, "command": "other"}, ["versions"]), ({"gl_renderer": "y"}, ["gl_renderer"])]
    changes += [({"commit": "def"}, ["commit"]), ({"machine": {"cpu": "another", "cores": 2}}, ["cpu"])]
    for change, changed in changes:
        assert opened(tmp_path).begin_session({**_ENVIRONMENT, **change}) == changed
    sessions = json.loads((opened(tmp_path).folder / "sessions.json").read_text())["sessions"]
    assert [session["changed"] for session in sessions][:2] == [{}, torch]


def test_the_time_of_a_bench_is_that_of_its_sessions(tmp_path: Path) -> None:
    sessions_s = 0.0
    for waited_s, worked_s in ((0.02, 0.03), (0.2, 0.05)):
        store = BenchStore(tmp_path, small())
        make_folder(tmp_path)
        time.sleep(waited_s)  # such as for its lock
        before_s = time.monotonic()
        store.begin_session({"command": "bench"})
        time.sleep(worked_s)
        store.save_time()
        sessions_s += time.monotonic() - before_s
    assert 0.08 - 0.001 <= bench_facts(tmp_path)["wall_s"] <= sessions_s + 0.001  # kept in milliseconds


def test_the_newest_bench_or_recording_of_some_tasks_or_of_all(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match=r"no bench of robot_ik below .*; run '.* --task robot_ik'"):
        newest_bench(tmp_path, "robot_ik")
    run = tmp_path / "arrow_puzzle/quick-0123456789ab/imagine/seed_0/recording.rrd"
    plan = run.parent / "plans/physics-100/recording.rrd"
    optioned = tmp_path / "arrow_puzzle-slip=0.2/quick-0123456789ab/imagine/seed_0/recording.rrd"
    other = tmp_path / "robot_ik/quick-0123456789ab/ensemble/seed_0/recording.rrd"
    for time_s, path in enumerate((plan, run, optioned, other)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.utime(path, (time_s, time_s))
    assert newest_recording(tmp_path) == newest_recording(tmp_path, "arrow_puzzle", "robot_ik") == other
    for newest in (optioned, run, plan):  # with any options; and that of a plan
        assert newest_recording(tmp_path, "arrow_puzzle") == newest
        newest.unlink()
    with pytest.raises(ArtefactError, match=r"no recording of arrow_puzzle below .*--task arrow_puzzle'"):
        newest_recording(tmp_path, "arrow_puzzle")


def test_the_newest_of_a_task_is_of_none_whose_name_begins_alike(tmp_path: Path) -> None:
    tasks = sorted(registry.TASKS)  # a name before those that begin with it
    assert any(later.startswith(earlier) for earlier, later in itertools.pairwise(tasks))
    kept = {task: tmp_path / task / "quick-0123456789ab" for task in tasks}
    for time_s, folder in enumerate(kept.values()):
        for path in (folder / "sessions.json", folder / "imagine/seed_0/recording.rrd"):
            make_folder(path.parent)
            path.touch()
            os.utime(path, (time_s, time_s))
    assert {task: newest_bench(tmp_path, task) for task in tasks} == kept
    assert {task: newest_recording(tmp_path, task).parents[2] for task in tasks} == kept
