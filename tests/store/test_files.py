"""Whole files or none, and one sentence for each way in which a folder can refuse."""

from __future__ import annotations

import errno
import functools
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from imagine_bench.agents.encoders.encoder import Encoder
from small_runs import FORMATS, Inline, small, written

from imagine_bench import registry
from imagine_bench.data.folder import read_dataset
from imagine_bench.errors import ArtefactError, BusyError, SetupError
from imagine_bench.running.bench import bench
from imagine_bench.store.encoders import bundled, kind, resolve
from imagine_bench.store.files import (
    first_difference,
    lock,
    make_folder,
    read_sealed,
    sealed,
    table_rows,
    table_text,
    write_bytes,
    write_json,
)
from imagine_bench.store.loading import archive_files, load_so_far
from imagine_bench.sweep import grid
from imagine_bench.sweep.grid import read_grid
from imagine_bench.values import Json

_HOLD = """
import sys, time
from pathlib import Path
from imagine_bench.store.files import lock
with lock(Path(sys.argv[1]), "The folder"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize(
    ("code", "sentence"),
    [
        (errno.ENOSPC, "the disk is full; free some space and run the same command again"),
        (errno.EACCES, "you may not write there; choose another folder"),
    ],
)
def test_a_refusal_is_one_sentence_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, sentence: str
) -> None:
    path = tmp_path / "a.json"
    write_json(path, "old")

    def refuse(_: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(SetupError) as caught:
        write_json(path, "new")
    assert str(caught.value).startswith(f"Cannot write {path}: {sentence}")
    assert json.loads(path.read_text()) == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_sealed_file_that_lost_its_seal_or_has_another_value_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    whole = sealed({"seed": 1, "rate": 0.5})
    bare = {name: value for name, value in whole.items() if name != "seal"}
    for changed in ({**whole, "seed": 2}, {**whole, "more": 3}, bare, {**bare, "seed": 2}, {**whole, "seal": None}):
        write_json(path, changed)
        with pytest.raises(ArtefactError, match="is damaged: it is not as it was written"):
            read_sealed(path, "a file")
    write_json(path, whole)
    assert read_sealed(path, "a file") == {"seed": 1, "rate": 0.5}


@pytest.mark.parametrize(
    ("then", "now", "found"),
    [
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}, ("a.c", 2, 3)),
        ({"a": 1, "b": 2}, {"a": 1}, ("b", 2, None)),
        ({"a": 1}, {"a": 1, "b": 2}, ("b", None, 2)),
        ({"a": {}}, {"a": {"b": [1]}}, ("a.b", None, [1])),
        ({"a": {"b": [1]}}, {"a": {"b": [1]}}, None),
    ],
)
def test_what_either_side_lacks_is_a_difference(then: Json, now: Json, found: tuple[str, Json, Json] | None) -> None:
    assert first_difference(then, now) == found


def test_a_table_has_the_columns_of_all_its_rows() -> None:
    rows = [{"episodes": 1, "loss": 0.5}, {"episodes": 2, "agent": "dqn"}, {"late": 1e-9}]
    assert table_rows(table_text(rows), texts=("agent",)) == rows


def test_a_file_in_the_way_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("not a folder")
    with pytest.raises(SetupError, match="a part of that path is a file, not a folder"):
        make_folder(tmp_path / "runs" / "arrow_puzzle")


def test_a_lock_is_held_by_one_process_and_freed_by_its_death(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    child = subprocess.Popen([sys.executable, "-c", _HOLD, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    with child.stdout:
        assert child.stdout.readline() == "held\n"
        with (
            pytest.raises(
                BusyError,
                match=rf"The folder is in use by process {child.pid} on .*; wait for it, stop it, or choose another",
            ),
            lock(path, "The folder"),
        ):
            pass
        child.kill()
        child.wait()
    with lock(path, "The folder"):
        assert str(os.getpid()) in (tmp_path / ".lock.holder").read_text()


def of_dataset(place: Path, format: str) -> None:
    wanted = written(place, format).episodes.hash
    assert read_dataset(place).episodes.hash == wanted


def of_bench(place: Path) -> None:
    result = bench(small(), {}, root=place, launcher=Inline())
    assert load_so_far(result.folder).runs[0].checkpoints == result.runs[0].checkpoints
    for name, text in archive_files(result).items():
        write_bytes(place / name, text.encode())
    assert load_so_far(place).runs[0].checkpoints[0].successes == result.runs[0].checkpoints[0].successes


def of_encoder(place: Path) -> None:
    path = place / "mine.safetensors"
    Encoder.load(bundled()["arrow_puzzle-clean-codes"]).save(path)
    assert kind(resolve(registry.task("arrow_puzzle"), "clean", str(path))) == "codes"


def of_grid(place: Path) -> None:
    write_bytes(make_folder(place) / "mine.toml", (Path(grid.__file__).parent / "grids/smoke.toml").read_bytes())
    assert read_grid(place / "mine.toml").name == "mine"


KINDS: dict[str, Callable[[Path], None]] = {
    **{format: functools.partial(of_dataset, format=format) for format in FORMATS},
    "bench": of_bench,
    "encoder": of_encoder,
    "grid": of_grid,
}
PLACES = ["relative/two", "spaces, 'quotes', \"quotes\" and umlauts \u00e4\u00f6\u00fc\u00df"]


@pytest.mark.parametrize("home", [None, "/dev/null/nobody can write here"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", KINDS)
def test_every_format_may_lie_anywhere_and_needs_no_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, place: str, home: str | None
) -> None:
    monkeypatch.chdir(tmp_path)
    for variable in ("HOME", "XDG_CACHE_HOME", "IMAGINE_BENCH_CACHE"):
        monkeypatch.delenv(variable, raising=False)
    if home is not None:
        monkeypatch.setenv("HOME", home)
    KINDS[name](Path(place))
    assert {path.name for path in tmp_path.iterdir()} == {Path(place).parts[0]}
