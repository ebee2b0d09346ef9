"""Deaths and kills while motions are written and judged; the folders that are left are whole; the command goes on."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from imagine_bench_motion.control import datasets
from imagine_bench_motion.judge.judgement import MotionJudgement, data_of, judge, judged, stage
from storms import interrupted

pytestmark = pytest.mark.slow
_ENDS = ("death", "full disk", "kill")
_FEW = MotionJudgement(task="arrow_puzzle", models=("no_change",), sizes=(2,), seeds=(0,), pairs=1, chains=1)
_PLAYED: dict[str, Any] = {"policy": "expert", "episodes": 2, "seed": 1000, "appearance": "mild", "size": 32}


def in_this_process(
    function: Callable[..., str], items: Iterable[Any], *, on_end: Callable[[Any, str], None], **_: object
) -> None:
    """As ``work_through``, without a process of its own, so that every file operation is counted."""
    for item in items:
        on_end(item, function(item, print))


def digests(folder: Path) -> dict[str, str]:
    """Each file below a folder but the card, which names the command, and the page that is made of it."""
    files = [
        path for path in sorted(folder.rglob("*")) if path.is_file() and path.name not in {"card.json", "README.md"}
    ]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.parametrize("how", _ENDS)
def test_a_set_of_motions_is_whole_or_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    monkeypatch.setattr(datasets, "work_through", in_this_process)

    def write(folder: Path) -> None:
        datasets.collect("arrow_puzzle", format="npz", folder=folder / "set", workers=1, **_PLAYED)

    write(tmp_path / "whole")
    whole = digests(tmp_path / "whole" / "set")
    assert len(whole) >= _PLAYED["episodes"]
    ended = finished = 0
    for folder in interrupted(tmp_path, monkeypatch, how, write):
        ended += 1
        if (folder / "set").exists():
            finished += 1
        else:
            write(folder)
        assert digests(folder / "set") == whole, folder
        names = {path.name for path in folder.iterdir()} - {"set"}
        assert all(name.startswith(".set.") for name in names), names
        assert how == "kill" or not names, (folder, names)
        assert len(names) <= 1, names
    with capsys.disabled():
        print(f"\nstorm: writing of motions ended {ended} times by {how}; whole after {finished} of them")
    assert ended > 20
    assert 0 < finished < ended


def test_a_judgement_of_motions_goes_on_after_every_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def act(root: Path) -> Path:
        for kept_in_memory in (stage, data_of):
            kept_in_memory.cache_clear()
        folder, failed = judge(_FEW, root, workers=1)
        assert not failed
        return folder

    def cells(folder: Path) -> list[dict[str, Any]]:
        return [{name: value for name, value in cell.items() if name != "fit_s"} for cell in judged(_FEW, folder)]

    whole = cells(act(tmp_path / "whole"))
    assert len(whole) == len(_FEW.cells)
    ended = 0
    for root in interrupted(tmp_path, monkeypatch, "kill", act):
        ended += 1
        folder = act(root)
        assert cells(folder) == whole, folder
    with capsys.disabled():
        print(f"\nstorm: a judgement of motions ended {ended} times by kill, 0 differing scores")
    assert ended > 20
