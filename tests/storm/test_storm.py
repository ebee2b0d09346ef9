"""A storm: deaths and damages by the thousand, at every door; nothing is silent, nothing raw. ``make storm`` runs it.

Each test prints its counts. Random numbers come from a generator with a fixed seed.
``-k few`` chooses one death a door.
"""

from __future__ import annotations

import functools
import itertools
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_reader import NO_ERRORS
from imagine_bench.agents.encoders.cli import retrain
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench.agents.encoders.recipes import Recipe
from imagine_bench_motion.control import datasets
from imagine_bench_motion.judge import judgement as motions
from small_runs import FORMATS, Inline, do, exact, final_arrays, measured, small, written
from storms import damages, facts, interrupted, one_sentence

from imagine_bench import registry
from imagine_bench.arrays import content_hash
from imagine_bench.data.folder import read_apart, read_dataset
from imagine_bench.data.motion import read_demonstrations
from imagine_bench.errors import ImagineBenchError
from imagine_bench.judge.judgement import Judgement, judge, kept, shown
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.store.encoders import bundled, kind, own
from imagine_bench.store.files import make_folder
from imagine_bench.store.loading import archive_files, load_so_far
from imagine_bench.sweep.grid import Study, Variant, read_grid
from imagine_bench.sweep.run import run_study

pytestmark = pytest.mark.slow
_FEW: dict[str, Any] = {"budgets": (2, 4), "evaluation_episodes": 2}
_CODES = bundled()["arrow_puzzle-clean-codes"]
_WORLD = "arrows:cubes=1"
_RECIPE = Recipe(
    name="small", architecture="image", widths=(4,), frames=8, held_out_frames=8, steps=2, batch=4, probe_steps=2
)
_STUDY = Study(
    name="small", question="?", budgets=(2,), seeds=(1000,), evaluation_episodes=2,
    variants=(Variant(name="base", agent="random"), Variant(name="other", agent="random")), preset="smoke",
)  # fmt: skip
_JUDGEMENT = Judgement(task=_WORLD, models=("copy",), sizes=(5, 20), seeds=(0,), samples=1)
_OF_MOTIONS = motions.MotionJudgement(
    task="arrow_puzzle", models=("no_change",), sizes=(2,), seeds=(0,), pairs=1, chains=1
)
_TIMED = ("fit_s", "imagine_s_per_1000")


def untimed(cell: dict[str, Any]) -> dict[str, Any]:
    return {name: exact(value) for name, value in cell.items() if name not in _TIMED}


# --- deaths ------------------------------------------------------------------------------------------------------


def a_run(folder: Path) -> object:
    result = do(folder, every_s=0.0, **_FEW)
    rows = [{**row, "beliefs": None} for row in measured(result)]
    return rows, exact([result.training_success, result.training_length]), exact(final_arrays(folder))


def a_dataset(folder: Path, format: str) -> object:
    """A dataset there, written unless it is there, and its content."""
    if not (folder / "set").exists():
        written(folder / "set", format, episodes=2)
    found = read_dataset(folder / "set")
    return found.episodes.hash, exact(read_apart(found))


def demonstrations_of(folder: Path, format: str) -> object:
    """Demonstrations there, collected unless they are there, and their content, which replays."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets, "work_through", in_this_process)
        if not (folder / "set").exists():
            what: dict[str, Any] = {"policy": "mixed", "episodes": 2, "seed": 0, "appearance": "clean", "size": 32}
            datasets.collect("arrow_puzzle_easy", **what, format=format, folder=folder / "set", workers=1)
    found = read_demonstrations(folder / "set")
    return datasets.verify(found), found.card["content"], [content_hash(dict(each)) for each in found]


def in_this_process(function: Any, items: Any, *, on_end: Any, **_: object) -> None:
    """Items one after another, so that the files of all are written where the test counts them."""
    for item in items:
        on_end(item, function(item, lambda _: None))


def an_encoder(folder: Path) -> object:
    """The latents of a black frame by a world's own encoder, which is trained once into the cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IMAGINE_BENCH_CACHE", str(folder))
        path = own(registry.task(_WORLD), "clean")
    assert json.loads(path.with_suffix(".json").read_text()) and path.with_suffix(".png").is_file()
    return exact(Encoder.load(path).encode(np.zeros((1, 64, 64, 3), np.uint8))[0].numpy())


