"""A disk that fills up costs the fit that it hits, in a sentence; the same judgement makes that fit later."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import IO, Any

import pytest
from fake_reader import read_nothing

from imagine_bench.judge import judgement
from imagine_bench.judge.judgement import Judgement, judge, kept

_ONE = Judgement(task="arrows:cubes=1", models=("copy",), sizes=(5, 20), seeds=(0,), samples=1)


def test_a_fit_whose_log_finds_no_room_is_a_sentence_and_is_made_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.open

    def full(path: Path, *given: Any, **named: Any) -> IO[Any]:
        if path.name == "copy-seed0-20.log":
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, *given, **named)

    monkeypatch.setattr(judgement, "reader_in", read_nothing)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", full)
        folder, failed = judge(_ONE, tmp_path, workers=1)
    (said,) = failed
    assert said.startswith("Cannot write ") and "copy-seed0-20.log: the disk is full; free some space" in said
    assert [cell["transitions"] for cell in kept(folder, _ONE)] == [5], "the other fit is judged all the same"
    assert judge(_ONE, tmp_path, workers=1) == (folder, [])
    assert [cell["transitions"] for cell in kept(folder, _ONE)] == [5, 20]
