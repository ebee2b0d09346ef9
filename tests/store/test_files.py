"""Whole files or none, and one sentence for each way in which a folder can refuse."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from imagine_bench.errors import ArtefactError, BusyError, SetupError
from imagine_bench.store import run_folder
from imagine_bench.store.files import (
    first_difference,
    lock,
    make_plain,
    read_sealed,
    sealed,
    sweep,
    table_rows,
    table_text,
    write_json,
)
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


@pytest.mark.parametrize(
    ("written", "kept"),
    [
        (b"\x1b[31mred\n", "\\x1b[31mred\n"),
        (b"\xff gone\n", "\ufffd gone\n"),
        (b"all right\n", "all right\n"),
        (b"", None),
    ],
)
def test_a_log_of_any_bytes_becomes_a_text_that_a_terminal_can_show(
    tmp_path: Path, written: bytes, kept: str | None
) -> None:
    log = tmp_path / "log.txt"
    log.write_bytes(written)
    make_plain(log)
    assert (log.read_text(encoding="utf-8") if log.exists() else None) == kept


def test_a_sealed_file_without_its_seal_or_value_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    whole = sealed({"seed": 1, "rate": 0.5})
    bare = {name: value for name, value in whole.items() if name != "seal"}
    for changed in ({**whole, "seed": 2}, {**whole, "more": 3}, bare, {**bare, "seed": 2}, {**whole, "seal": None}):
        write_json(path, changed)
        with pytest.raises(ArtefactError, match="is damaged: it is not as it was written"):
            read_sealed(path, "a file")
    write_json(path, whole)
    assert read_sealed(path, "a file") == {"seed": 1, "rate": 0.5}


def test_a_sealed_file_of_keys_that_are_numbers_is_whole(tmp_path: Path) -> None:
    """JSON makes texts of them, which are in another order: "10" comes before "2"."""
    path = tmp_path / "state.json"
    values: Any = {"counts": {2: 1, 10: (3, 4)}, "mixed": {1: 0, "a": 1}}
    write_json(path, sealed(values))
    assert read_sealed(path, "a file") == {"counts": {"2": 1, "10": [3, 4]}, "mixed": {"1": 0, "a": 1}}


@pytest.mark.parametrize(
    ("then", "now", "found"),
    [
        ({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}, ("a.c", 2, 3)),
        ({"a": 1, "b": 2}, {"a": 1}, ("b", 2, None)),
        ({"a": {}}, {"a": {"b": [1]}}, ("a.b", None, [1])),
        ({"a": {"b": [1]}}, {"a": {"b": [1]}}, None),
    ],
)
def test_what_either_side_lacks_is_a_difference(then: Json, now: Json, found: tuple[str, Json, Json] | None) -> None:
    assert first_difference(then, now) == found


def test_what_another_may_still_write_is_not_swept(tmp_path: Path) -> None:
    for name, age_s in ((".new.1.partial", 3_000), (".old.2.partial", 4_000)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    sweep(tmp_path, older_than_s=3_600.0)
    assert [path.name for path in tmp_path.iterdir()] == [".new.1.partial"]


def test_a_table_has_the_columns_of_all_its_rows() -> None:
    rows = [{"episodes": 1, "loss": 0.5}, {"episodes": 2, "agent": "dqn"}, {"late": 1e-9}]
    assert table_rows(table_text(rows), texts=("agent",)) == rows


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
        threading.Timer(0.3, child.kill).start()
        with run_folder.unfinished(tmp_path) as is_left:  # it waits: the child of a killed command may be dying
            assert is_left
        child.wait()
    with lock(path, "The folder"):
        assert str(os.getpid()) in (tmp_path / ".lock.holder").read_text()