def a_sweep(folder: Path) -> object:
    return [exact(line.success) for line in run_study(_STUDY, "arrow_puzzle", root=folder, launcher=Inline())]


def a_judgement(folder: Path) -> object:
    place, failed = judge(_JUDGEMENT, folder, workers=1)
    if failed:  # in a sentence each; the same command again makes what is missing
        raise ImagineBenchError("; ".join(failed))
    images = [value for value in shown(place, _JUDGEMENT)["copy"].values() if isinstance(value, np.ndarray)]
    return list(map(untimed, kept(place, _JUDGEMENT))), exact(images)


def a_judgement_of_motions(folder: Path) -> object:
    for kept_in_memory in (motions.stage, motions.data_of):
        kept_in_memory.cache_clear()
    place, failed = motions.judge(_OF_MOTIONS, folder, workers=1)
    assert not failed
    return list(map(untimed, motions.judged(_OF_MOTIONS, place)))


SETS: dict[str, Callable[[Path], object]] = {
    **{format: functools.partial(a_dataset, format=format) for format in FORMATS},
    **{f"motion {format}": functools.partial(demonstrations_of, format=format) for format in FORMATS},
}
STEPS = {"run": 1, "encoder": 1, "sweep": 3, "judge": 3, "motion judge": 2, **dict.fromkeys(FORMATS, 1)}
"""How many file operations lie between two deaths; 4 of a set of motions."""
DEATHS: dict[str, Callable[[Path], object]] = {
    **SETS,
    "run": a_run,
    "encoder": an_encoder,
    "sweep": a_sweep,
    "judge": a_judgement,
    "motion judge": a_judgement_of_motions,
}
ENDS = [*itertools.product(DEATHS, ("kill", "full disk")), ("run", "death"), ("motion npz", "death")]


