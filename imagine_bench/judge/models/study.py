"""A judgement: models by sizes of data by seeds, each kept in a file of its own, so that it can be taken up again."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.data.folder import Dataset, read_apart, read_dataset, write_dataset
from imagine_bench.errors import ImagineBenchError, InvalidValueError, brief
from imagine_bench.interfaces import AgentContext, State, TaskSpec
from imagine_bench.interfaces.model import WorldModel
from imagine_bench.judge.models import asking
from imagine_bench.judge.models.asking import Answers, Reader, ask, call
from imagine_bench.judge.models.change import Streams, counterfactual_error, noticing, streams_of
from imagine_bench.judge.models.ends import Gallery
from imagine_bench.judge.models.scores import after_the_end, by_depth, one_step_scores, ranking_scores
from imagine_bench.judge.models.trained import TrainedModel, load_model, model_entry, runs_of
from imagine_bench.judge.models.truth import Questions, shares
from imagine_bench.registry.entries import entrant, file_name
from imagine_bench.registry.machine import describe_environment
from imagine_bench.rules import states_of
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.codec import read_arrays, write_arrays
from imagine_bench.store.files import (
    lock,
    make_folder,
    read_json,
    read_sealed,
    reading,
    sealed,
    with_null,
    write_bytes,
    write_json,
)

SIZES = (100, 300, 1_000, 3_000, 10_000)
SAMPLES = 8
_FORMAT = 3
_AFTER = 6  # transitions after the end whose pictures are kept
_PATIENCE_S = 1_800.0  # seconds that a process waits while another makes the data or the reader
_READ = 1_000  # frames that the reader is measured on
_READER = "imagine_bench.agents.world_models.reader"


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """What is judged. InvalidValueError: nothing to judge, or sizes, seeds or samples out of range."""

    task: str
    models: tuple[str, ...]  #: Names, or folders of runs, whose agents are judged as they are
    sizes: tuple[int, ...] = SIZES  #: Transitions of the same data, ascending
    seeds: tuple[int, ...] = (0, 1, 2)
    samples: int = SAMPLES  #: Futures imagined of each question
    appearance: str = "clean"
    policy: str = "random"  #: Who collects the data, as :data:`.running.collect.POLICIES`
    #: A bundled name or a file, for the models that read what it gives; the others see through the task's own
    encoder: str | None = None

    def __post_init__(self) -> None:
        if not self.models or not self.seeds or min(self.seeds) < 0:
            raise InvalidValueError("There is nothing to judge; give at least one model and one seed of at least 0.")
        if len(set(self.seeds)) < len(self.seeds):
            raise InvalidValueError(f"seeds is {brief(self.seeds)}; give each seed once.")
        if len(set(map(_one_name, self.models))) < len(self.models):
            raise InvalidValueError(f"models is {brief(self.models)}; give each world model or run once.")
        if not self.sizes or sorted(set(self.sizes)) != list(self.sizes) or self.sizes[0] < 1:
            raise InvalidValueError(f"sizes is {self.sizes}; give ascending numbers of transitions, at least 1.")
        if not 1 <= self.samples <= 1_000:
            raise InvalidValueError(f"samples is {self.samples}; give 1 to 1,000.")
        for name in self.models:
            model_entry(name)
        object.__setattr__(self, "appearance", appearance_name(self.appearance))
        if registry.task(self.task).sight is not None:
            raise InvalidValueError(
                f"Frames of task {self.task!r} hide or delay a part of the macrostate, and the exact answers are about "
                "all of it. Judge a task without the dials gesture and lag."
            )
        if self.encoder is not None:
            gives = encoders.kind(encoders.resolve(registry.task(self.task), self.appearance, self.encoder))
            if gives not in {model_entry(name).encoder_kind for name in self.models}:
                raise InvalidValueError(f"No model of {self.models} reads {gives}, which {self.encoder} gives.")

    @property
    def cells(self) -> list[Cell]:
        """Every fit that is judged, and every run of a trained agent, once, with the seed of its bench."""
        fits = [Cell(m, s, n) for s in self.seeds for m in self.learning for n in self.sizes]
        return fits + [Cell(model, seed, self.sizes[-1]) for model in self.models for seed in runs_of(model)]

    @property
    def learning(self) -> list[str]:
        """The models that are fitted here."""
        return [model for model in self.models if not runs_of(model)]

    def shown(self, model: str) -> Cell:
        """The cell of a model whose pictures are kept: the first seed, the most transitions."""
        return Cell(model, next(iter(runs_of(model)), self.seeds[0]), self.sizes[-1])

    def files(self, cell: Cell) -> list[str]:
        """The names of a cell's files: its scores and, of the one that is shown, its pictures."""
        return [cell.file, cell.pictures] if cell == self.shown(cell.model) else [cell.file]

    @property
    def folder_name(self) -> str:
        """Where it is kept: the same for all that can be compared."""
        same: tuple[Any, ...] = (_FORMAT, self.task, self.appearance, self.policy, self.samples, self.sizes[-1])
        if self.encoder is not None:
            same += (encoders.identity(encoders.resolve(registry.task(self.task), self.appearance, self.encoder)),)
        digest = hashlib.sha256(json.dumps(same).encode()).hexdigest()[:8]
        return f"{file_name(self.task)}-{self.appearance}-{digest}"


