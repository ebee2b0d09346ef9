"""A convolutional next-frame predictor of plain torch: as a newcomer would write it first.

The latest frame and the action go into a small U-shaped network that draws the next frame; reward and end are read from
its narrowest layer. It imagines one future, and has no measure of uncertainty.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.arrays import Frame, Ints
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, until_the_end

from ..encoders.perception import prepare_torch
from ..networks.mlp import initialise

_STEPS = 1_200
_BATCH = 32
_RATE = 2e-3
_REWARD = 10.0  # units of reward that the network's output is in


class NextFrame(nn.Module):
    """From frames (N, 3, 64, 64) and actions to next frames, rewards and logits of the end."""

    def __init__(self, n_actions: int) -> None:
        super().__init__()
        self.n_actions = n_actions
        self.down = nn.Sequential(nn.Conv2d(3, 16, 4, stride=4), nn.ReLU(), nn.Conv2d(16, 32, 4, stride=4), nn.ReLU())
        self.middle = nn.Sequential(nn.Linear(512 + n_actions, 256), nn.ReLU(), nn.Linear(256, 512), nn.ReLU())
        self.up = nn.Sequential(
            nn.ConvTranspose2d(64, 16, 4, stride=4), nn.ReLU(), nn.ConvTranspose2d(16, 6, 4, stride=4)
        )
        self.outcome = nn.Linear(512, 2)

    def forward(self, frames: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Next frames (N, 3, 64, 64), rewards (N,) in units of 10, logits (N,)."""
        seen = self.down(frames)
        hidden = self.middle(torch.cat([seen.flatten(1), functional.one_hot(actions, self.n_actions)], dim=1))
        drawn, mask = self.up(torch.cat([seen, hidden.view_as(seen)], dim=1)).chunk(2, dim=1)
        mask = (mask - 3.0).sigmoid()  # where it paints over the former image: at first almost nowhere
        reward, logit = self.outcome(hidden).unbind(dim=1)
        return (1.0 - mask) * frames + mask * drawn.sigmoid(), reward, logit


class Convolutional:
    """The network as a world model."""

    def __init__(self, n_actions: int) -> None:
        self.network = NextFrame(n_actions)

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Squared error of pixels and rewards, cross-entropy of ends; as many steps whatever the data."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        initialise(self.network, generator)
        before = dataset.rows[0]
        actions = torch.tensor(dataset.actions)
        rewards = torch.tensor(dataset.rewards).float()
        ended = torch.tensor(dataset.terminated).float()
        optimiser = torch.optim.Adam(self.network.parameters(), lr=_RATE)
        for _ in range(_STEPS):
            rows = torch.randint(len(actions), (_BATCH,), generator=generator)
            chosen = before[rows.numpy()]
            images = _images(torch.from_numpy(dataset.frames[chosen]))
            target = _images(torch.from_numpy(dataset.frames[chosen + 1]))
            drawn, reward, logit = self.network(images, actions[rows])
            loss = 50.0 * (drawn - target).square().mean() + (reward - rewards[rows] / _REWARD).square().mean()
            loss = loss + functional.binary_cross_entropy_with_logits(logit, ended[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()

    @torch.no_grad()
    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """One future, fed its own pictures; see :class:`.interfaces.model.WorldModel`."""
        del samples, rng
        images = _images(torch.tensor(frames[:, -1]))
        steps = []
        for action in torch.tensor(actions[:, frames.shape[1] - 1 :]).unbind(dim=1):
            images, reward, logit = self.network(images, action)
            drawn = (images.permute(0, 2, 3, 1) * 255.0).round().to(torch.uint8)
            steps.append((drawn, reward, logit.sigmoid()))
        pictures, rewards, ends = (torch.stack(each, dim=1).numpy()[:, None] for each in zip(*steps, strict=True))
        counted, p_ended = until_the_end(rewards, ends)
        certain = np.ones(counted.shape)
        return Imagined(pictures=pictures, probabilities=certain, rewards=counted * _REWARD, p_ended=p_ended)

    def parameters(self) -> int:
        """Weights and biases."""
        return sum(parameter.numel() for parameter in self.network.parameters())


def _images(frames: Tensor) -> Tensor:
    return frames.permute(0, 3, 1, 2).float() / 255.0


def make(context: AgentContext) -> Convolutional:
    """The model for a task."""
    prepare_torch(context.device)
    return Convolutional(context.n_actions)
