"""A judgement of models of motions: models by sizes of data by seeds.

Each fit is kept in a file of its own, written at once, so that the same command goes on where another was stopped.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.arrays import content_hash
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError, brief
from imagine_bench.interfaces import TaskSpec
from imagine_bench.judge.judgement import ModelFit, judge_fits
from imagine_bench.judge.reading import ImageReader, making, reader_in
from imagine_bench.registry.entries import file_name
from imagine_bench.registry.machine import describe_environment
from imagine_bench.seeding import SeedTree
from imagine_bench.store.files import (
    make_folder,
    make_plain,
    read_arrays,
    read_sealed,
    sealed,
    with_null,
    write_arrays,
    write_json,
)

from .interface import motion_model_entry
from .questions import AnsweredMotions, MotionQuestions, MotionSource, questions
from .scores import MotionScores, Simulator, score
from .serving import opened

SIZES = (400,)
"""Motions that models learn from, by default."""
PAIRS = 100
CHAINS = 40
"""Counterfactual pairs, and chains of motions that are imagined on from imagined frames, by default."""
SEEDS = tuple(range(7))
"""Seeds by default: of fewer than seven the suite gives no interval."""
SIMULATOR = ModelFit("simulator", 0, 0)
"""The cell of the simulator's own frames, which is no model."""


@dataclass(frozen=True, kw_only=True)
class MotionJudgement:
    """The choices of a judgement.

    Raises:
        UnknownNameError: No such task or model.
        InvalidValueError: A task without continuous control, whose frames hide something or whose grips slip by chance,
            or sizes or seeds out of range.
    """

    task: str  #: task of macro-actions that has continuous control
    models: tuple[str, ...]  #: names in :data:`.interface.GROUP`
    sizes: tuple[int, ...] = SIZES  #: motions of the same data, ascending
    seeds: tuple[int, ...] = SEEDS  #: each of data and of models
    pairs: int = PAIRS  #: counterfactual pairs that are asked about
    chains: int = CHAINS  #: chains of motions that are asked about

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", registry.task_name(self.task))  # seeds and folder depend on it
        if not registry.task_entry(self.task).motion:
            raise InvalidValueError(f"Task {self.task} has no continuous control; give one of this suite.")
        spec = registry.task(self.task)
        if spec.sight is not None:
            raise InvalidValueError(
                f"Frames of {self.task} hide some of the world or are late, and motions are judged by frames that show "
                "it as it is. Judge a task without the parameters gesture and lag."
            )
        if getattr(getattr(spec.rules, "world", None), "slip", 0.0):  # a task may slip without options that say so
            raise InvalidValueError(
                f"Chance decides where a motion of {self.task} ends, and one end of the simulator is taken for the "
                "truth. Judge a task without the parameter slip."
            )
        if not self.models or not self.seeds or min(self.seeds) < 0:
            raise InvalidValueError("There is nothing to judge; give at least one model and one seed of at least 0.")
        for name, given in (("models", self.models), ("seeds", self.seeds)):
            if len(set(given)) < len(given):
                raise InvalidValueError(f"{name} is {brief(given)}; give each once.")
        if not self.sizes or sorted(set(self.sizes)) != list(self.sizes) or self.sizes[0] < 1:
            raise InvalidValueError(f"sizes is {self.sizes}; give ascending numbers of motions, at least 1.")
        if min(self.pairs, self.chains) < 1:
            raise InvalidValueError(f"pairs is {self.pairs} and chains is {self.chains}; give at least 1 of each.")
        for name in self.models:
            motion_model_entry(name)

    @property
    def cells(self) -> list[ModelFit]:
        """Every fit, and the simulator itself first."""
        return [SIMULATOR, *(ModelFit(m, seed, n) for seed in self.seeds for m in self.models for n in self.sizes)]

    @property
    def folder_name(self) -> str:
        """Where it is kept: the same for all that can be compared."""
        return f"{file_name(self.task)}-motions-{self.sizes[-1]}-{self.pairs}-{self.chains}"


@dataclass(frozen=True)
class MotionStage:
    """A task's questions, and the reader of the answers: the same for all models."""

    spec: TaskSpec
    asked: MotionQuestions
    reader: ImageReader

    @functools.cached_property
    def digest(self) -> str:
        """Of the questions."""
        return content_hash(self.asked.arrays())


