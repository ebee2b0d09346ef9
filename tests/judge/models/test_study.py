"""Models of other packages are judged without a change here; what is kept is not done again; faults cost one model."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from doc_cells import ROOT
from fake_reader import BlindReader
from guest_packages import install
from recordings import contents, times

from imagine_bench import registry
from imagine_bench.cli import main
from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError
from imagine_bench.judge.models import study
from imagine_bench.judge.models.ends import Gallery
from imagine_bench.judge.models.study import Judgement, judge, kept
from imagine_bench.seeding import SeedTree

_PYPROJECT = """
[project]
name = "their_models"
version = "1.0"
[project.entry-points."imagine_bench.world_models"]
nearest = "their_models:ENTRY"
raises = "their_models:RAISES"
late = "their_models:LATE"
unmade = "their_models:UNMADE"
"""
_MORE = """
class Raises(Nearest):
    def fit(self, dataset, rng):
        raise RuntimeError("out of luck")

class Late(Nearest):
    def imagine(self, frames, actions, samples, rng):
        if actions.shape[1] > 1:
            raise KeyError("depth")
        return super().imagine(frames, actions, samples, rng)

def raises(context):
    return Raises()

def late(context):
    return Late()

def unmade(context):
    return context.nothing

UNMADE = WorldModelEntry(make="their_models:unmade", title="unmade")
RAISES = WorldModelEntry(make="their_models:raises", title="raises")
LATE = WorldModelEntry(make="their_models:late", title="late")
"""


@pytest.fixture
def guest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The page's model, and two that fail, in a package; and a reader that costs nothing."""
    page = (ROOT / "docs" / "how_to" / "world_model.md").read_text()
    code = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[0].replace("my_package", "their_models")
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "pyproject.toml").write_text(_PYPROJECT)
    (folder / "their_models.py").write_text(code + _MORE)
    monkeypatch.syspath_prepend(install(folder))
    monkeypatch.setattr(study, "_reader", lambda spec, appearance, place: _read_nothing(place))
    registry.offers.cache_clear()
    yield
    sys.modules.pop("their_models", None)
    for cache in (registry.offers, study._prepared, study._data):
        cache.cache_clear()


def _read_nothing(folder: Path) -> BlindReader:
    names = ("misread", "refused", "black_read", "gray_read", "noise_read", "blends_read")
    (folder / "reader.json").write_text(json.dumps(dict.fromkeys(names, 0.0)))
    return BlindReader(4)


_WORDS = ("judge", "--task", "pick_place", "--sizes", "20", "60", "--seeds", "1000", "--workers", "1")


@pytest.mark.usefixtures("guest")
def test_a_model_of_theirs_is_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*_WORDS, "--out", str(tmp_path), "--models", "nearest", "raises", "late", "unmade", "copy", "exact"]
    assert main(words) == 1
    said = capsys.readouterr()
    assert "World model raises: fit() failed (RuntimeError: out of luck)." in said.err
    assert "World model late: imagine() failed (KeyError: 'depth')." in said.err
    assert "World model unmade (their_models:unmade) cannot be used (AttributeError: " in said.err
    assert "nearest frame" in said.out and "exact" in said.out
    (folder,) = (path.parent for path in tmp_path.glob("*/judgement.json"))
    assert len(list(folder.glob("nearest-seed*.json"))) == 2 and not list(folder.glob("raises-*"))
    page = (folder / "report" / "index.html").read_text()
    assert all(words in page for words in ("nearest frame", "risk_coverage", "Where it fails"))
    recorded = contents(folder / "judgement.rrd")
    assert {"/action", "/real/frame", "/exact/frame", "/nearest/outcomes"} <= recorded.keys()
    assert times(folder / "judgement.rrd", "/exact/frame", "depth") == set(range(11))
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*-seed*.json")}
    assert judge(_judgement("nearest", "copy", "exact"), tmp_path, workers=1) == (folder, [])
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*-seed*.json")} == before
    scored = {(cell["model"], cell["transitions"]): cell for cell in kept(folder, _judgement("copy", "exact"))}
    assert scored["exact", 60]["value_loss"] == 0.0 < scored["copy", 60]["value_loss"]
    futures = scored["exact", 60]["futures"]
    assert [pytest.approx(each) for each in futures["real"]] == futures["imagined"]
    assert scored["copy", 20]["data"] == scored["exact", 60]["data"]


