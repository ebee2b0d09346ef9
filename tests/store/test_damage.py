"""A file that was changed behind our back is refused in one sentence that names it; foreign files are no hindrance."""

from __future__ import annotations

import json
import os
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from small_runs import do_by, made_bench, of_before_digests, same_but_for_time, small

from imagine_bench.adapters.tracking import track
from imagine_bench.errors import ArtefactError, SetupError
from imagine_bench.running.bench import load_bench
from imagine_bench.store.bench_folder import bench_folder
from imagine_bench.store.files import lock, read_json, write_bytes
from imagine_bench.store.loading import load_so_far as load_so_far_of_bench
from imagine_bench.store.run_folder import load_run, load_so_far, mark_done, recording_path

WHOLE = Path(__file__).parent / "of_abcb05c/whole"
"""A finished bench of :func:`small`, of before packages had digests."""


def unfinished(folder: Path) -> Path:
    """A run that lacks its end, and its only checkpoint."""
    shutil.copytree(WHOLE / "table/seed_0", folder, dirs_exist_ok=True)
    (folder / "DONE").unlink()
    (checkpoint,) = (folder / "checkpoints").iterdir()
    return checkpoint


_SEALED = ["config.json", "metrics.csv", "imagined.npz", "agent.safetensors", "runner.safetensors", "state.json"]


@pytest.mark.parametrize("name", _SEALED)
def test_a_part_that_a_finished_bench_lost_is_named(tmp_path: Path, name: str) -> None:
    whole = made_bench(small(), tmp_path).folder
    (path,) = whole.rglob(name)
    path.unlink()
    for read in (load_so_far_of_bench, load_bench, lambda folder: track(folder, "tensorboard")):
        with pytest.raises(ArtefactError, match=rf"{name} is missing, although the run is finished.*; put it back, or"):
            read(whole)


def test_a_finished_run_without_its_checkpoint_says_so(tmp_path: Path) -> None:
    shutil.copytree(WHOLE / "table/seed_0", tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoints")
    with pytest.raises(ArtefactError, match="has no checkpoint, which holds its results"):
        load_run(tmp_path)


@pytest.mark.parametrize("name", ["config.json", "state.json"])
@pytest.mark.parametrize("content", ["[" * 10**5, "{}", "1" * 5000, "\x00", "null"])
def test_whatever_json_holds_is_one_sentence(tmp_path: Path, name: str, content: str) -> None:
    checkpoint = unfinished(tmp_path)
    path = checkpoint / name if name == "state.json" else tmp_path / name
    path.write_text(content)
    with pytest.raises(ArtefactError, match=name) as caught:
        load_so_far(tmp_path)
    assert len(str(caught.value)) < 500 and "\n" not in str(caught.value)


def test_other_folders_are_no_checkpoints_a_renamed_one_is_named(tmp_path: Path) -> None:
    checkpoint = unfinished(tmp_path)
    for name in ("checkpoint_old", "checkpoint_000099_episode_9 (copy)", "checkpoint_x_episode_1"):
        shutil.copytree(checkpoint, checkpoint.with_name(name))
    whole = load_so_far(tmp_path)
    assert whole is not None and whole.checkpoints[-1].episodes == 9
    shutil.copytree(checkpoint, checkpoint.with_name("checkpoint_000099_episode_9"))
    with pytest.raises(ArtefactError, match=r"checkpoint_000099_episode_9.* it is checkpoint_0"):
        load_so_far(tmp_path)


def test_what_killed_writers_left_is_swept(tmp_path: Path) -> None:
    checkpoint = unfinished(tmp_path)
    litter = [tmp_path / ".metrics.csv.999.partial", checkpoint.parent / ".partial_checkpoint_000009_episode_1"]
    litter[0].write_text("half")
    litter[1].mkdir()
    do_by(of_before_digests(), tmp_path)
    assert not any(path.exists() for path in litter)


@pytest.mark.parametrize("name", [".lock", ".lock.holder", ".a.json.PROCESS.partial"])
def test_neither_a_lock_nor_a_file_half_written_follows_a_link(tmp_path: Path, name: str) -> None:
    name = name.replace("PROCESS", str(os.getpid()))
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (tmp_path / name).symlink_to(precious)
    if "lock" in name:
        with pytest.raises(SetupError, match="is not a file of ours"), lock(tmp_path / ".lock", "It"):
            pass
    write_bytes(tmp_path / "a.json", b"1")
    assert precious.read_text() == "precious" and (tmp_path / "a.json").read_bytes() == b"1"


def test_a_changed_recording_is_noticed_a_removed_one_is_not(tmp_path: Path) -> None:
    unfinished(tmp_path)
    recording = recording_path(tmp_path)
    recording.write_bytes(b"as it was recorded")
    mark_done(tmp_path, ["config.json", "metrics.csv"])
    before = load_run(tmp_path)
    assert before.recording == recording
    recording.write_bytes(b"as it was changed")
    with pytest.raises(ArtefactError, match=r"recording\.rrd is not as the run left it"):
        load_run(tmp_path)
    recording.unlink()
    assert same_but_for_time(before, load_run(tmp_path))


def test_a_protocol_stands_for_its_folder_and_its_runs(tmp_path: Path) -> None:
    folder = bench_folder(tmp_path, small())
    shutil.copytree(WHOLE, folder)
    path = folder / "protocol.json"
    values = read_json(path, "a protocol")
    assert values.pop("execution") == "kinematic"
    path.write_text(json.dumps(values))
    elsewhere = folder.rename(tmp_path / "moved")  # no hash in its name: the runs know
    with pytest.raises(ArtefactError, match=r"config\.json has protocol.execution 'kinematic' where 'physics'"):
        load_bench(elsewhere)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("state.json", {"episode": 8}),
        ("state.json", {"agent": {}}),
        ("state.json", {"runner": {}}),
        ("state.json", {"seal": "0"}),
        ("config.json", {"settings": {"rate": 0.1}}),
        ("environment.json", {"commit": "other"}),
        ("sessions.json", {"commit": "other"}),
    ],
)
def test_changed_facts_are_refused(tmp_path: Path, name: str, values: dict[str, Any]) -> None:
    folder = tmp_path / "bench"
    shutil.copytree(WHOLE, folder)
    run = folder / "table/seed_0"
    (run / "DONE").unlink()
    (path,) = folder.rglob(name)
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))
    for read, where in (
        (load_so_far_of_bench, folder),
        *(((load_so_far, run), (partial(do_by, of_before_digests()), run)) if run in path.parents else ()),
    ):
        with pytest.raises(ArtefactError, match=rf"{name} is damaged"):
            read(where)