def _one_name(model: str) -> str:
    """The same text for the same model, however its settings or the path of its runs were written."""
    return str(Path(model).resolve()) if runs_of(model) else str(entrant(model))


class Cell(NamedTuple):
    """One model, fitted once."""

    model: str
    seed: int
    transitions: int

    @property
    def file(self) -> str:
        """The name of its file."""
        return f"{file_name(self.model)}-seed{self.seed}-{self.transitions}.json"

    @property
    def pictures(self) -> str:
        """The name of the file of its pictures."""
        return self.file.removesuffix(".json") + ".npz"


@dataclass(frozen=True, kw_only=True)
class _World:
    """What every model is asked, and with what it is read: the same for all."""

    spec: TaskSpec
    gallery: Gallery
    reader: Reader
    one_step: Questions
    rollouts: Questions
    ranked: Questions
    counterfactuals: tuple[Questions, ...]
    after_the_end: Questions | None
    streams: dict[str, Streams] | None  #: None where not all of the world is asked about


def judge(judgement: Judgement, root: Path, *, workers: int) -> tuple[Path, list[str]]:
    """Fit and question whatever is not kept yet.

    Returns:
        The folder with a file a cell, and what went wrong with models, a sentence each.
    """
    folder = make_folder(root / judgement.folder_name)
    for seed in judgement.seeds if judgement.learning else ():
        data_of(judgement, folder, seed)
    prepare(judgement, folder)
    cells = judgement.cells
    waiting = [cell for cell in cells if not all((folder / name).exists() for name in judgement.files(cell))]
    failed: dict[str, None] = {}
    with tqdm(total=len(cells), initial=len(cells) - len(waiting), unit="fit", disable=None) as bar:
        for cell, why in _carried_out(judgement, folder, waiting, workers):
            bar.set_postfix_str(f"{cell.model}, {cell.transitions:,}")
            bar.update()
            if why:
                failed[why] = None
    write_json(folder / "judgement.json", {**dataclasses.asdict(judgement), **describe_environment()})
    return folder, list(failed)


def _carried_out(judgement: Judgement, folder: Path, cells: Sequence[Cell], workers: int) -> Any:
    """Each cell as it is done, and why it failed or an empty text."""
    if workers == 1:
        yield from ((cell, carry_out(judgement, folder, cell)) for cell in cells)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        jobs = {pool.submit(carry_out, judgement, folder, cell): cell for cell in cells}
        for job in as_completed(jobs):
            yield jobs[job], job.result()


def carry_out(judgement: Judgement, folder: Path, cell: Cell) -> str:
    """Fit one model, question it and keep the scores; why that failed, or an empty text."""
    try:
        found, pictures = judge_cell(judgement, folder, cell)
    except ImagineBenchError as error:
        return str(error)
    if cell == judgement.shown(cell.model):
        write_arrays(folder / cell.pictures, pictures)
    write_json(folder / cell.file, sealed(with_null(found)))
    return ""