def _judgement(*models: str) -> Judgement:
    return Judgement(task="pick_place", models=models, sizes=(20, 60), seeds=(1000,))


@pytest.mark.usefixtures("guest")
def test_the_same_seed_gives_the_same_scores(tmp_path: Path) -> None:
    found = []
    one = dataclasses.replace(_judgement("nearest"), sizes=(20,))
    for name in ("once", "again"):
        folder, failed = judge(one, tmp_path / name, workers=1)
        (cell,) = kept(folder, one)
        assert not failed
        found.append({name: value for name, value in cell.items() if name not in ("fit_s", "imagine_s_per_1000")})
        study._data.cache_clear()
        study._prepared.cache_clear()
    assert found[0] == found[1]


def test_nonsense_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="No world model 'oracle'"):
        Judgement(task="pick_place", models=("oracle",))
    with pytest.raises(InvalidValueError, match="ascending numbers"):
        Judgement(task="pick_place", models=("copy",), sizes=(30, 20))
    with pytest.raises(InvalidValueError, match=r"hide or delay a part .* without the dials gesture and lag"):
        Judgement(task="arrows:cubes=2,lag=1", models=("copy",))
    with pytest.raises(
        InvalidValueError, match=r"No model of \('copy', 'structured'\) reads latents, which pick_place-"
    ):
        Judgement(task="pick_place", models=("copy", "structured"), encoder="pick_place-mild")
    with pytest.raises(InvalidValueError, match="samples is 0"):
        Judgement(task="pick_place", models=("copy",), samples=0)
    with pytest.raises(InvalidValueError, match=r"seeds is \(0, 1, 0\); give each seed once"):
        Judgement(task="pick_place", models=("copy",), seeds=(0, 1, 0))
    twice = ("mdn_thesis:model.members=2,model.dropout=0.1", "copy", "mdn_thesis:model.dropout=0.1,model.members=2")
    for models in (("copy", "exact", "copy"), twice):
        with pytest.raises(InvalidValueError, match="give each world model or run once"):
            Judgement(task="pick_place", models=models)


def test_two_judges_at_once_train_one_reader_and_see_it_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, trained = registry.task("pick_place"), []

    class Slow(BlindReader):
        def content(self) -> bytes:
            return b"whole"

    def train(*_: object) -> Slow:
        trained.append(threading.get_ident())
        time.sleep(0.2)
        return Slow(4)

    code = SimpleNamespace(train_reader=train, load_reader=lambda spec, path: path.read_bytes())
    monkeypatch.setattr(registry, "load", lambda name: code)
    monkeypatch.setattr(study, "reader_errors", lambda *_: {})
    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(study._reader, spec, "clean", tmp_path) for _ in range(2)]
    assert [job.result() for job in jobs] == [b"whole", b"whole"]
    assert len(trained) == 1


def test_a_half_written_reader_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "reader.safetensors").write_bytes(b"half")
    with pytest.raises(ArtefactError, match=r"reader\.safetensors is not the judge's reader; remove it, and the same"):
        study._reader(registry.task("pick_place"), "clean", tmp_path)


def test_models_see_through_the_given_encoder_if_they_read_what_it_gives() -> None:
    judged = Judgement(task="pick_place", models=("gaussian", "structured"), encoder="pick_place-mild")
    spec, seeds = registry.task("pick_place"), SeedTree(1000)
    gallery = Gallery(spec, "clean")
    prices = [study.make(name, spec, gallery, "clean", seeds, judged.encoder)[1] for name in judged.models]
    assert [price["encoder"] for price in prices] == ["pick_place-mild", "pick_place-clean-codes"]
    assert judged.folder_name != dataclasses.replace(judged, encoder=None).folder_name
