"""Models of other packages, and trained agents, are judged without a change here; kept fits are not done again."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import itertools
import json
import re
import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from guest_packages import Guests
from kept import ROOT
from recordings import contents, logged, times, view_names
from report_pages import page_in_words
from same_values import assert_same
from whole_outputs import Expected, short

import imagine_bench
from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError
from imagine_bench.judge import judgement
from imagine_bench.judge.judgement import Judgement, ModelFit, judge, kept, shown
from imagine_bench.judge.scores import FORMER
from imagine_bench.judge.truth import shares
from imagine_bench.recording.filmstrips import Tile, png, sheet
from imagine_bench.report.judge import COLUMNS, Judged, in_short, judged, judgement_page
from imagine_bench.report.page import DASH
from imagine_bench.rules import outcomes_by_depth
from imagine_bench.store.files import read_arrays, read_sealed, sealed, write_arrays, write_json

pytestmark = pytest.mark.usefixtures("blind")
_PYPROJECT = """
[project]
name = "their_models"
version = "1.0"
[project.entry-points."imagine_bench.world_models"]
nearest = "their_models:ENTRY"
raises = "their_models:RAISES"
late = "their_models:LATE"
unmade = "their_models:UNMADE"
spy = "their_models:SPY"
exits = "their_models:EXITS"
dies = "their_models:DIES"
cheat = "their_models:CHEAT"
"""
_MORE = """
import gc, os, sys
from pathlib import Path
from imagine_bench.interfaces.model import LearnedGraph
from imagine_bench.agents.world_models.limits import Exact

class Spy(Nearest):
    def imagine(self, frames, actions, samples, rng):
        given = Imagined(pictures=frames[:, None, -1:].copy(), probabilities=np.ones((len(frames), 1, 1)))
        held, frame = gc.get_objects(), sys._getframe()
        while frame is not None:
            held += frame.f_locals.values()
            frame = frame.f_back
        kinds = {type(each).__name__ for each in held}
        found = kinds & {"EvalSet", "AskedWorld", "TaskSpec", "RenderedFrameIndex", "PickPlaceRules"}
        try:
            import imagine_bench.tasks.pick_place.rules
            found.add("rules")
        except ModuleNotFoundError:
            pass
        log = Path(os.readlink("/proc/self/fd/1"))  # in the judgement's folder; beside it lies another one
        if [name for name in os.listdir("/proc") if name.isdigit()] == ["1"]:  # it is closed off
            found |= {path.name for path in log.parent.parent.glob("*/*")}
        if actions[:8, -1].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]:
            found.add("questions in their order")
        if found:
            raise RuntimeError(f"it found {sorted(found)}")
        frames[...] = 0
        actions[...] = 0
        depth = actions.shape[1] - frames.shape[1] + 1
        pictures = np.broadcast_to(given.pictures, (len(frames), 1, depth, 64, 64, 3))
        return Imagined(pictures=pictures, probabilities=np.ones((len(frames), 1, depth)))

    def factor_graph(self, frames):
        return LearnedGraph(values=np.ones((len(frames), 1), dtype=int), edges=np.ones((4, 1, 1), dtype=bool))

class Exits(Nearest):
    def fit(self, dataset, rng):
        print("its last words\\x1b[31m")
        sys.exit(0)

class Dies(Nearest):
    def imagine(self, frames, actions, samples, rng):
        os._exit(0)

class Cheat(Exact):
    def fit(self, dataset, rng):
        dataset.frames[...] = 0

    def imagine(self, frames, actions, samples, rng):
        found = super().imagine(frames, actions, samples, rng)
        frames[...] = 0
        return found

def spy(context):
    return Spy()

def exits(context):
    return Exits()

def dies(context):
    return Dies()

SPY = WorldModelEntry(make="their_models:spy", title="spy")
EXITS = WorldModelEntry(make="their_models:exits", title="exits")
DIES = WorldModelEntry(make="their_models:dies", title="dies")
CHEAT = WorldModelEntry(make="their_models:Cheat", title="cheat", privileged=True)

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


_MODELS = ("nearest", "spy", "cheat", "raises", "late", "unmade", "exits", "dies", "copy", "exact")
_LATENTS = "pick_place-mild"
_COMMAND = "judge --task pick_place --workers 1 --sizes 60 --seeds 1000 --samples 2".split()


