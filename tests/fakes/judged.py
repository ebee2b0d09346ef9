"""Worlds that are judged without a renderer: their frames hold their content as numbers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from fake_reader import BlindReader
from imagine_bench.agents.world_models.limits import Copy, Exact
from numpy.typing import NDArray
from small_runs import context

from imagine_bench import registry
from imagine_bench.arrays import Ints
from imagine_bench.interfaces import Frame, State, TaskSpec
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge import questions
from imagine_bench.judge.change import Streams, counterfactual_error, streams_of
from imagine_bench.judge.predictions import Predictions, evaluate
from imagine_bench.judge.questions import EvalSet
from imagine_bench.judge.reading import RenderedFrameIndex
from imagine_bench.judge.scores import one_step_scores, ranking_scores

STILL = Copy(context())
"""Says that nothing ever changes."""


def labelled(task: str) -> TaskSpec:
    """A task whose frames show numbers: one more than each coordinate, 0 for a hidden one, and some noise."""

    def render(states: NDArray[np.int64], appearance: str, rng: np.random.Generator) -> Frame:
        frames = np.zeros((len(states), 64, 64, 3), dtype=np.uint8)
        frames[:, 0, : states.shape[1], 0] = states + 1
        frames[:, 1] = rng.integers(256, size=(len(states), 64, 3))
        return frames

    return dataclasses.replace(registry.task(task), render_macrostates=render)


def shown(frame: Frame, spec: TaskSpec) -> NDArray[np.int64]:
    """The content of a labelled frame; -1 for a hidden coordinate."""
    return frame[0, : len(spec.macrostate_names), 0].astype(np.int64) - 1


@dataclasses.dataclass(frozen=True)
class JudgedWorld:
    """A world, and all that models are asked about it."""

    spec: TaskSpec
    index: RenderedFrameIndex

    @functools.cached_property
    def one_step(self) -> EvalSet:
        return questions.one_step(self.spec, self.index.render)

    @functools.cached_property
    def rollouts(self) -> EvalSet:
        return questions.rollouts(self.spec, self.index.render)

    @functools.cached_property
    def ranked(self) -> EvalSet:
        return questions.ranked(self.spec, self.index.render)

    @functools.cached_property
    def counterfactuals(self) -> tuple[EvalSet, ...]:
        return questions.counterfactuals(self.spec, self.index.render)

    @functools.cached_property
    def streams(self) -> dict[str, Streams]:
        found = streams_of(self.spec, self.one_step)
        assert found is not None
        return found

    @functools.cached_property
    def exact(self) -> Exact:
        return Exact(self.spec, self.index)

    def predictions(self, model: WorldModel, asked: EvalSet, samples: int = 2) -> Predictions:
        reader, rng = BlindReader(len(self.spec.macrostate_names)), np.random.default_rng(0)
        return evaluate(model, "it", asked, samples=samples, reader=reader, index=self.index, rng=rng)

    def scores(self, model: WorldModel) -> dict[str, Any]:
        found = one_step_scores(self.spec, self.one_step, self.predictions(model, self.one_step), set())
        return found | ranking_scores(self.spec, self.ranked, self.predictions(model, self.ranked))

    def counterfactual_error(self, model: WorldModel) -> float:
        return counterfactual_error(
            self.counterfactuals, [self.predictions(model, each) for each in self.counterfactuals]
        )


class Altered(Exact):
    """Exact, but that ``alter`` is given what it imagines, the frames and the actions, and returns what it says."""

    def __init__(self, world: JudgedWorld, alter: Callable[[Imagined, Frame, Ints], Imagined]) -> None:
        super().__init__(world.spec, world.index)
        self.alter = alter

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        return self.alter(super().imagine(frames, actions, samples, rng), frames, actions)


def asked_pairs(world: JudgedWorld, frames: Frame, actions: Ints) -> list[tuple[State, int]]:
    """What each question begins with: the macrostate of its last frame, and its first macro-action."""
    states = [tuple(shown(frame, world.spec).tolist()) for frame in frames[:, -1]]
    return list(zip(states, actions[:, 0].tolist(), strict=True))


@functools.cache
def judged_world(task: str) -> JudgedWorld:
    spec = labelled(task)
    return JudgedWorld(spec, RenderedFrameIndex(spec, "clean"))
