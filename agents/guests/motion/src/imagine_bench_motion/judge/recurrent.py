"""A small recurrent predictor of motions: a frame and all commands of a motion to the frame at its end, in plain torch.

A convolutional network sees the scene, a gated recurrent unit reads the commands, and the output of both is painted
over the frame, as in :mod:`imagine_bench.agents.world_models.convolutional`.
"""

from __future__ import annotations

import numpy as np
import torch
from imagine_bench.agents.encoders.perception import prepare_torch
from imagine_bench.agents.networks.mlp import initialise
from torch import Tensor, nn

from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.interfaces import AgentContext

from .interface import Motions

_STEPS = 4_000
_BATCH = 32
_RATE = 2e-3
_EVERY = 2
"""Control periods that the recurrent unit reads at once."""
_HIDDEN = 128


class MotionNetwork(nn.Module):
    """From frames (N, 3, 64, 64) and actions (N, T, A) to frames at the motions' ends."""

    def __init__(self, action_size: int) -> None:
        super().__init__()
        self.down = nn.Sequential(nn.Conv2d(3, 16, 4, stride=4), nn.ReLU(), nn.Conv2d(16, 32, 4, stride=4), nn.ReLU())
        self.commands = nn.GRU(2 * _EVERY * action_size, _HIDDEN, batch_first=True)
        self.middle = nn.Sequential(nn.Linear(512 + _HIDDEN, 256), nn.ReLU(), nn.Linear(256, 512), nn.ReLU())
        self.up = nn.Sequential(
            nn.ConvTranspose2d(64, 16, 4, stride=4), nn.ReLU(), nn.ConvTranspose2d(16, 6, 4, stride=4)
        )

    def draw_weights(self, generator: torch.Generator) -> None:
        """Draw all weights anew, by torch's own laws: its constructors draw from the global generator."""
        initialise(self, generator)
        bound = self.commands.hidden_size**-0.5
        with torch.no_grad():
            for weight in self.commands.parameters():
                weight.uniform_(-bound, bound, generator=generator)

    def forward(self, frames: Tensor, actions: Tensor, lengths: Tensor) -> Tensor:
        """Frames (N, 3, 64, 64) at the ends of motions of ``lengths`` (N,) periods."""
        commands = nn.functional.pad(actions, (0, 0, 0, -actions.shape[1] % _EVERY))
        placed = torch.cat([commands, 0.2 * commands.cumsum(dim=1)], dim=2)  # velocities, and where they have led
        read, _ = self.commands(placed.reshape(len(frames), placed.shape[1] // _EVERY, -1))
        last = read[torch.arange(len(frames)), (lengths - 1) // _EVERY]
        seen = self.down(frames)
        hidden = self.middle(torch.cat([seen.flatten(1), last], dim=1))
        drawn, mask = self.up(torch.cat([seen, hidden.view_as(seen)], dim=1)).chunk(2, dim=1)
        mask = (mask - 3.0).sigmoid()  # where it paints over the former image: at first almost nowhere
        return (1.0 - mask) * frames + mask * drawn.sigmoid()


class Recurrent:
    """The network as a model of motions; see :class:`.interface.MotionModel`."""

    def __init__(self) -> None:
        self.network: MotionNetwork | None = None

    def fit(self, dataset: Motions, rng: np.random.Generator) -> None:
        """Squared error of pixels; as many steps whatever the data."""
        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        network = MotionNetwork(dataset.actions.shape[2])
        network.draw_weights(generator)
        actions = torch.from_numpy(dataset.actions)
        lengths = torch.from_numpy(dataset.lengths)
        optimiser = torch.optim.Adam(network.parameters(), lr=_RATE)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=_RATE, total_steps=_STEPS)
        for _ in range(_STEPS):
            rows = torch.randint(len(actions), (_BATCH,), generator=generator)
            before = _images(dataset.before[rows.numpy()])
            after = _images(dataset.after[rows.numpy()])
            loss = (network(before, actions[rows], lengths[rows]) - after).square().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
        self.network = network.requires_grad_(False)

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """The frame at the end of each motion; see :class:`.interface.MotionModel`."""
        assert self.network is not None
        del labels
        drawn = self.network(_images(frames), torch.from_numpy(actions), torch.from_numpy(lengths))
        return (drawn.permute(0, 2, 3, 1) * 255.0).round().to(torch.uint8).numpy()

    def parameters(self) -> int:
        """Weights and biases."""
        return 0 if self.network is None else sum(each.numel() for each in self.network.parameters())


def _images(frames: Frame) -> Tensor:
    return torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255.0


def make(context: AgentContext) -> Recurrent:
    """The model for a task."""
    prepare_torch(context.device)
    return Recurrent()