class Said(NamedTuple):
    """A judgement by the command: its folder, its exit status and its output."""

    folder: Path
    status: int
    out: str
    err: str


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Said]:
    """The documentation's model, and some that fail, in a package, are judged beside the two ends of the scale.

    The command judges all after 60 transitions; three of them are then judged after 20, too.
    """
    page = (ROOT / "docs" / "how_to" / "world_model.md").read_text()
    code = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[0].replace("nearest:make", "their_models:make")
    folder, root = tmp_path_factory.mktemp("package"), tmp_path_factory.mktemp("judge")
    (folder / "pyproject.toml").write_text(_PYPROJECT)
    (folder / "their_models.py").write_text(code + _MORE)
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        guests = Guests(folder, patch)
        guests.add(folder)
        (root / "another").mkdir()
        for name in (".lock", "its truth"):
            (root / "another" / name).touch()
        status = main([*_COMMAND, "--out", str(root), "--models", *_MODELS])
        (made,) = (path.parent for path in root.glob("*/judgement.json"))
        few = _of("nearest", "copy", "exact")
        assert [judgement.carry_out(few, made, ModelFit(model, 1000, 20)) for model in few.models] == [""] * 3
        yield Said(made, status, out.getvalue(), err.getvalue())
        guests.forget()


def _of(*models: str) -> Judgement:
    return Judgement(task="pick_place", models=models, sizes=(20, 60), seeds=(1000,), samples=2)


def _cells(said: Said, *models: str) -> dict[tuple[str, int], dict[str, Any]]:
    return {(cell["model"], cell["transitions"]): cell for cell in kept(said.folder, _of(*models))}


@pytest.fixture
def copied(said: Said, tmp_path: Path) -> Path:
    """A copy of the judgement, which a test may change."""
    folder = tmp_path / said.folder.name
    shutil.copytree(said.folder, folder)
    return folder


def test_what_models_do_wrong_is_a_sentence_each(said: Said) -> None:
    assert said.status == 1
    for sentence in (
        "World model raises: fit() failed (RuntimeError: out of luck).",
        "World model late: imagine() failed (KeyError: 'depth').",
        "World model unmade (their_models:unmade) cannot be used (AttributeError: ",
        "World model exits: fit() failed (SystemExit: 0).",
        "World model dies: imagine() failed: its process ended itself with exit code 0.",
    ):
        assert sentence in said.err
    assert "Traceback" not in said.err
    assert not list(said.folder.glob("raises-*.json"))
    assert [path.read_text() for path in sorted(said.folder.glob("*.log"))] == ["its last words\\x1b[31m\n"]


def test_a_model_finds_no_truth_and_changes_nothing_for_the_next(said: Said) -> None:
    """The spy says, too, that nothing changes; it and *cheat* spoil all that they are handed."""
    scores = _cells(said, "spy", "cheat", "copy", "exact")
    for one, other in (("spy", "copy"), ("cheat", "exact")):
        for name in ("total_variation", "tv_by_depth", "after_the_end", "value_loss", "data"):
            assert scores[one, 60][name] == scores[other, 60][name], (one, name)
    assert not any("factor graph" in scores[other, 60]["worlds"] for other in ("cheat", "copy", "exact"))
    drawn = scores["spy", 60]["worlds"]["factor graph"]  # its factor shows nothing, so each of its 4 edges is wrong
    assert drawn["edges_wrong"] == 4 + drawn["edges"] == 32
    spent = [each["imagine_s_per_1000"] for each in scores.values()]
    assert 1e-3 < min(spent) <= max(spent) < 10.0, "CPU seconds of a thousand macro-actions, each an image of 12 kB"
    learned = judgement.data_of(_of(*_MODELS), said.folder, 1000).episodes
    assert learned.frames.any(axis=(1, 2, 3)).all(), "the data that this process holds are as they were"