def judge(judgement: MotionJudgement, root: Path, *, workers: int) -> tuple[Path, list[str]]:
    """Fit and question whatever is not kept yet.

    Returns:
        The folder with a file a fit, and a sentence for each model that failed.

    Raises:
        SetupError: The folder cannot be written.
        ArtefactError: A file in it is damaged.
    """
    folder = make_folder(root / judgement.folder_name)
    stage(judgement, folder)
    waiting = [cell for cell in judgement.cells if _read(folder, cell) is None]
    failed = judge_fits(waiting, functools.partial(carry_out, judgement, folder), workers=workers)
    if any((folder / cell.file).exists() for cell in judgement.cells):
        write_json(folder / "judgement.json", {**asdict(judgement), **describe_environment()})
    return folder, failed


def _read(folder: Path, cell: ModelFit) -> dict[str, Any] | None:
    """A cell as it is kept; None where it is not, or its model's code has changed. Raises ArtefactError: damaged."""
    file = folder / cell.file
    found = read_sealed(file, "a judged cell") if file.exists() else {"code": None}
    now = _code(cell)
    return found if found.get("code", now) == now else None


def _code(cell: ModelFit) -> str:
    """A digest of the package that offers a model; empty for one of this suite."""
    return "" if cell == SIMULATOR else registry.package_code(motion_model_entry(cell.model).make)


def carry_out(judgement: MotionJudgement, folder: Path, cell: ModelFit, tell: Callable[[str], None] = print) -> str:
    """Fit one model, question it and keep the scores; why that failed, or an empty text. It has nothing to ``tell``."""
    del tell
    try:
        found = judge_cell(judgement, folder, cell)
    except ImagineBenchError as error:
        return str(error)
    write_json(folder / cell.file, sealed(with_null(found)))
    return ""


def judge_cell(judgement: MotionJudgement, folder: Path, cell: ModelFit) -> dict[str, Any]:
    """The scores of one model, fitted once.

    Raises:
        ImagineBenchError: It cannot be made, or fails.
    """
    there = stage(judgement, folder)
    known = {**cell._asdict(), "questions": there.digest, "code": _code(cell)}
    if cell == SIMULATOR:
        return {**known, **asdict(score(cell.model, Simulator(there.asked), there.asked, there.reader))}
    data = data_of(judgement, folder, cell.seed)
    seeds = SeedTree(cell.seed).child("judge", "motions", judgement.task, cell.model, cell.transitions)
    log = folder / f"{cell.file.removesuffix('.json')}.log"
    try:
        entry = motion_model_entry(cell.model)
        with opened(cell.model, entry, there.spec, seeds, folder=folder, log=log) as model:
            fit_s, parameters = model.fit(data.first(cell.transitions), seeds.child("fit").generator())
            scores: MotionScores = score(cell.model, model, there.asked, there.reader)
    finally:
        make_plain(log)
    cost = {"fit_s": fit_s, "parameters": parameters, "data": content_hash(vars(data))}
    return {**known, **cost, **asdict(scores)}


@functools.lru_cache(maxsize=1)
def stage(judgement: MotionJudgement, folder: Path) -> MotionStage:
    """The questions of a judgement, made once in its folder, and the reader of frames."""
    spec = registry.task(judgement.task)
    place = folder / "questions.npz"
    reader = reader_in(spec, "clean", folder)
    with making(folder):
        if not place.exists():
            seeds = SeedTree(0).child("evaluation", "motions", spec.id)
            asked = questions(_source(judgement.task), judgement.pairs, judgement.chains, seeds)
            write_arrays(place, asked.arrays())
    return MotionStage(spec, MotionQuestions.of(read_arrays(place, "the questions of a judgement")), reader)


@functools.lru_cache(maxsize=1)
def data_of(judgement: MotionJudgement, folder: Path, seed: int) -> AnsweredMotions:
    """The motions of a seed, as many as a model learns from at most; made once in the folder."""
    place = folder / f"data-seed{seed}.npz"
    with making(folder):
        if not place.exists():
            rng = SeedTree(seed).child("training", "motions", registry.task(judgement.task).id).generator()
            write_arrays(place, vars(_source(judgement.task).draw(judgement.sizes[-1], rng)))
    return AnsweredMotions(**read_arrays(place, "the motions that models learn from"))


@functools.lru_cache(maxsize=1)
def _source(task: str) -> MotionSource:
    entry = registry.task_entry(task)
    make = registry.load(entry.motion)
    return MotionSource(make(**entry.options, observation="proprio", time_limit_s=float("inf")))


def judged(judgement: MotionJudgement, folder: Path) -> list[dict[str, Any]]:
    """The cells of a judgement that are kept.

    Raises:
        ArtefactError: One is damaged, or they answered different questions.
    """
    cells = [each for cell in judgement.cells if (each := _read(folder, cell)) is not None]
    if len({cell["questions"] for cell in cells}) > 1:
        raise ArtefactError(
            f"The cells of {folder} answered different questions and cannot be compared; judge into another --out."
        )
    return cells
