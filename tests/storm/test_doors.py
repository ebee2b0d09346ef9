"""The same storm over the other doors: datasets, encoders and their cache, sweeps, judgements, worlds, lanes.

``-k few`` chooses one or two deaths a door.
"""

from __future__ import annotations

import functools
import io
import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from fake_reader import NO_ERRORS
from imagine_bench.agents.encoders.cli import retrain
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench.agents.encoders.recipes import Recipe
from imagine_bench_motion.control import datasets
from small_runs import FORMATS, Inline, collected, exact, small, written
from storms import as_word, damages, hostile, interrupted, one_sentence

from imagine_bench import registry
from imagine_bench.arrays import content_hash
from imagine_bench.cli import exit_code
from imagine_bench.data.folder import read_apart, read_dataset
from imagine_bench.data.motion import read_demonstrations
from imagine_bench.errors import ImagineBenchError
from imagine_bench.judge.judgement import Judgement, judge, kept, shown
from imagine_bench.running.bench import bench
from imagine_bench.store.encoders import bundled, kind, own
from imagine_bench.store.files import make_folder, write_json
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
_TIMED = ("fit_s", "imagine_s_per_1000")


# --- deaths ------------------------------------------------------------------------------------------------------


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
    return Encoder.load(path).encode(np.zeros((1, 64, 64, 3), np.uint8))[0].numpy().tobytes()


def a_sweep(folder: Path) -> object:
    return [line.success.tobytes() for line in run_study(_STUDY, "arrow_puzzle", root=folder, launcher=Inline())]


def a_judgement(folder: Path) -> object:
    place, failed = judge(_JUDGEMENT, folder, workers=1)
    if failed:  # in a sentence each; the same command again makes what is missing
        raise ImagineBenchError("; ".join(failed))
    cells = [{name: value for name, value in cell.items() if name not in _TIMED} for cell in kept(place, _JUDGEMENT)]
    images = {name: value for name, value in shown(place, _JUDGEMENT)["copy"].items() if name not in _TIMED}
    return json.dumps(cells), [exact(value) for value in images.values() if isinstance(value, np.ndarray)]


DEATHS: dict[str, tuple[Callable[[Path], object], int]] = {
    **{format: (functools.partial(a_dataset, format=format), 1) for format in FORMATS},
    **{f"motion {format}": (functools.partial(demonstrations_of, format=format), 4) for format in FORMATS},
    "encoder": (an_encoder, 1),
    "sweep": (a_sweep, 3),
    "judge": (a_judgement, 3),
}
"""Each door, and how many file operations lie between two deaths."""


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
@pytest.mark.parametrize("how", ["kill", "full disk"])
@pytest.mark.parametrize("door", DEATHS)
def test_what_was_ended_anywhere_is_whole_or_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], door: str, how: str, share: str
) -> None:
    act, step = DEATHS[door]
    wanted = act(tmp_path / "whole")
    deaths = 0
    places: Iterator[int] | tuple[int, ...] = (4,) if share == "few" else itertools.count(0, step)
    for folder in interrupted(tmp_path, monkeypatch, how, act, places):
        deaths += 1
        assert act(folder) == wanted, folder
    with capsys.disabled():
        print(f"\nstorm: {door}: {deaths} file operations ended by {how}, 0 differing bits")
    assert share == "few" or deaths > 5


# --- damages -----------------------------------------------------------------------------------------------------


def of_encoder(folder: Path) -> object:
    path = folder / "mine.safetensors"
    found = Encoder.load(path)
    states = [*found.network.state_dict().values(), *found.probe.state_dict().values()]
    return kind(path), found.card, [state.numpy().tobytes() for state in states]


def of_judgement(folder: Path) -> object:
    found = shown(folder / _JUDGEMENT.folder_name, _JUDGEMENT)["copy"]
    return kept(folder / _JUDGEMENT.folder_name, _JUDGEMENT), [each for each in found.values() if np.ndim(each)]


DAMAGED: dict[str, Callable[[Path], object]] = {
    **{format: functools.partial(a_dataset, format=format) for format in FORMATS},
    **{f"motion {format}": functools.partial(demonstrations_of, format=format) for format in FORMATS},
    "encoder": of_encoder,
    "judge": of_judgement,
    "kept": lambda folder: [run.checkpoints for run in load_so_far(folder).runs],
    "grid": lambda folder: read_grid(folder / "mine.toml"),
}
_GRID = 'question = "?"\nbudgets = [5]\nseeds = [1000]\n\n[[variants]]\nname = "a"\nagent = "random"\n'
_WRITTEN_BY_PEOPLE = ("results.csv", "mine.toml")
"""Files without a digest: a changed value is taken as it is written, or refused in one sentence."""


