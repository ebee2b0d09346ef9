"""Judges models of motions: is the imagined final frame the right macrostate, also of a motion that grips nothing?

Truth is the simulator itself, which is deterministic, and at its end the macrostate that the rules' reader finds.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Bools, Floats32, Frame, Ints
from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.interfaces import AgentContext, TaskSpec
from imagine_bench.interfaces.model import Untaught
from imagine_bench.interfaces.motion import MotionModel, Motions, require_frames
from imagine_bench.judge.models import encoder_for
from imagine_bench.judge.motion.questions import AnsweredMotions, MotionSource
from imagine_bench.judge.reading import ImageReader, reader_in
from imagine_bench.seeding import SeedTree

SIZES = (1200,)
"""Motions that models learn from, by default."""
PAIRS = 100
CHAINS = 40
DEPTH = 4
"""Counterfactual pairs; chains of motions, and motions of each, imagined on from imagined frames."""


@dataclass(frozen=True, kw_only=True)
class MotionQuestions:
    """The questions to every model of motions, the same for all."""

    planned: AnsweredMotions
    raised: AnsweredMotions  #: the same motions, 60 mm higher
    chains: Sequence[AnsweredMotions]  #: by depth


class Row(NamedTuple):
    """One model, fitted once."""

    model: str
    size: int  #: motions that it learned from
    seed: int
    scores: MotionScores


@dataclass(frozen=True, kw_only=True)
class MotionScores:
    """Shares of questions, in [0, 1], and the price."""

    right: float  #: planned motions whose imagined final frame shows the macrostate that the simulator ends in
    nothing_right: float  #: raised motions, which grip nothing, whose imagined frame shows that nothing changed
    painted: float  #: raised motions of which the change is painted that the planned motion would have made
    pairs: float  #: counterfactual pairs of which both are right
    by_depth: tuple[float, ...]  #: chains that are right after 1, 2, ... motions
    fit_cpu_s: float
    parameters: int


def questions(source: MotionSource, seeds: SeedTree) -> MotionQuestions:
    """Questions from seeds of their own, which no training has."""
    planned, raised = source.pairs(PAIRS, seeds.child("pairs").generator())
    return MotionQuestions(
        planned=planned, raised=raised, chains=source.chains(CHAINS, DEPTH, seeds.child("chains").generator())
    )


def score(name: str, model: MotionModel, asked: MotionQuestions, reader: ImageReader, fit_cpu_s: float) -> MotionScores:
    """Ask a fitted model everything. Raises InvalidValueError: it hands in something else than frames."""

    def imagined(motions: Motions, frames: Frame) -> Frame:
        drawn = model.imagine_motion(frames, motions.actions, motions.lengths, motions.labels)
        return require_frames(drawn, name=name, rows=len(motions))

    right = _shows(reader, imagined(asked.planned, asked.planned.before), asked.planned.reached)
    of_raised = imagined(asked.raised, asked.raised.before)
    nothing = _shows(reader, of_raised, asked.raised.reached)
    painted = _shows(reader, of_raised, asked.planned.reached)
    still = np.ones(len(asked.chains[0]), dtype=bool)
    by_depth = []
    frames = asked.chains[0].before
    for motions in asked.chains:
        frames = imagined(motions, frames)
        still &= _shows(reader, frames, motions.reached)
        by_depth.append(float(still.mean()))
    return MotionScores(
        right=float(right.mean()),
        nothing_right=float(nothing.mean()),
        painted=float(painted.mean()),
        pairs=float((right & nothing).mean()),
        by_depth=tuple(by_depth),
        fit_cpu_s=fit_cpu_s,
        parameters=model.parameters(),
    )


def _shows(reader: ImageReader, frames: Frame, macrostates: Ints) -> Bools:
    """Whether each frame is read as its macrostate; people's gestures are no matter of a motion. Shape (N,)."""
    found: Bools = (reader.read(frames)[:, :-1] == macrostates[:, :-1]).all(axis=1)
    return found


def judge_motions(
    task: str, models: Sequence[str], sizes: Sequence[int], seeds: Sequence[int], folder: Path
) -> list[Row]:
    """Fit and ask models of motions, all on the same data.

    Args:
        task: A control task that has continuous control.
        models: Names of :data:`.registry.MOTION_MODELS`.
        sizes: Numbers of motions to learn from.
        seeds: Of data and models.
        folder: Where the reader of images is kept.

    Returns:
        A row for each model, size and seed; the first is the simulator's own frames, as the reader reads them.

    Raises:
        UnknownNameError: No such task or model.
        InvalidValueError: A task without continuous control, sizes below 1, or the answer of a model is no frames.
    """
    entry = registry.task_entry(task)
    if not entry.motion or min(sizes) < 1:
        raise InvalidValueError(f"Task {task} cannot be judged at sizes {tuple(sizes)}; give a task of this suite.")
    for name in models:
        require_known("model of motions", name, registry.MOTION_MODELS)
    spec = registry.task(task)
    env = registry.load(entry.motion)(**entry.options, observation="proprio", time_limit_s=float("inf"))
    source = MotionSource(env)
    asked = questions(source, SeedTree(0).child("evaluation", "motions", spec.id))
    reader = reader_in(spec, "clean", folder)
    rows = [Row("simulator", 0, 0, score("simulator", Simulator(asked), asked, reader, 0.0))]
    for seed in seeds:
        tree = SeedTree(seed)
        data = source.draw(max(sizes), tree.child("training", "motions", spec.id).generator())
        for name in models:
            for size in sizes:
                model = _made(name, spec, tree)
                begun_s = time.process_time()
                model.fit(data.first(size), tree.child("model", name, size).generator())
                spent_s = time.process_time() - begun_s
                rows.append(Row(name, size, seed, score(name, model, asked, reader, spent_s)))
    return rows


class Simulator(Untaught):
    """Hands in the true final frames of the questions: the reader's reading of them bounds every model."""

    def __init__(self, asked: MotionQuestions) -> None:
        every = (asked.planned, asked.raised, *asked.chains)
        self._after = {id(motions.actions): motions.after for motions in every}

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """The frame that the simulator ended with."""
        del frames, lengths, labels
        return self._after[id(actions)]


def _made(name: str, spec: TaskSpec, seeds: SeedTree) -> MotionModel:
    entry = registry.MOTION_MODELS[name]
    context = AgentContext(
        n_actions=spec.n_actions,
        preprocessing=spec.preprocessing,
        encoder=None if entry.encoder_kind is None else encoder_for(spec, "clean", entry.encoder_kind, None),
        seeds=seeds,
        config_group=spec.config_group,
    )
    made: MotionModel = registry.load(entry.make)(context)
    return made
