"""A readable stand-in for an encoder of codes, and a tiny world of two wheels and a lamp to live in."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import torch
from imagine_bench_factored.agent import FactoredAgent
from imagine_bench_factored.factors import CodeTransition
from imagine_bench_factored.perception import CodePerception
from imagine_bench_factored.settings import HYPERPARAMETERS
from torch.nn import functional

from imagine_bench.interfaces import Frame, Observation, Transition
from imagine_bench.interfaces.capabilities import begin_episode
from imagine_bench.seeding import SeedTree

SIZES = (3, 3, 2)
ACTIONS = 4


class FakeCodes:
    """Pixels (0, 0..2, 0) of a frame are its code."""

    card = SimpleNamespace(code_sizes=SIZES)

    def encode(self, frames: Frame) -> tuple[torch.Tensor, torch.Tensor]:
        codes = torch.tensor(frames[:, 0, : len(SIZES), 0]).long()
        hot = [functional.one_hot(codes[:, factor], size) for factor, size in enumerate(SIZES)]
        mu = torch.cat(hot, dim=1).float()
        return mu, torch.zeros_like(mu)

    def decode(self, latents: torch.Tensor) -> np.ndarray:
        images = np.zeros((len(latents), 64, 64), dtype=np.float32)
        images[:, 0, : len(SIZES)] = self.read_macrostate(latents) / 255.0
        return images

    def read_macrostate(self, latents: torch.Tensor) -> np.ndarray:
        return torch.stack([part.argmax(dim=1) for part in latents.split(SIZES, dim=1)], dim=1).numpy()


def frame(code: tuple[int, ...]) -> Frame:
    image = np.zeros((64, 64, 3), dtype=np.uint8)
    image[0, : len(code), 0] = code
    return image


def step(code: tuple[int, ...], action: int) -> tuple[tuple[int, ...], float, bool]:
    """Actions 0, 1 turn the first wheel on and back, 2, 3 the second.

    Equal wheels end it badly, (2, 1) under a lit lamp and (1, 2) under a dark one end it well.
    """
    wheel, back = divmod(action, 2)
    following = list(code)
    following[wheel] = (following[wheel] + (-1 if back else 1)) % 3
    reached = tuple(following)
    if reached[0] == reached[1]:
        return reached, -5.0, True
    if reached == ((2, 1, 1) if reached[2] else (1, 2, 0)):
        return reached, 10.0, True
    return reached, -1.0, False


def transition(code: tuple[int, ...], action: int) -> Transition:
    following, reward, ended = step(code, action)
    return Transition(
        observation=Observation(frame=frame(code)),
        action=action,
        reward=reward,
        next_observation=Observation(frame=frame(following)),
        terminated=ended,
        truncated=False,
    )


def starts() -> list[tuple[int, ...]]:
    codes = [(a, b, lamp) for a in range(3) for b in range(3) for lamp in range(2) if a != b]
    return [code for code in codes if code not in ((2, 1, 1), (1, 2, 0))]


def drawn(rng: np.random.Generator, steps: int = 6) -> Iterator[CodeTransition]:
    """One episode of drawn macro-actions, cut after so many."""
    code = starts()[int(rng.integers(len(starts())))]
    for _ in range(steps):
        action = int(rng.integers(ACTIONS))
        following, reward, ended = step(code, action)
        yield CodeTransition(code, action, following, reward, ended)
        code = following
        if ended:
            return


def agent(seed: int = 0, **overrides: object) -> FactoredAgent:
    settings = HYPERPARAMETERS.resolve(
        "fast", {name.replace("__", "."): value for name, value in overrides.items()}, "chapter_5"
    )
    perception = CodePerception(FakeCodes(), factored=settings.dynamics.factored)  # type: ignore[arg-type]
    return FactoredAgent(perception, ACTIONS, settings, SeedTree(seed))


def live(learner: FactoredAgent, episodes: range, rng: np.random.Generator, horizon: int = 6) -> list[int]:
    """Train on the tiny world; the actions taken."""
    taken = []
    for episode in episodes:
        code = starts()[int(rng.integers(len(starts())))]
        for _ in range(horizon):
            action = learner.act(Observation(frame=frame(code)), explore=True)
            learner.observe(transition(code, action), episode=episode)
            taken.append(action)
            code, _, ended = step(code, action)
            if ended:
                break
    return taken


def success(learner: FactoredAgent, horizon: int = 6) -> float:
    """Share of starts from which the greedy agent ends well."""
    solved = 0
    for start in starts():
        begin_episode(learner)
        code = start
        for _ in range(horizon):
            code, reward, ended = step(code, learner.act(Observation(frame=frame(code)), explore=False))
            if ended:
                solved += reward > 0
                break
    return solved / len(starts())
