"""A judgement: models by sizes of data by seeds, each kept in a file of its own, so that it can be taken up again."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Arrays, State, content_hash
from imagine_bench.data.folder import Dataset, macrostates_of, read_dataset, write_dataset
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError, brief
from imagine_bench.interfaces import TaskSpec
from imagine_bench.interfaces.model import WorldModel
from imagine_bench.judge import questions
from imagine_bench.judge.change import Streams, change_detection_delay, counterfactual_error, streams_of
from imagine_bench.judge.models import JudgedModel, code_of, model_entry, one_name, opened, runs_of, source_of
from imagine_bench.judge.policies.levels import counted_table
from imagine_bench.judge.policies.policy_set import PolicyWorld, policy_world
from imagine_bench.judge.predictions import Predictions, ask_together, call, evaluate, imagined_by
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.reading import READER_FILE, ImageReader, RenderedFrameIndex, making, reader_in
from imagine_bench.judge.scores import (
    CellScores,
    acceptance_scores,
    after_the_end_scores,
    by_depth,
    light_scores,
    one_step_scores,
    policy_scores,
    ranking_scores,
    today,
    whole_world_scores,
)
from imagine_bench.judge.truth import Distribution, shares
from imagine_bench.judge.worlds.making import WorldQuestions
from imagine_bench.protocols.data import digest
from imagine_bench.registry.entries import file_name
from imagine_bench.registry.machine import describe_environment
from imagine_bench.running.bench import Counted
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.running.isolation import why_open
from imagine_bench.running.launchers.jobs import work_through
from imagine_bench.seeding import SeedTree
from imagine_bench.store import encoders
from imagine_bench.store.files import (
    make_folder,
    make_plain,
    read_arrays,
    read_sealed,
    sealed,
    sha256,
    with_null,
    write_arrays,
    write_json,
)
from imagine_bench.values import Json

SIZES = (100, 300, 1_000, 3_000, 10_000)
SAMPLES = 8
_FORMAT = 5  # 4 asked no pairs that differ in the light alone
_EXECUTION = "kinematic"  # of the data
_AFTER = 6  # transitions after the end whose images are kept
Costs = dict[str, str | float]


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """The choices of a judgement. InvalidValueError: nothing to judge, or sizes, seeds or samples out of range."""

    task: str
    models: tuple[str, ...]  #: Names, or folders of runs, whose agents are judged as they are
    sizes: tuple[int, ...] = SIZES  #: Transitions of the same data, ascending
    seeds: tuple[int, ...] = (0, 1, 2)
    samples: int = SAMPLES  #: Futures imagined of each question
    appearance: str = "clean"
    policy: str = "random"  #: The policy that collects the data, as :data:`.running.collect.POLICIES`
    #: A bundled name or a file, for the models that read its latents or codes; the others see through the task's own
    encoder: str | None = None
    order: int = 0  #: Seed of the order in which models are asked

    def __post_init__(self) -> None:
        if not self.models or not self.seeds or min(self.order, *self.seeds) < 0:
            raise InvalidValueError("There is nothing to judge; give at least one model and one seed of at least 0.")
        if len(set(self.seeds)) < len(self.seeds):
            raise InvalidValueError(f"seeds is {brief(self.seeds)}; give each seed once.")
        if len(set(map(one_name, self.models))) < len(self.models):
            raise InvalidValueError(f"models is {brief(self.models)}; give each world model or run once.")
        if not self.sizes or sorted(set(self.sizes)) != list(self.sizes) or self.sizes[0] < 1:
            raise InvalidValueError(f"sizes is {self.sizes}; give ascending numbers of transitions, at least 1.")
        if not 1 <= self.samples <= 1_000:
            raise InvalidValueError(f"samples is {self.samples}; give 1 to 1,000.")
        for name in self.models:
            model_entry(name)
        object.__setattr__(self, "task", registry.task_name(self.task))  # a file of options may change
        object.__setattr__(self, "appearance", appearance_name(self.appearance))
        _require_judged(registry.task(self.task))
        if self.encoder_file is not None:
            gives = encoders.kind(self.encoder_file)
            if gives not in {model_entry(name).encoder_kind for name in self.models}:
                raise InvalidValueError(f"No model of {self.models} reads {gives}, which {self.encoder} gives.")

    @property
    def encoder_file(self) -> Path | None:
        """The given encoder."""
        if self.encoder is None:
            return None
        return encoders.resolve(registry.task(self.task), self.appearance, self.encoder)

    @property
    def cells(self) -> list[ModelFit]:
        """Every fit that is judged, and every run of a trained agent, once, with the seed of its bench."""
        fits = [ModelFit(m, s, n) for s in self.seeds for m in self.learning for n in self.sizes]
        return fits + [ModelFit(model, seed, self.sizes[-1]) for model in self.models for seed in runs_of(model)]

    @property
    def learning(self) -> list[str]:
        """The models that are fitted here."""
        return [model for model in self.models if not runs_of(model)]

    @property
    def folder_name(self) -> str:
        """Where it is kept: the same for all that can be compared."""
        same: list[Json] = [_FORMAT, self.task, self.appearance, self.policy, self.samples, self.sizes[-1], self.order]
        if self.encoder_file is not None:
            same.append(encoders.identity(self.encoder_file))
        same += filter(None, [registry.package_code(registry.task_entry(self.task).spec)])  # its code may change
        return f"{file_name(self.task)}-{self.appearance}-{digest(same)[:8]}"


def _require_judged(spec: TaskSpec) -> None:
    """Raise InvalidValueError for a task in which no model can be judged."""
    if _EXECUTION not in spec.executions:
        raise InvalidValueError(
            f"The data of a judgement are collected in the {_EXECUTION} execution, which task {spec.id!r} lacks. "
            "Judge another task."
        )
    if spec.sight is not None:
        raise InvalidValueError(
            f"Frames of task {spec.id!r} hide or delay a part of the macrostate, and the exact answers are about all "
            "of it. Judge a task without the parameters gesture and lag."
        )


class ModelFit(NamedTuple):
    """One model, fitted once."""

    model: str
    seed: int
    transitions: int

    @property
    def file(self) -> str:
        """The name of its file."""
        return f"{file_name(self.model)}-seed{self.seed}-{self.transitions}.json"

    @property
    def images(self) -> str:
        """The name of the file of its images."""
        return self.file.removesuffix(".json") + ".npz"


@dataclass(frozen=True)
class AskedWorld:
    """The questions to every model, and the reader of its answers: the same for all."""

    spec: TaskSpec
    index: RenderedFrameIndex
    reader: ImageReader
    reader_digest: str  # of the reader's file
    asked: dict[str, EvalSet]  # "one_step", "rollouts", "ranked" and, where there are such, "after", "light"
    counterfactuals: tuple[EvalSet, ...]
    streams: dict[str, Streams] | None  # None where not all of the world is asked about
    policies: PolicyWorld | None  # likewise
    whole: WorldQuestions | None  # likewise
    light: WorldQuestions | None  # None where frames do not vary in the light

    @functools.cached_property
    def digest(self) -> str:
        """Of the frames that are asked about: without rendering them nobody can tell their order from its seed."""
        return content_hash({name: each.frames for name, each in self.asked.items()})

    @property
    def policies_digest(self) -> str:
        """Of the policies; nothing where there are none."""
        return "" if self.policies is None else self.policies.policies.digest


def judge(judgement: Judgement, root: Path, *, workers: int) -> tuple[Path, list[str]]:
    """Fit and question whatever is not kept yet.

    Returns:
        The folder with a file a cell, and a sentence for each model that failed.
    """
    folder = make_folder(root / judgement.folder_name)
    for seed in judgement.seeds if judgement.learning else ():
        data_of(judgement, folder, seed)
    world = prepare(judgement, folder)
    cells = judgement.cells
    waiting = [cell for cell in cells if not _is_whole(folder, cell)]
    failed = judge_fits(waiting, functools.partial(carry_out, judgement, folder), workers=workers)
    facts = {"policies": world.policies_digest, "closed_off": why_open() or True, **describe_environment()}
    if any((folder / cell.file).exists() for cell in cells):  # otherwise the file of another judgement stays
        write_json(folder / "judgement.json", {**dataclasses.asdict(judgement), **facts})
    return folder, failed


def judge_fits(
    cells: Sequence[ModelFit], carry: Callable[[ModelFit, Callable[[str], None]], str], *, workers: int
) -> list[str]:
    """Judge every cell, in this process or in so many, and show how many are done.

    Args:
        cells: The fits.
        carry: Judges one, as :func:`carry_out` does.
        workers: Processes at a time; 1 is this process.

    Returns:
        A sentence for each model that failed.
    """
    if cells and why_open():
        print(f"Note: models are judged in processes that this system cannot close off ({why_open()}).")
    failed: dict[str, None] = {}
    with Counted("fits judged", total=len(cells)) as counted:

        def ended(cell: ModelFit, why: str) -> None:
            counted.step()
            if why:
                failed[why if why.endswith(".") else f"World model {cell.model}: {why}."] = None

        if workers == 1:
            for cell in cells:
                ended(cell, carry(cell, print))
        else:
            work_through(carry, cells, workers=workers, on_news=print, on_end=ended)
    return list(failed)


def carry_out(judgement: Judgement, folder: Path, cell: ModelFit, tell: Callable[[str], None] = print) -> str:
    """Fit one model, question it and keep the scores; why that failed, or an empty text. It has nothing to ``tell``."""
    del tell
    if _is_whole(folder, cell):  # another judgement in the same folder was there first
        return ""
    try:
        found, images = judge_cell(judgement, folder, cell)
    except ImagineBenchError as error:
        return str(error)
    with making(folder):  # so that a cell and its images are of the same fit
        if cell.transitions == judgement.sizes[-1]:
            write_arrays(folder / cell.images, images)
            found["images"] = content_hash(images)
        write_json(folder / cell.file, sealed(with_null(found)))
    return ""


def _is_whole(folder: Path, cell: ModelFit) -> bool:
    """Whether a cell is kept, and its images are where it has some. Raises ArtefactError: it is damaged."""
    found = _read(folder, cell)
    return found is not None and ("images" not in found or (folder / cell.images).exists())


def _read(folder: Path, cell: ModelFit) -> CellScores | None:
    """A cell as it is kept; None where it is not, or its model's code, or its run, is another one now."""
    file = folder / cell.file
    found = read_sealed(file, "a judged cell") if file.exists() else {"code": None}
    now = code_of(cell.model, cell.seed)
    return found if found.get("code", now) == now else None


