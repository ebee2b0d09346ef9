"""What must hold of a world model, on a few real episodes of a task's kinematic execution."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.interfaces import Frame
from imagine_bench.interfaces.episodes import Episodes, content_hash
from imagine_bench.interfaces.model import Imagined, WorldModel, require_imagined
from imagine_bench.judge.models import make
from imagine_bench.judge.predictions import RenderedFrameIndex, call
from imagine_bench.running.collect import collect, policy_of
from imagine_bench.seeding import SeedTree
from imagine_bench.testing.common import require

_EPISODES = 8
_SEED = 1_000
_HISTORY = 2
_DEPTH = 3
_SAMPLES = 4
"""Frames shown, macro-actions and futures imagined, of the longer questions."""
_METHODS = ("fit", "imagine", "parameters")


class CheckedModel(NamedTuple):
    """A world model that is checked, and where."""

    name: str
    task: str

    def make(self) -> WorldModel:
        """A new one."""
        spec = registry.task(self.task)
        seeds = SeedTree(_SEED).child("judge", self.task)
        return make(self.name, spec, RenderedFrameIndex(spec, "clean"), "clean", seeds)[0]

    def fitted(self) -> WorldModel:
        """A new one that has seen the episodes."""
        model = self.make()
        call(self.name, "fit", model.fit, _episodes(self.task), np.random.default_rng(0))
        return model

    def imagine(self, model: WorldModel, frames: Frame, actions: NDArray[np.int64], samples: int) -> Imagined:
        """What a model imagines with a generator that is always the same, if it is what it has to be."""
        given = (frames, actions, samples, np.random.default_rng(1))
        imagined = call(self.name, "imagine", model.imagine, *given)
        depth = actions.shape[1] - frames.shape[1] + 1
        return require_imagined(imagined, name=self.name, rows=len(frames), depth=depth, samples=samples)


@functools.lru_cache(maxsize=1)
def _episodes(task: str) -> Episodes:
    spec = registry.task(task)
    policy = policy_of("random", spec, _SEED)
    return collect(spec, policy, episodes=_EPISODES, seed=_SEED, execution="kinematic", appearance="clean")[0]


def _questions(task: str, history: int, depth: int) -> tuple[Frame, NDArray[np.int64]]:
    """The first frames of some episodes, with the macro-actions between them, and random ones after them."""
    episodes = _episodes(task)
    rng = np.random.default_rng(2)
    places = [episodes.steps(index) for index in range(len(episodes)) if episodes.lengths[index] >= history - 1]
    frames = np.stack([episodes.frames[rows.start : rows.start + history] for _, rows in places])
    between = np.stack([episodes.actions[steps.start : steps.start + history - 1] for steps, _ in places])
    return frames, np.hstack([between, rng.integers(episodes.n_actions, size=(len(frames), depth))])


def _made(one: CheckedModel) -> None:
    model = one.make()
    lacks = [name for name in _METHODS if not callable(getattr(model, name, None))]
    require(not lacks, f"{type(model).__name__} lacks {', '.join(lacks)}")


def _learns(one: CheckedModel) -> None:
    before = _content(_episodes(one.task))
    count = call(one.name, "parameters", one.fitted().parameters)
    require(_content(_episodes(one.task)) == before, "fit() alters the episodes that it is given")
    sound = isinstance(count, int | np.integer) and not isinstance(count, bool)
    require(sound and int(count) >= 0, f"parameters() gave {count!r}; give how many numbers were fitted")


def _content(episodes: Episodes) -> str:
    return content_hash(episodes.arrays())


def _imagines(one: CheckedModel) -> None:
    model = one.fitted()
    for history, depth, samples in ((1, 1, 1), (1, _DEPTH, _SAMPLES), (_HISTORY, _DEPTH, 1), (_HISTORY, 1, _SAMPLES)):
        frames, actions = _questions(one.task, history, depth)
        seen = (frames.copy(), actions.copy())
        one.imagine(model, frames, actions, samples)
        one.imagine(model, frames[:1], actions[:1], samples)
        alike = np.array_equal(frames, seen[0]) and np.array_equal(actions, seen[1])
        require(alike, "imagine() alters the frames or actions that it is given")


def _asked_again(one: CheckedModel) -> None:
    model = one.fitted()
    given = (*_questions(one.task, _HISTORY, _DEPTH), _SAMPLES)
    once, again = (_arrays(one.imagine(model, *given)) for _ in range(2))
    require(once == again, "asked twice with equal generators, it imagines otherwise")


def _repeats(one: CheckedModel) -> None:
    given = (*_questions(one.task, _HISTORY, _DEPTH), _SAMPLES)
    one_s, other_s = (_arrays(one.imagine(one.fitted(), *given)) for _ in range(2))
    require(one_s == other_s, "two models with equal episodes and generators differ")


def _arrays(imagined: Imagined) -> dict[str, Any]:
    given = {field.name: getattr(imagined, field.name) for field in dataclasses.fields(imagined)}
    return {name: None if array is None else array.tobytes() for name, array in given.items()}


MODEL_CHECKS: Mapping[str, Callable[[CheckedModel], None]] = {
    "it is made, with fit, imagine and parameters": _made,
    "it learns from episodes, and leaves them as they are": _learns,
    "it imagines pictures at every depth, and probabilities that sum to 1": _imagines,
    "asked again with the same generator it imagines the same": _asked_again,
    "the same episodes and generators give the same model": _repeats,
}
"""What must hold of a world model, a sentence each."""