def judge_cell(judgement: Judgement, folder: Path, cell: Cell) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The scores of one model, fitted once, and a few of its pictures beside the truth.

    Raises:
        ImagineBenchError: It cannot be made, or fails.
    """
    world = prepare(judgement, folder)
    seeds = SeedTree(cell.seed).child("judge", judgement.task, cell.transitions)
    name = str(runs_of(cell.model).get(cell.seed, cell.model))
    model, price = make(name, world.spec, world.gallery, judgement.appearance, seeds, judgement.encoder)
    if isinstance(model, TrainedModel):  # what it learned from and what that cost is its bench's to say
        seen, learned = model.visited, {"data": "", "fit_s": math.nan, "parameters": math.nan}
    else:
        seen, learned = _fit(model, cell, data_of(judgement, folder, cell.seed), seeds.child("fit").generator())
    questions = {
        "one_step": world.one_step, "rollouts": world.rollouts, "ranked": world.ranked, "after": world.after_the_end
    }  # fmt: skip
    answers: dict[str, Answers] = {}
    for name, each in questions.items():
        if each is not None:
            answers[name] = ask(
            model, cell.model, each, samples=judgement.samples, reader=world.reader, gallery=world.gallery,
            rng=seeds.child(name).generator(),
        )  # fmt: skip
    again = [
        ask(model, cell.model, each, samples=judgement.samples, reader=world.reader, gallery=world.gallery,
            rng=seeds.child("counterfactuals").generator())
        for each in world.counterfactuals
    ]  # fmt: skip
    steps = sum(each.steps for each in answers.values())
    scores = one_step_scores(world.spec, world.one_step, answers["one_step"], seen)
    found = {
        **cell._asdict(), **learned, **scores,
        **by_depth(world.rollouts, answers["rollouts"]), **ranking_scores(world.spec, world.ranked, answers["ranked"]),
        **after_the_end(world.after_the_end, answers.get("after"), answers["one_step"]),
        **noticing(world.streams, answers["one_step"]),
        "counterfactual": counterfactual_error(world.counterfactuals, again),
        "futures": {
            "real": [_named(world.spec, shares(outcomes)) for outcomes in world.rollouts.truth[0]],
            "imagined": [_named(world.spec, answers["rollouts"].distribution(0, step)) for step in range(asking.DEPTH)],
        },
        "imagine_s_per_1000": 1000.0 * sum(each.cpu_s for each in answers.values()) / steps, **price,
    }  # fmt: skip
    return found, _pictures(model, world, scores["worst"], seeds)


def _fit(
    model: WorldModel, cell: Cell, dataset: Dataset, rng: np.random.Generator
) -> tuple[set[tuple[State, int]], dict[str, Any]]:
    """Fit a model: what it has seen then, and the data's hash, CPU seconds and parameters."""
    episodes = dataset.episodes.first(cell.transitions)
    begun_s = time.process_time()
    call(cell.model, "fit", model.fit, episodes, rng)
    fit_s = time.process_time() - begun_s
    parameters = int(call(cell.model, "parameters", model.parameters))
    return visited(dataset, cell.transitions), {
        "data": dataset.episodes.hash, "fit_s": fit_s, "parameters": parameters
    }  # fmt: skip


def _named(spec: TaskSpec, outcomes: dict[State, float]) -> dict[str, float]:
    """Probabilities by what macrostates are called."""
    return {
        "no picture" if state[0] < 0 else ", ".join(spec.value_names(state)): share for state, share in outcomes.items()
    }


def make(
    name: str, spec: TaskSpec, gallery: Gallery, appearance: str, seeds: SeedTree, encoder: str | None = None
) -> tuple[WorldModel, dict[str, Any]]:
    """A new model, or a trained agent, and what was spent on it beforehand: the encoder's name and frames."""
    if Path(name) in runs_of(name).values():
        trained = load_model(Path(name), spec.id)
        return trained, trained.price
    entry = registry.world_model_entry(name)
    if entry.privileged:
        return registry.make_world_model(name, spec, gallery), {"encoder": "", "encoder_frames": 0}
    path = None if entry.encoder_kind is None else _encoder(spec, appearance, entry.encoder_kind, encoder)
    context = AgentContext(
        n_actions=spec.n_actions, preprocessing=spec.preprocessing, encoder=path, seeds=seeds,
        config_group=spec.config_group, overrides=entrant(name).settings,
    )  # fmt: skip
    card = {} if path is None else read_json(path.with_suffix(".json"), "an encoder's card")
    price = {"encoder": "" if path is None else path.stem, "encoder_frames": card.get("recipe", {}).get("frames", 0)}
    return registry.make_world_model(name, context), price