def _fill(folder: Path, door: str) -> list[Path]:
    """The files of a door that are damaged."""
    if door.rsplit(maxsplit=1)[-1] in FORMATS:
        DAMAGED[door](folder)
        return sorted(path for path in folder.rglob("*") if path.is_file())
    if door == "judge":
        place, _ = judge(_JUDGEMENT, folder, workers=1)
        return sorted(place.glob("copy-seed*"))
    make_folder(folder)
    if door == "kept":
        result = bench(small(**_FEW), {}, root=folder.parent / "runs", launcher=Inline())
        for name, text in archive_files(result).items():
            (folder / name).write_text(text)
        return [folder / "results.csv", folder / "bench.json"]
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
    for path in files:
        content = path.read_bytes()
        for damaged in [each for each in damages(content, rng) if each != content][:: 1 + len(files) // 4]:
            path.write_bytes(damaged)
            try:
                same = repr(look(folder)) == before
            except ImagineBenchError as error:
                one_sentence(error)
                counts["refused"] += 1
            else:
                assert same or path.name in _WRITTEN_BY_PEOPLE, (path, "silent")
                counts["the same" if same else "taken as written"] += 1
            finally:
                path.write_bytes(content)
    with capsys.disabled():
        print(f"\nstorm: damages of {door}: {dict(counts)}, 0 raw")
    assert counts["refused"] > 10


# --- hostile inputs ----------------------------------------------------------------------------------------------


_BEGINS = 77
"""The exit code of a command that would begin its work: its options have been accepted."""
_WORK = (
    "imagine_bench.cli.tools.collect",
    "imagine_bench_motion.control.datasets.collect",
    "imagine_bench.testing.physics._segments",
    "imagine_bench.cli.judging.judge",
    "imagine_bench.cli.benches.run_study",
    "imagine_bench.cli.benches.run_suite",
    "imagine_bench.agents.encoders.cli.train_encoder",
)
_FLAGS = {
    "dataset": ["policy", "format", "seed", "execution", "appearance", "motion-hz", "episodes", "describe"],
    "dataset ArrowPuzzleMotion": ["policy", "format", "seed", "size", "appearance", "episodes", "workers", "describe"],
    "check ArrowPuzzleMotion --physics": ["turns", "trials", "random", "appearances", "out"],
    "judge": ["models", "sizes", "seeds", "samples", "appearance", "policy", "encoder", "workers", "order"],
    "sweep": ["file", "variants", "experiment", "agents", "seeds", "workers", "launcher"],
    "encoder": ["appearance", "recipe", "seed", "steps", "batch", "latents", "device"],
}


def a_lane(rng: np.random.Generator, lanes: Any) -> None:
    """A reset or a step of lanes with values that nobody means."""
    lanes.reset(seed=0)
    if rng.random() < 0.5:
        lanes.step(hostile(rng))
    elif rng.random() < 0.5:
        lanes.reset(seed=hostile(rng))
    else:
        lanes.reset(seed=0, options={"macrostate": hostile(rng)} if rng.random() < 0.5 else hostile(rng))


def a_world(rng: np.random.Generator) -> None:
    options = ["cubes", "slip", "goal", "forbid", "lag", "gesture", "coupling", "shuffle", "horizon", "none"]
    registry.task(f"arrows:{rng.choice(options)}={as_word(hostile(rng))}")


def a_grid(rng: np.random.Generator, folder: Path) -> None:
    """A study in a file, whose world is one in a file, too."""
    variant: dict[str, Any] = {"name": "a", "agent": "random", "world": {"appearance": "mild", "queries": 1}}
    study: dict[str, Any] = {"question": "?", "budgets": [2], "variants": [variant]}
    _read(folder, study)
    where = [study, variant, variant["world"]][int(rng.integers(3))]
    where[str(rng.choice([*where, "more"]))] = hostile(rng)
    _read(folder, study)


def _read(folder: Path, study: dict[str, Any]) -> None:
    write_json(folder / "mine.json", json.loads(json.dumps(study, default=str)))
    read_grid(folder / "mine.json")


def a_command(rng: np.random.Generator, root: Path) -> str:
    """A command line of a door; it says no in a sentence or in tyro's own box."""
    name = str(rng.choice(list(_FLAGS)))
    door = name.split() if " " in name else [name, "arrow_puzzle"]
    words = [*door, "--out", str(root / "out"), f"--{rng.choice(_FLAGS[name])}", as_word(hostile(rng))]
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stderr", said)
        patch.setattr(sys, "stdout", said)
        try:
            code = exit_code(words)
        except SystemExit as ended:
            code = int(ended.code or 0)
    if code == _BEGINS:
        return "passed"
    text = said.getvalue()
    assert code in (1, 2), f"silent: {words}"
    assert text and "Traceback" not in text and "\x1b[31mred" not in text, (words, text[:500])
    return "refused"


def _begin(*_: Any, **__: Any) -> Any:
    raise SystemExit(_BEGINS)


@pytest.mark.parametrize("share", ["few", "all"])
def test_hostile_inputs_of_the_other_doors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, share: str
) -> None:
    collected()
    for work in _WORK:
        monkeypatch.setattr(work, _begin)
    lanes = gymnasium.make_vec("imagine_bench/ArrowPuzzle-vector-v0", 3, execution="kinematic")
    storms: dict[str, Callable[[np.random.Generator], str | None]] = {
        "lanes": lambda rng: a_lane(rng, lanes),
        "worlds": a_world,
        "grids": lambda rng: a_grid(rng, tmp_path),
        "commands": lambda rng: a_command(rng, tmp_path),
    }
    rng, counts = np.random.default_rng(0), Counter[str]()
    for name, storm in storms.items():
        for _ in range(10 if share == "few" else 300):
            try:
                how = storm(rng) or "passed"
            except ImagineBenchError as error:
                one_sentence(error)
                how = "refused"
            counts[f"{name} {how}"] += 1
    lanes.close()
    with capsys.disabled():
        print(f"\nstorm: {counts.total()} hostile inputs of the other doors: {dict(counts)}, 0 raw")
