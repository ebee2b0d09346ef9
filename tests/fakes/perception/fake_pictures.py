"""Pictures of the tiny world of two wheels and a lamp, and an agent that learns to see them."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import fake_codes
import numpy as np
from fake_codes import ACTIONS, starts
from imagine_bench_factored.learned import LearnedPerceptionAgent
from imagine_bench_factored.perception import LearnedPerception
from imagine_bench_factored.settings import LEARNED
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import begin_episode
from imagine_bench.seeding import SeedTree

Code = tuple[int, ...]
HIDDEN = 2
"""Value of the lamp where it is covered."""


def shape(kind: int) -> NDArray[np.float64]:
    """One of three marks of a wheel, or the two of the lamp: bars and a ring. Shape (12, 12)."""
    rows, columns = np.mgrid[:12, :12]
    ring = (np.hypot(rows - 5.5, columns - 5.5) > 3.5) & (np.hypot(rows - 5.5, columns - 5.5) < 6.0)
    return np.asarray([abs(rows - 5.5) < 2, abs(columns - 5.5) < 2, ring][kind], dtype=np.float64)


def picture(code: Code, rng: np.random.Generator) -> Frame:
    """Two wheels and a lamp, each moved by up to two pixels, under a tint that is drawn anew."""
    image = np.full((64, 64, 3), 0.4)
    for value, (top, left) in zip(code, ((6, 6), (6, 40), (42, 24)), strict=True):
        down, right = rng.integers(-2, 3, size=2)
        image[top + down : top + down + 12, left + right : left + right + 12] += 0.5 * shape(value)[..., None]
    return (255.0 * image * rng.uniform(0.6, 1.0, size=3)).astype(np.uint8)


def agent(seed: int = 0, **overrides: object) -> LearnedPerceptionAgent:
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    settings = LEARNED.resolve("fast", named, "chapter_5")
    perception = LearnedPerception(settings.perception, factored=settings.dynamics.factored)
    return LearnedPerceptionAgent(perception, ACTIONS, settings, SeedTree(seed))


def hidden(code: Code) -> Code:
    """A code whose lamp is covered: in every frame of an episode but its first, where tests cover it."""
    return (*code[:2], HIDDEN)


def _reward(code: Code, action: int) -> float:
    return fake_codes.step(code, action)[1]


def played(
    learner: LearnedPerceptionAgent | None,
    rng: np.random.Generator,
    *,
    explore: bool = False,
    covered: bool = False,
    steps: int = 6,
) -> Iterator[Transition]:
    """One episode in pictures of the world, cut after so many macro-actions; nothing is learned from it here.

    Macro-actions are those of the learner; if there is none, the better of two that are drawn, which takes less time.
    """
    if learner is not None:
        begin_episode(learner)
    code = starts()[int(rng.integers(len(starts())))]
    seen = Observation(frame=picture(code, rng))
    for step in range(steps):
        if learner is None:
            action = max(rng.integers(ACTIONS, size=2).tolist(), key=functools.partial(_reward, code))
        else:
            action = learner.act(seen, explore=explore)
        code, reward, ended = fake_codes.step(code, action)
        after = Observation(frame=picture(hidden(code) if covered else code, rng))
        yield Transition(
            observation=seen,
            action=action,
            reward=reward,
            next_observation=after,
            terminated=ended,
            truncated=not ended and step == steps - 1,
        )
        seen = after
        if ended:
            return