@pytest.fixture
def _cheap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Encoders of two steps; and a reader in the cache that takes all for the same, so that none is trained."""

    def train(spec: Any, **settings: Any) -> str:
        return retrain(spec, **{**settings, "recipe": _RECIPE})

    monkeypatch.setattr("imagine_bench.agents.encoders.cli.retrain", train)
    code = registry.load("imagine_bench.agents.world_models.reader")

    def trained(spec: Any, appearance: str) -> Any:
        reader = code.Reader(tuple(map(len, spec.macrostate_values)))
        for parameter in reader.network.parameters():
            parameter.data.zero_()
        reader.references = parameter.new_zeros(1, 1024)
        return reader

    monkeypatch.setattr(code, "train_reader", trained)
    monkeypatch.setattr("imagine_bench.judge.reading.reader_errors", lambda *_: NO_ERRORS)
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path / "cache"))


@pytest.mark.usefixtures("_cheap")
@pytest.mark.parametrize("share", ["few", "all"])
@pytest.mark.parametrize(("door", "how"), ENDS)
def test_what_was_ended_anywhere_is_whole_or_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], door: str, how: str, share: str
) -> None:
    act = DEATHS[door]
    wanted = act(tmp_path / "whole")
    deaths = 0
    for folder in interrupted(
        tmp_path, monkeypatch, how, act, (4,) if share == "few" else itertools.count(0, STEPS.get(door, 4))
    ):
        deaths += 1
        left = {path.name for path in folder.glob("*")} - {"set"} if door in SETS else set()
        assert all(how == "kill" and name.startswith(".set.") for name in left) and len(left) <= 1, (folder, left)
        assert act(folder) == wanted, folder
        assert door != "run" or not list(folder.rglob("*partial*")), folder
    with capsys.disabled():
        print(f"\nstorm: {door}: {deaths} file operations ended by {how}, 0 differing bits")
    assert share == "few" or deaths > (50 if door == "run" else 5)


# --- damages -----------------------------------------------------------------------------------------------------


def of_encoder(folder: Path) -> object:
    path = folder / "mine.safetensors"
    found = Encoder.load(path)
    states = [*found.network.state_dict().values(), *found.probe.state_dict().values()]
    return kind(path), found.card, [state.numpy().tobytes() for state in states]


def of_judgement(folder: Path) -> object:
    found = shown(folder / _JUDGEMENT.folder_name, _JUDGEMENT)["copy"]
    return kept(folder / _JUDGEMENT.folder_name, _JUDGEMENT), [each for each in found.values() if np.ndim(each)]


def of_going_on(folder: Path) -> object:
    """A copy of an unfinished run is finished, with the same weights."""
    with tempfile.TemporaryDirectory() as copy:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        do(Path(copy), **_FEW, recorded_episodes=1)
        return exact(final_arrays(Path(copy)))


BENCHES: dict[str, Callable[[Path], object]] = {
    "bench": lambda folder: facts(load_bench(folder)),
    "unfinished bench": lambda folder: facts(load_so_far(folder)),
}
DAMAGED: dict[str, Callable[[Path], object]] = {
    **SETS,
    **BENCHES,
    "unfinished run": of_going_on,
    "encoder": of_encoder,
    "judge": of_judgement,
    "kept": lambda folder: [run.checkpoints for run in load_so_far(folder).runs],
    "grid": lambda folder: read_grid(folder / "mine.toml"),
}
_GRID = 'question = "?"\nbudgets = [5]\nseeds = [1000]\n\n[[variants]]\nname = "a"\nagent = "random"\n'
_WRITTEN_BY_PEOPLE = ("results.csv", "mine.toml")
"""Files without a digest: a changed value is taken as it is written, or refused in one sentence."""


def _benched(folder: Path, door: str) -> list[Path]:
    """The files of a bench, or of a part of one, at a folder."""
    result = bench(small(**_FEW, recorded_episodes=int(door != "kept")), {}, root=folder.parent, launcher=Inline())
    if door == "kept":
        make_folder(folder)
        for name, text in archive_files(result).items():
            (folder / name).write_text(text)
        return [folder / "results.csv", folder / "bench.json"]
    run = result.folder / "table" / "seed_0"
    if door != "bench":
        for name in ("DONE", "imagined.npz", "recording.rrd"):
            (run / name).unlink()
    (run if door == "unfinished run" else result.folder).rename(folder)
    return sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".lock"))


def _fill(folder: Path, door: str) -> list[Path]:
    """The files of a door that are damaged."""
    if door in SETS:
        SETS[door](folder)
        return sorted(path for path in folder.rglob("*") if path.is_file())
    if door in (*BENCHES, "unfinished run", "kept"):
        return _benched(folder, door)
    if door == "judge":
        place, _ = judge(_JUDGEMENT, folder, workers=1)
        return sorted(place.glob("copy-seed*"))
    make_folder(folder)
    (folder / "mine.toml").write_text(_GRID)
    Encoder.load(_CODES).save(folder / "mine.safetensors")  # with its digest, which the bundled ones are older than
    return [folder / ("mine.toml" if door == "grid" else "mine.safetensors")]


@pytest.mark.usefixtures("_cheap")
@pytest.mark.parametrize("door", DAMAGED)
def test_every_region_of_every_file_may_be_damaged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], door: str
) -> None:
    folder, look = tmp_path / "there", DAMAGED[door]
    files = _fill(folder, door)
    before, counts, rng = repr(look(folder)), Counter[str](), np.random.default_rng(0)
    every = 1 if door in BENCHES else 7 if door == "unfinished run" else 1 + len(files) // 4
    for path in files:
        content = path.read_bytes()
        for damaged in [each for each in damages(content, rng) if each != content][::every]:
            path.write_bytes(damaged)
            try:
                same = repr(look(folder)) == before
            except ImagineBenchError as error:
                said = one_sentence(error)
                assert door not in BENCHES or path.name in said or path.parent.name in said, (path, said)
                counts["refused"] += 1
            else:
                assert same or path.name in _WRITTEN_BY_PEOPLE, (path, "silent")
                counts["the same" if same else "taken as written"] += 1
            finally:
                path.write_bytes(content)
    with capsys.disabled():
        print(f"\nstorm: damages of {door}: {dict(counts)}, 0 raw")
    assert counts["refused"] > (100 if door in BENCHES else 10)