def _encoder(spec: TaskSpec, appearance: str, kind: str, given: str | None) -> Path:
    """What is given, where it gives latents or codes as the model reads them; else the task's own."""
    if given is not None and encoders.kind(path := encoders.resolve(spec, appearance, given)) == kind:
        return path
    return encoders.own(spec, appearance, kind)


def data_of(judgement: Judgement, folder: Path, seed: int) -> Dataset:
    """The data of a seed, made in the kinematic execution where it is not there yet."""
    return _data(judgement.task, judgement.policy, judgement.appearance, judgement.sizes[-1], folder, seed)


@functools.lru_cache(maxsize=4)
def _data(task: str, policy: str, appearance: str, transitions: int, folder: Path, seed: int) -> Dataset:
    place = folder / f"data-seed{seed}"
    with _making(folder):
        return read_dataset(place) if place.exists() else _collected(task, policy, appearance, transitions, place, seed)


@contextmanager
def _making(folder: Path) -> Iterator[None]:
    """Let one process at a time make what all cells of a folder share; the others wait and find it made."""
    with lock(folder / ".lock", f"The folder {folder}", patience_s=_PATIENCE_S):
        yield


def _collected(task: str, policy: str, appearance: str, transitions: int, place: Path, seed: int) -> Dataset:
    """Episodes of at least so many transitions, kept in a new folder."""
    spec = registry.task(task)
    episodes = -(-transitions // spec.horizon)
    while True:
        settings: dict[str, Any] = {"execution": "kinematic", "appearance": appearance}
        played, apart, card = collect(spec, policy_of(policy, spec, seed), episodes=episodes, seed=seed, **settings)
        if len(played.actions) >= transitions:
            return write_dataset(place, played, apart, card, "npz")
        episodes *= 2


def visited(dataset: Dataset, transitions: int) -> set[tuple[State, int]]:
    """The (macrostate, action) pairs of the first so many transitions; no model is given them."""
    macrostates = read_apart(dataset)["privileged"]["macrostates"][dataset.episodes.rows[0][:transitions]]
    return set(zip(map(tuple, macrostates.tolist()), dataset.episodes.actions[:transitions].tolist(), strict=True))


def prepare(judgement: Judgement, folder: Path) -> _World:
    """Questions and reader, made once in each process."""
    return _prepared(judgement.task, judgement.appearance, folder)


@functools.lru_cache(maxsize=2)
def _prepared(task: str, appearance: str, folder: Path) -> _World:
    spec = registry.task(task)
    gallery = Gallery(spec, appearance)
    one_step = asking.one_step(spec, gallery)
    return _World(
        spec=spec, gallery=gallery, reader=_reader(spec, appearance, folder), one_step=one_step,
        rollouts=asking.rollouts(spec, gallery), ranked=asking.ranked(spec, gallery),
        after_the_end=asking.after_the_end(spec, gallery),
        counterfactuals=asking.counterfactuals(spec, gallery), streams=streams_of(spec, one_step),
    )  # fmt: skip


def _reader(spec: TaskSpec, appearance: str, folder: Path) -> Reader:
    """The reader of a folder, trained and measured where there is none."""
    path, code = folder / "reader.safetensors", registry.load(_READER)
    with _making(folder):
        if not path.exists():
            reader = code.train_reader(spec, appearance)
            write_json(folder / "reader.json", reader_errors(reader, spec, appearance))
            write_bytes(path, reader.content())
    with reading(path, "the judge's reader; remove it, and the same command trains a new one"):
        return code.load_reader(spec, path)


def reader_errors(reader: Reader, spec: TaskSpec, appearance: str) -> dict[str, float]:
    """How often a reader is wrong on frames that it was not trained on, and what it makes of pictures of nothing.

    Shares of real frames: ``misread``, taken for another macrostate, and ``refused``; the others are shares taken for a
    picture of this world of black and gray fog, noise, and blends of two frames of different macrostates.
    """
    rng = SeedTree(1).child("encoder_probe", "judge", spec.id, appearance).generator()
    states = np.array(states_of(spec.rules), dtype=np.int64)
    macrostates, others = (states[rng.integers(len(states), size=_READ)] for _ in range(2))
    frames, blended = (spec.render_macrostates(each, appearance, rng) for each in (macrostates, others))
    differ = (macrostates != others).any(axis=1)
    blends = ((frames[differ].astype(np.uint16) + blended[differ]) // 2).astype(np.uint8)
    read, nothing = reader.read(frames), {
        "black": np.zeros_like(frames[:1]), "gray": np.full_like(frames[:1], 128),
        "noise": rng.integers(0, 256, frames.shape, dtype=np.uint8), "blends": blends,
    }  # fmt: skip
    refused = read[:, 0] < 0
    return {
        "misread": float(((read != macrostates).any(axis=1) & ~refused).mean()), "refused": float(refused.mean()),
        **{f"{name}_read": float((reader.read(each)[:, 0] >= 0).mean()) for name, each in nothing.items()},
    }  # fmt: skip


def _pictures(model: WorldModel, world: _World, worst: list[int], seeds: SeedTree) -> dict[str, NDArray[Any]]:
    """Transitions and a rollout, imagined once more: before, likeliest real outcome, imagined of each.

    ``right`` says whether what is imagined, as read, may happen.
    """
    rng = seeds.child("pictures").generator()
    found: dict[str, NDArray[Any]] = {}
    shown_: list[tuple[str, Questions, list[int]]] = [
        ("worst", world.one_step, worst),
        ("futures", world.rollouts, [0]),
    ]
    if world.after_the_end is not None:
        some = np.linspace(0, len(world.after_the_end.states) - 1, _AFTER).astype(int)
        shown_.append(("after", world.after_the_end, sorted(set(some.tolist()))))
    for name, questions, rows in shown_:
        imagined = model.imagine(questions.frames[rows], questions.actions[rows], 1, rng)
        read = asking.read_pictures(imagined, world.reader, world.gallery, len(world.spec.macrostate_names))[:, 0]
        pictures = imagined.pictures[:, 0]
        if pictures.dtype != np.uint8:
            pictures = (np.asarray(pictures) * 255.0).round().astype(np.uint8)
        truth = [[shares(outcomes) for outcomes in questions.truth[row]] for row in rows]
        real = [[world.gallery.frame(max(each, key=each.__getitem__)) for each in steps] for steps in truth]
        right = [
            [tuple(state) in each for state, each in zip(states, steps, strict=True)]
            for states, steps in zip(read.tolist(), truth, strict=True)
        ]
        arrays: dict[str, NDArray[Any]] = {
            "before": questions.frames[rows, -1],
            "actions": questions.asked[rows],
            "imagined": pictures,
        }
        arrays |= {"real": np.array(real), "right": np.array(right)}
        found |= {f"{name}_{each}": array for each, array in arrays.items()}
    return found


def kept(folder: Path, judgement: Judgement) -> list[dict[str, Any]]:
    """Every cell of a judgement that is kept. Raises ArtefactError: one is damaged."""
    order = {model: place for place, model in enumerate(judgement.models)}
    cells = sorted(judgement.cells, key=lambda cell: order[cell.model])
    return [read_sealed(folder / cell.file, "a judged cell") for cell in cells if (folder / cell.file).exists()]


def shown(folder: Path, judgement: Judgement) -> dict[str, dict[str, Any]]:
    """By model, the pictures and the cell that are kept of :meth:`Judgement.shown`.

    Raises:
        ArtefactError: A file is damaged.
    """
    cells = {model: judgement.shown(model) for model in judgement.models}
    return {
        model: {**read_arrays(folder / cell.pictures), **read_sealed(folder / cell.file, "a judged cell")}
        for model, cell in cells.items()
        if (folder / cell.file).exists()
    }