def judge_cell(judgement: Judgement, folder: Path, cell: ModelFit) -> tuple[CellScores, Arrays]:
    """The scores of one model, fitted once, and a few of its images beside the truth.

    Raises:
        ImagineBenchError: It cannot be made, or fails.
    """
    world = prepare(judgement, folder)
    seeds = SeedTree(cell.seed).child("judge", judgement.task, cell.transitions)
    name = str(runs_of(cell.model).get(cell.seed, cell.model))
    log = folder / f"{cell.file.removesuffix('.json')}.log"
    try:
        source = source_of(name, world.spec, world.index, judgement.appearance, seeds, judgement.encoder)
        with opened(source, judgement.task, folder=folder, log=log) as judged:
            return _judged(judgement, folder, cell, world, judged, seeds)
    finally:
        make_plain(log)


def _judged(
    judgement: Judgement, folder: Path, cell: ModelFit, world: AskedWorld, judged: JudgedModel, seeds: SeedTree
) -> tuple[CellScores, Arrays]:
    asked = world.asked
    table = None
    if not judged.learns:  # its data and the cost of its training are its bench's to say
        seen = judged.visited
        learned: Costs = {"data": "", "fit_s": math.nan, "parameters": math.nan}
    else:
        dataset = data_of(judgement, folder, cell.seed)
        seen, learned = _fit(judged, cell, dataset, seeds.child("fit").generator())
        if world.policies is not None:
            table = counted_table(dataset.episodes, macrostates_of(dataset), cell.transitions, world.policies)
    order = SeedTree(judgement.order).child("judge", judgement.task, "order", world.digest)

    def ask(questions: EvalSet, name: str) -> Predictions:
        return evaluate(
            judged.model,
            cell.model,
            questions,
            samples=judgement.samples,
            reader=world.reader,
            index=world.index,
            rng=seeds.child(name).generator(),
            order=order.child(name).generator(),
            cpu_clock=judged.cpu_s,
        )

    answers = ask_together(ask, asked)
    again = [ask(each, "counterfactuals") for each in world.counterfactuals]
    scores = one_step_scores(world.spec, asked["one_step"], answers["one_step"], seen)
    one_step = (asked["one_step"], answers["one_step"])
    ranks, film = policy_scores(world.policies, *one_step, world.spec.rules, table, seeds.child("exploit"))
    policy = judgement.policy if judged.learns else ""
    accepts = acceptance_scores(world.policies, policy, *one_step, seeds.child("conformal"))
    futures = [answers["rollouts"].distribution(0, step) for step in range(questions.DEPTH)]
    cpu_s = sum(each.cpu_s for each in answers.values())
    found = {
        **cell._asdict(),
        **learned,
        **scores,
        **by_depth(asked["rollouts"], answers["rollouts"]),
        **ranking_scores(world.spec, asked["ranked"], answers["ranked"]),
        **after_the_end_scores(asked.get("after"), answers.get("after"), answers["one_step"]),
        **change_detection_delay(world.streams, answers["one_step"]),
        "worlds": whole_world_scores(cell.model, judged.model, *one_step, world.whole)
        | light_scores(asked.get("light"), answers.get("light"), world.light),
        "counterfactual": counterfactual_error(world.counterfactuals, again),
        **ranks,
        **accepts,
        "film": None if film is None else film.told(world.spec),
        "futures": {
            "real": [_named(world.spec, shares(outcomes)) for outcomes in asked["rollouts"].truth[0]],
            "imagined": [_named(world.spec, each) for each in futures],
        },
        "imagine_s_per_1000": 1000.0 * cpu_s / sum(each.steps for each in answers.values()),
        **judged.cost,
        "reader": world.reader_digest,
        "policies": world.policies_digest,
        "privileged": model_entry(cell.model).privileged,
        "code": code_of(cell.model, cell.seed),
    }
    images = _images(cell.model, judged.model, world, scores["worst"], seeds.child("pictures").generator())
    return found, images if film is None else images | film.images(world.index.frame)


