"""A bonus for observations that were seldom seen: random network distillation (RND).

Burda et al. 2018, "Exploration by Random Network Distillation", arXiv:1810.12894. A network with fixed random weights
gives each observation an output, and a second network learns to predict it from the visited observations. Its squared
error is large where little was visited, and is paid beside the reward.

Two things differ from the paper. The learner has one value function for both rewards, where the paper has two. So the
bonus ends with the episode, and both rewards have one discount.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from torch import nn

from imagine_bench.arrays import Floats32
from imagine_bench.seeding import SeedTree

from .sb3_settings import NoveltySettings

_CLIP = 5.0
"""Largest absolute value of a normalised observation, as in the paper."""


class NoveltyBonus(gymnasium.Wrapper[Floats32, Any, Floats32, Any]):
    """Adds ``weight`` times the normalised error of the predictor to every reward.

    Observations are normalised by their running mean and deviation and clipped to [-5, 5]. The error is divided by the
    running deviation of the discounted sum of errors (the paper, section 2.4). Each ``info`` has the bonus as
    ``novelty``.

    Args:
        env: An environment of vectors (Z,), float32.
        settings: Weight, learning rate, width, discount, and how often the predictor learns.
        seeds: Of both networks' weights.
    """

    def __init__(self, env: gymnasium.Env[Floats32, Any], settings: NoveltySettings, seeds: SeedTree) -> None:
        super().__init__(env)
        assert env.observation_space.shape is not None
        (size,) = env.observation_space.shape
        generator = torch.Generator().manual_seed(seeds.integer())
        self._settings = settings
        self._target = _network(size, settings.width, generator).requires_grad_(requires_grad=False)
        self._predictor = _network(size, settings.width, generator)
        self._optimiser = torch.optim.Adam(self._predictor.parameters(), lr=settings.learning_rate)
        self._seen = RunningMeanStd(shape=(size,))
        self._sums = RunningMeanStd(shape=())
        self._sum = 0.0
        self._visited: list[Floats32] = []

    def step(self, action: Any) -> tuple[Floats32, float, bool, bool, dict[str, Any]]:
        """One step of the environment, paid with the bonus of the observation that it leads to."""
        observation, reward, over, cut, info = self.env.step(action)
        bonus = self._bonus(observation)
        return observation, float(reward) + self._settings.weight * bonus, over, cut, {**info, "novelty": bonus}

    def _bonus(self, observation: Floats32) -> float:
        """The normalised error at an observation (Z,), which then counts as visited."""
        self._seen.update(observation[None])
        with torch.no_grad():
            error = float(self._errors(observation[None]))
        self._visited.append(observation)
        if len(self._visited) == self._settings.update_every:
            self._learn()
        self._sum = self._settings.discount * self._sum + error
        self._sums.update(np.array([self._sum]))
        return error / float(np.sqrt(self._sums.var + 1e-8))

    def _errors(self, observations: Floats32) -> torch.Tensor:
        """The mean squared error at observations (N, Z). Shape ()."""
        scaled = (observations - self._seen.mean) / np.sqrt(self._seen.var + 1e-8)
        inputs = torch.from_numpy(np.clip(scaled, -_CLIP, _CLIP).astype(np.float32))
        return nn.functional.mse_loss(self._predictor(inputs), self._target(inputs))

    def _learn(self) -> None:
        """Some gradient steps on the observations that were visited since the last ones."""
        observations = np.stack(self._visited)
        self._visited.clear()
        for _ in range(self._settings.epochs):
            self._optimiser.zero_grad()
            self._errors(observations).backward()
            self._optimiser.step()


def _network(size: int, width: int, generator: torch.Generator) -> nn.Sequential:
    """An untrained network of two hidden layers, from ``size`` to ``width`` numbers, with orthogonal weights."""
    network = nn.Sequential(
        nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width)
    )
    for layer in network:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain=2.0**0.5, generator=generator)
            nn.init.zeros_(layer.bias)
    return network