def test_a_loaded_judgement_marks_privileged_models(said: Said) -> None:
    report = said.folder / "report"
    page = (report / "index.html").read_text()
    found = imagine_bench.load(said.folder)
    assert found.tables["scores"] == (report / "scores.csv").read_text()
    assert found.verdict() and found.verdict() in page + repr(found)
    rows = list(csv.DictReader(io.StringIO(found.tables["scores"])))
    assert len(found.frame()["model"]) == len(rows)
    marked = {row["model"] for row in rows if row["privileged"] == "true"}
    assert marked == {"exact", "cheat"} < {row["model"] for row in rows}
    for text in (said.out, page, "\n".join(view_names(said.folder / "judgement.rrd"))):
        assert "cheat (privileged)" in text and "exact (privileged)" in text
        assert "frame (privileged)" not in text


@pytest.mark.usefixtures("own_names")
def test_a_cell_says_whether_its_model_was_privileged(said: Said) -> None:
    entry = registry.world_model_entry("cheat")
    assert _cells(said, "cheat")
    registry.WORLD_MODELS["cheat"] = dataclasses.replace(entry, privileged=False)
    with pytest.raises(ArtefactError, match="cheat was privileged when it was judged"):
        _cells(said, "cheat")


def test_a_command_that_judges_nothing_leaves_the_report_of_others(said: Said) -> None:
    before = {path: path.read_bytes() for path in [said.folder / "judgement.json", *said.folder.glob("report/*")]}
    assert main([*_COMMAND, "--out", str(said.folder.parent), "--models", "unmade"]) == 1
    assert {path: path.read_bytes() for path in before} == before


def test_cells_of_other_readers_or_policies_are_not_compared(copied: Path) -> None:
    cell = copied / ModelFit("copy", 1000, 60).file
    before = read_sealed(cell, "a cell")
    assert len(before["policies"]) == 12
    assert before["policies"] == json.loads((copied / "judgement.json").read_text())["policies"]
    for name, words in (("reader", "read by different readers"), ("policies", "judged by different policies")):
        write_json(cell, sealed({**before, name: "0123456789ab"}))
        with pytest.raises(ArtefactError, match=rf"{words} \(.*0123456789ab.*\) and cannot be compared"):
            kept(copied, _of("copy", "exact"))
        assert kept(copied, _of("exact"))
    images = copied / ModelFit("exact", 1000, 60).images
    write_arrays(images, {name: np.zeros_like(array) for name, array in read_arrays(images).items()})
    with pytest.raises(ArtefactError, match="is damaged: it is not as it was written"):
        shown(copied, _of("exact"))


def test_images_are_those_of_the_first_seed(copied: Path) -> None:
    first, second = (ModelFit("exact", seed, 60) for seed in (1000, 1001))
    write_json(copied / second.file, sealed({**read_sealed(copied / first.file, "a cell"), "seed": 1001}))
    shutil.copy(copied / first.images, copied / second.images)
    for seeds in ((1000, 1001), (1001,)):
        one = dataclasses.replace(_of("exact"), seeds=seeds)
        assert shown(copied, one)["exact"]["seed"] == seeds[0]


def test_kept_images_show_their_questions_and_the_likeliest_outcomes(said: Said) -> None:
    world = judgement.prepare(_of("nearest", "copy", "exact"), said.folder)
    found = shown(said.folder, _of("copy", "exact"))
    for model, kind in itertools.product(found, ("worst", "futures", "after")):
        parts = [found[model][f"{kind}_{part}"] for part in ("before", "actions", "imagined", "real", "right")]
        for before, actions, imagined, real, right in zip(*parts, strict=True):
            state = world.index.shows(before)
            assert state is not None
            for step, outcomes in enumerate(outcomes_by_depth(world.spec.rules, state, actions.tolist())):
                likely = shares(outcomes)
                most = [world.index.frame(each) for each, share in likely.items() if share == max(likely.values())]
                assert any(np.array_equal(real[step], frame) for frame in most)
                assert bool(right[step]) == (world.index.shows(imagined[step]) in likely)
                assert model == "exact" or np.array_equal(imagined[step], before)
    page = judgement_page(judged(said.folder, _of("copy", "exact")))
    drawn = {image.name: image.png for section in page.sections for image in section.images}
    words = {True: "as the rules say", False: "not as the rules say"}
    titles = {"copy": "copy the last frame", "exact": "exact (privileged)"}
    for image, kind, models in (("futures", "futures", titles), ("worst_copy", "worst", ["copy"])):
        actions, befores, reals = (found["copy"][f"{kind}_{part}"] for part in ("actions", "before", "real"))
        names = [world.spec.action_names[action] for action in np.ravel(actions)]
        real = [frame for course in reals for frame in course]  # several of one rollout, or one of each transition
        before = [befores[0], *real[:-1]] if kind == "futures" else befores
        rows = [("before", [*map(Tile, before, names)]), ("real", [*map(Tile, real)])]
        for model in models:
            frames = [frame for course in found[model][f"{kind}_imagined"] for frame in course]
            both = zip(frames, np.ravel(found[model][f"{kind}_right"]).tolist(), strict=True)
            rows.append((titles[model], [Tile(frame, "", words[right], right) for frame, right in both]))
        assert drawn[image] == png(sheet(rows)), image