def _fit(
    judged: JudgedModel, cell: ModelFit, dataset: Dataset, rng: np.random.Generator
) -> tuple[set[tuple[State, int]], Costs]:
    """Fit a model: its data, and the data's hash, CPU seconds and parameters."""
    episodes = dataset.episodes.first(cell.transitions)
    begun_s = judged.cpu_s()
    call(cell.model, "fit", judged.model.fit, copy.deepcopy(episodes), rng)  # models of this process must not change it
    fit_s = judged.cpu_s() - begun_s
    parameters = int(call(cell.model, "parameters", judged.model.parameters))
    learned: Costs = {"data": dataset.episodes.hash, "fit_s": fit_s, "parameters": parameters}
    return visited(dataset, cell.transitions), learned


def _named(spec: TaskSpec, outcomes: Distribution) -> dict[str, float]:
    """Probabilities by the names of macrostates."""
    return {
        "unreadable" if state[0] < 0 else ", ".join(spec.value_names(state)): share for state, share in outcomes.items()
    }


@functools.lru_cache(maxsize=4)
def data_of(judgement: Judgement, folder: Path, seed: int) -> Dataset:
    """The data of a seed, made in the kinematic execution where it is not there yet."""
    place = folder / f"data-seed{seed}"
    with making(folder):
        return read_dataset(place) if place.exists() else _collected(judgement, place, seed)


