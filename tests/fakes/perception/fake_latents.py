"""A readable stand-in for an encoder: pixel (0, 0, 0) of a frame is its state, a fixed table gives its latents."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar
from unittest import mock

import numpy as np
import torch
from imagine_bench.agents import dqn
from imagine_bench.agents.encoders import perception

from imagine_bench import registry
from imagine_bench.interfaces import AgentContext, Frame, Observation, Transition
from imagine_bench.seeding import SeedTree

LATENTS = 4
ACTIONS = 3
Made = TypeVar("Made")
CODES = torch.from_numpy(np.random.default_rng(5).normal(size=(16, LATENTS)).astype(np.float32))
SIGMA = 0.05
SMALL: dict[str, Any] = {
    "model.dynamics_hidden": (16, 16),
    "model.reward_hidden": (16,),
    "model.termination_hidden": (16,),
    "model.updates_per_step": 2,
    "model.batch_size": 8,
    "controller.hidden": (16, 16),
    "controller.batch_size": 8,
    "imagination.start_episode": 2,
    "imagination.weight_samples": 4,
    "imagination.depth": 3,
    "memory.real": 64,
    "memory.imagined": 20,
}


class FakeEncoder:
    """The methods of :class:`imagine_bench.agents.encoders.encoder.Encoder`."""

    latent_size = LATENTS
    device = torch.device("cpu")
    card = SimpleNamespace(preprocessing="gray_strips")

    @classmethod
    def load(cls, path: Path, device: str) -> FakeEncoder:
        return cls()

    def encode(self, frames: Frame) -> tuple[torch.Tensor, torch.Tensor]:
        mu = CODES[torch.from_numpy(frames[:, 0, 0, 0].astype(np.int64))]
        return mu, torch.full_like(mu, SIGMA)

    def decode(self, z: torch.Tensor) -> np.ndarray:
        return np.zeros((len(z), 64, 64), dtype=np.float32)

    def read_macrostate(self, z: torch.Tensor) -> np.ndarray:
        return torch.cdist(z, CODES).argmin(dim=1, keepdim=True).numpy()


def frame(state: int) -> Frame:
    picture = np.zeros((64, 64, 3), dtype=np.uint8)
    picture[0, 0, 0] = state
    return picture


def transition(
    state: int, action: int, reward: float, following: int, *, terminated: bool = False, truncated: bool = False
) -> Transition:
    return Transition(
        observation=Observation(frame=frame(state)),
        action=action,
        reward=reward,
        next_observation=Observation(frame=frame(following)),
        terminated=terminated,
        truncated=truncated,
    )


def built(maker: Callable[[AgentContext], Made], overrides: dict[str, Any] | None = None, **changes: Any) -> Made:
    """The agent that a maker makes from a context whose encoder is the fake one and whose networks are tiny."""
    context = AgentContext(
        n_actions=ACTIONS,
        preprocessing="gray_strips",
        encoder=Path("fake.safetensors"),
        seeds=SeedTree(0),
        hyperparameters="published",
        overrides={**SMALL, **(overrides or {})},
    )
    with mock.patch.object(perception, "Encoder", FakeEncoder):
        return maker(replace(context, **changes))


def with_own_settings(name: str, maker: Callable[[AgentContext], Made]) -> Callable[[AgentContext], Made]:
    """The maker of an agent, given those of the overrides that it has, as in a bench."""
    return lambda context: maker(replace(context, overrides=registry.own_settings(name, context.overrides)))


make_dqn = with_own_settings("dqn", dqn.make)


def live(agent: Any, episodes: range, rng: np.random.Generator, states: int = 6) -> list[int]:
    """Let an agent learn on a random walk of two-step episodes; its actions."""
    actions = []
    for episode in episodes:
        state = int(rng.integers(states))
        for step in range(2):
            action = agent.act(Observation(frame=frame(state)), explore=True)
            following = (state + action) % states
            reward = float(following == 0)
            last = step == 1
            agent.observe(transition(state, action, reward, following, terminated=last), episode=episode)
            actions.append(action)
            state = following
    return actions