def test_a_model_whose_code_has_changed_is_judged_anew(copied: Path) -> None:
    cell = ModelFit("nearest", 1000, 20)
    before = read_sealed(copied / cell.file, "a cell")
    package = find_spec("their_models")
    assert package is not None and package.origin is not None and len(before["code"]) == 12
    module = Path(package.origin)
    code = module.read_text()
    module.write_text(f"{code}# another version\n")
    try:
        assert {each["model"] for each in kept(copied, _of("nearest", "copy"))} == {"copy"}
        assert not judgement.carry_out(_of("nearest", "copy", "exact"), copied, cell)
        assert read_sealed(copied / cell.file, "a cell")["code"] != before["code"]
    finally:
        module.write_text(code)


def test_former_names_of_scores_are_read(copied: Path) -> None:
    cell = copied / ModelFit("exact", 1000, 60).file
    before = kept(copied, _of("exact"))
    former = {new: old for old, new in FORMER.items()}
    assert all(former.keys() <= each.keys() for each in before)
    write_json(cell, sealed({former.get(name, name): value for name, value in read_sealed(cell, "a cell").items()}))
    assert not former.keys() & read_sealed(cell, "a cell").keys()
    assert kept(copied, _of("exact")) == before


def test_a_model_of_theirs_is_judged(said: Said) -> None:
    assert "nearest frame" in said.out and "exact" in said.out
    recorded = said.folder / "judgement.rrd"
    assert {"/action", "/real/frame", "/exact/frame", "/nearest/outcomes"} <= contents(recorded).keys()
    assert times(recorded, "/exact/frame", "depth") == set(range(11))
    names = registry.task("pick_place").action_names
    one = shown(said.folder, _of("exact"))["exact"]

    def logged_by_depth(entity: str, column: str) -> list[Any]:
        return [value for _, (value,) in logged(recorded, entity, column, "depth")]

    begun, *actions = logged_by_depth("/action", "TextDocument:text")
    assert begun == "the start"
    assert actions == [f"**{depth}. {names[action]}**" for depth, action in enumerate(one["futures_actions"][0], 1)]
    for name, of in (("real", "real"), ("exact", "imagined")):
        frames = logged_by_depth(f"/{name}/frame", "Image:buffer")
        assert np.array_equal(np.ravel(frames), np.ravel([one["futures_before"][0], *one[f"futures_{of}"][0]]))
        texts = logged_by_depth(f"/{name}/outcomes", "TextDocument:text")
        for text, shares in zip(texts, [{}, *one["futures"][of]], strict=True):
            assert text == "\n".join(f"- {shares[each]:.0%} {each}" for each in sorted(shares, key=shares.get, reverse=True))
    scored = _cells(said, "copy", "exact")
    exact = scored["exact", 60]
    assert [pytest.approx(each) for each in exact["futures"]["real"]] == exact["futures"]["imagined"]
    assert scored["copy", 20]["data"] == exact["data"]
    assert exact["film"] is None, "it overrates nothing"
    film = shown(said.folder, _of("nearest"))["nearest"]
    for course in ("believed", "real"):
        assert len(film[f"film_{course}"]) == 1 + len(film["film"][course]) > 1
    assert (said.folder / "report/film_nearest.png").exists()


_SINCE = re.compile(
    "perfect|unbiased|policy|lift|exploit|film|.*_ruled"
)  # scores that judgements before 2026-11-28 lack