def _collected(judgement: Judgement, place: Path, seed: int) -> Dataset:
    """Episodes of at least as many transitions as a model learns from, kept in a new folder."""
    spec = registry.task(judgement.task)
    episodes = -(-judgement.sizes[-1] // spec.horizon)
    while True:
        policy = policy_of(judgement.policy, spec, seed)
        played, apart, card = collect(
            spec, policy, episodes=episodes, seed=seed, execution=_EXECUTION, appearance=judgement.appearance
        )
        if len(played.actions) >= judgement.sizes[-1]:
            return write_dataset(place, played, apart, card, "npz")
        episodes *= 2


def visited(dataset: Dataset, transitions: int) -> set[tuple[State, int]]:
    """The (macrostate, action) pairs of the first so many transitions; no model is given them."""
    macrostates = macrostates_of(dataset)[dataset.episodes.rows[0][:transitions]]
    return set(zip(map(tuple, macrostates.tolist()), dataset.episodes.actions[:transitions].tolist(), strict=True))


@functools.lru_cache(maxsize=2)
def prepare(judgement: Judgement, folder: Path) -> AskedWorld:
    """Questions and reader, made once in each process."""
    spec = registry.task(judgement.task)
    index = RenderedFrameIndex(spec, judgement.appearance)
    asked = {name: make(spec, index.render) for name, make in questions.SETS.items()}
    asked["light"] = questions.light_alone(spec, functools.partial(index.render, appearance=questions.LIGHT))
    there = {name: each for name, each in asked.items() if each is not None}
    again = questions.counterfactuals(spec, index.render)
    reader = reader_in(spec, judgement.appearance, folder)
    file = folder / READER_FILE
    digest = sha256(file)[:12] if file.exists() else ""
    single = there["one_step"]
    policies = policy_world(spec, single.macrostates)
    streams = streams_of(spec, single)
    whole = None if streams is None else questions.about_whole_world(spec, single)
    light = questions.about_light(spec, there["light"]) if "light" in there else None
    return AskedWorld(spec, index, reader, digest, there, again, streams, policies, whole, light)


def _images(name: str, model: WorldModel, world: AskedWorld, worst: list[int], rng: np.random.Generator) -> Arrays:
    """Transitions and a rollout, imagined once more in one future each: before, likeliest real outcome, imagined.

    ``right`` says whether the imagined macrostate, as read, may come.
    """
    chosen = {"worst": ("one_step", worst), "futures": ("rollouts", [0])}
    if "after" in world.asked:
        some = np.linspace(0, len(world.asked["after"].states) - 1, _AFTER).astype(int)
        chosen["after"] = ("after", sorted(set(some.tolist())))
    found: Arrays = {}
    for what, (kind, rows) in chosen.items():
        asked = world.asked[kind]
        own = np.random.default_rng(int(rng.integers(2**63)))
        imagined = imagined_by(model, name, asked.frames[rows], asked.actions[rows], 1, own).pictures
        read = world.index.read(imagined, world.reader)[:, 0].tolist()
        truth = [[shares(outcomes) for outcomes in asked.truth[row]] for row in rows]
        real = [[world.index.frame(max(each, key=each.__getitem__)) for each in steps] for steps in truth]
        right = np.zeros((len(rows), len(truth[0])), dtype=bool)
        for row, step in np.ndindex(*right.shape):
            right[row, step] = tuple(read[row][step]) in truth[row][step]
        images = imagined[:, 0] if imagined.dtype == np.uint8 else (np.asarray(imagined[:, 0]) * 255.0).round()
        found[f"{what}_before"] = asked.frames[rows, -1]
        found[f"{what}_actions"] = asked.asked[rows]
        found[f"{what}_imagined"] = images.astype(np.uint8)
        found[f"{what}_real"] = np.array(real)
        found[f"{what}_right"] = right
    return found


def kept(folder: Path, judgement: Judgement) -> list[CellScores]:
    """Every cell of a judgement that is kept. Raises ArtefactError: one is damaged."""
    cells = sorted(judgement.cells, key=lambda cell: judgement.models.index(cell.model))
    found = [today(each) for cell in cells if (each := _read(folder, cell)) is not None]
    made_by = {
        "read by different readers": {cell.get("reader", "") for cell in found},
        "judged by different policies": {cell["policies"] for cell in found if "policies" in cell},
    }
    for how, digests in made_by.items():
        if len(digests) > 1:
            raise ArtefactError(
                f"Cells in {folder} were {how} ({', '.join(sorted(digests))}) and cannot be compared; "
                "give another folder with --out."
            )
    for cell in found:
        if "privileged" in cell and cell["privileged"] != model_entry(cell["model"]).privileged:
            was = "privileged" if cell["privileged"] else "not privileged"
            raise ArtefactError(
                f"World model {cell['model']} was {was} when it was judged in {folder}, and is registered otherwise "
                "now; give another folder with --out."
            )
    return found


def shown(folder: Path, judgement: Judgement) -> dict[str, CellScores]:
    """By model, the images and the cell of its first seed that are kept, after the most transitions.

    Raises:
        ArtefactError: A file is damaged, or images are lost.
    """
    found: dict[str, CellScores] = {}
    for cell in kept(folder, judgement):
        model = cell["model"]
        images = folder / ModelFit(model, cell["seed"], cell["transitions"]).images
        if model not in found and ("images" in cell or images.exists()):
            arrays = read_arrays(images, "images of a judged fit; the same judgement makes lost ones anew")
            if cell.get("images", content_hash(arrays)) != content_hash(arrays):
                raise ArtefactError(f"{images} is damaged: it is not as it was written. It was left untouched.")
            found[model] = arrays | cell
    return found