def test_scores_that_an_older_judgement_lacks_are_dashes(said: Said) -> None:
    one = _of("copy", "exact")
    found = Judged(said.folder, one, registry.task(one.task), {})
    for key, cell in _cells(said, *one.models).items():
        found.cells[key] = [{name: value for name, value in cell.items() if not _SINCE.match(name)}]
    (short,) = (
        table for section in judgement_page(found).sections for table in section.tables if table.name == "short"
    )
    columns = dict(zip(short.header, zip(*short.rows, strict=True), strict=True))
    lacking = {COLUMNS[name] for name in COLUMNS if _SINCE.match(name)} & columns.keys()
    assert lacking and all(set(columns[name]) == {DASH} for name in lacking)
    assert DASH not in columns[COLUMNS["total_variation"]]


def test_the_page_of_a_judgement(said: Said, expected: Expected) -> None:
    found = judged(said.folder, _of("nearest", "cheat", "copy", "exact"))
    for cell in itertools.chain(*found.cells.values()):
        cell.update(fit_s=cell["fit_s"] and 1.5, imagine_s_per_1000=2.5)
    page = judgement_page(found)
    words = page_in_words(dataclasses.replace(page, facts={}))
    text = f"{words}\n== terminal\n{page.summary}".replace(str(said.folder), "HERE")
    expected("judgement", short(text), exactly=False)


def test_the_short_table_has_the_most_transitions_in_any_order(said: Said) -> None:
    """Such as where a cell of few transitions was lost, and is made last."""
    found = judged(said.folder, _of("nearest", "copy"))
    turned = dataclasses.replace(found, cells=dict(reversed(found.cells.items())))
    rows, others = (sorted(in_short(each).tables[0].rows) for each in (found, turned))
    assert rows == others and {row[1] for row in rows} == {"60"}


def test_lost_cells_and_images_alone_are_made_anew(copied: Path) -> None:
    """To the same figures, but for times."""
    one, cell, images = (
        _of("nearest", "copy", "exact"),
        ModelFit("nearest", 1000, 20),
        ModelFit("exact", 1000, 60).images,
    )
    before = {path: path.stat().st_mtime_ns for path in copied.glob("*-seed*.json")}
    figures, arrays = read_sealed(copied / cell.file, "a cell"), read_arrays(copied / images)
    (copied / images).unlink()
    with pytest.raises(ArtefactError, match=r"^There is no .*exact-seed1000-60\.npz, .* makes lost ones anew\.$"):
        shown(copied, one)
    (copied / cell.file).unlink()
    judgement.data_of.cache_clear()
    judgement.prepare.cache_clear()
    assert judge(one, copied.parent, workers=1) == (copied, [])
    assert_same(arrays, read_arrays(copied / images))
    again = read_sealed(copied / cell.file, "a cell")
    assert {name for name in figures if figures[name] != again[name]} <= {"fit_s", "imagine_s_per_1000", "seal"}
    made = {path.name for path in before if path.stat().st_mtime_ns != before[path]}
    assert made == {cell.file, images.replace(".npz", ".json")}


def test_a_cell_judged_by_several_has_images_of_the_same_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, cell, at_once = _of("exact"), ModelFit("exact", 1000, 60), threading.Barrier(4)

    def fitted(*_: object) -> tuple[dict[str, object], Arrays]:
        rng = np.random.default_rng(at_once.wait())
        return cell._asdict(), {"futures_before": rng.random(100_000)}

    def written(path: Path, values: object) -> None:
        first = next(order) == 0
        time.sleep(0.3 * first)
        write_json(path, values)

    order = itertools.count()
    monkeypatch.setattr(judgement, "judge_cell", fitted)
    monkeypatch.setattr(judgement, "write_json", written)
    with ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(judgement.carry_out, one, tmp_path, cell) for _ in range(4)]
    assert [job.result() for job in jobs] == [""] * 4
    assert shown(tmp_path, one).keys() == {"exact"}


def test_a_model_whose_encoder_reads_few_frames_is_marked(copied: Path) -> None:
    for path in copied.glob("nearest-*.json"):
        write_json(path, sealed({**read_sealed(path, "a cell"), "encoder_reads": 0.115}))
    assert "(encoder reads 11.5%)" in judgement_page(judged(copied, _of("nearest", "copy"))).summary
