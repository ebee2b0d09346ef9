"""A small recurrent predictor of motions: a frame and all commands of a motion to the frame at its end, in plain torch.

A convolutional network sees the scene, a gated recurrent unit reads the commands, and the output of both is painted
over the frame, as in :mod:`imagine_bench.agents.world_models.convolutional`. Kernels and strides of its convolutions
are one patch of 4 x 4, so that they are matrix products of patches. Shapes: ``P`` = 48 numbers of a patch of pixels.
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

_STEPS = 1_500
_BATCH = 16
_RATE = 3e-3
_EVERY = 4
"""Control periods that the recurrent unit reads at once."""
_HIDDEN = 128
_PATCH = 4
"""Edge of a patch in pixels."""


class MotionNetwork(nn.Module):
    """From patches (N, 16, 16, P) of frames and actions (N, T, A) to those of frames at the motions' ends."""

    def __init__(self, action_size: int) -> None:
        super().__init__()
        patch = _PATCH * _PATCH
        self.first = nn.Linear(3 * patch, 16)
        self.second = nn.Linear(16 * patch, 32)
        self.commands = nn.GRU(2 * _EVERY * action_size, _HIDDEN, batch_first=True)
        self.middle = nn.Sequential(nn.Linear(512 + _HIDDEN, 256), nn.ReLU(), nn.Linear(256, 512), nn.ReLU())
        self.third = nn.Linear(64, 16 * patch)
        self.last = nn.Linear(16, 6 * patch)

    def draw_weights(self, generator: torch.Generator) -> None:
        """Draw all weights anew, by torch's own laws: its constructors draw from the global generator."""
        initialise(self, generator)
        bound = self.commands.hidden_size**-0.5
        with torch.no_grad():
            for weight in self.commands.parameters():
                weight.uniform_(-bound, bound, generator=generator)

    def forward(self, before: Tensor, actions: Tensor, lengths: Tensor) -> Tensor:
        """Patches (N, 16, 16, P) at the ends of motions of ``lengths`` (N,) periods."""
        commands = nn.functional.pad(actions, (0, 0, 0, -actions.shape[1] % _EVERY))
        placed = torch.cat([commands, 0.2 * commands.cumsum(dim=1)], dim=2)  # velocities, and where they have led
        read, _ = self.commands(placed.reshape(len(before), placed.shape[1] // _EVERY, -1))
        goal = read[torch.arange(len(before)), (lengths - 1) // _EVERY]
        seen = self.second(patches(self.first(before).relu())).relu()  # [N, 4, 4, 32]
        hidden = self.middle(torch.cat([seen.flatten(1), goal], dim=1)).view_as(seen)
        fine = images(self.third(torch.cat([seen, hidden], dim=3))).relu()  # [N, 16, 16, 16]
        drawn, mask = self.last(fine).chunk(2, dim=3)
        mask = (mask - 3.0).sigmoid()  # where it paints over the former image: at first almost nowhere
        return (1.0 - mask) * before + mask * drawn.sigmoid()


def patches(rows: Tensor) -> Tensor:
    """Images (N, H, W, C) as patches (N, H / 4, W / 4, 16 C)."""
    count, height, width, channels = rows.shape
    cut = rows.reshape(count, height // _PATCH, _PATCH, width // _PATCH, _PATCH, channels)
    return cut.transpose(2, 3).flatten(3)


def images(rows: Tensor) -> Tensor:
    """The inverse of :func:`patches`."""
    count, height, width, _ = rows.shape
    cut = rows.view(count, height, width, _PATCH, _PATCH, -1)
    return cut.transpose(2, 3).reshape(count, height * _PATCH, width * _PATCH, -1)


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
        before = _read(dataset.before)
        after = _read(dataset.after)
        optimiser = torch.optim.Adam(network.parameters(), lr=_RATE)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=_RATE, total_steps=_STEPS)
        for _ in range(_STEPS):
            rows = torch.randint(len(actions), (_BATCH,), generator=generator)
            loss = (network(before[rows], actions[rows], lengths[rows]) - after[rows]).square().mean()
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
        drawn = images(self.network(_read(frames), torch.from_numpy(actions), torch.from_numpy(lengths)))
        return (drawn * 255.0).round().to(torch.uint8).numpy()

    def parameters(self) -> int:
        """Weights and biases."""
        return 0 if self.network is None else sum(each.numel() for each in self.network.parameters())


def _read(frames: Frame) -> Tensor:
    """Patches (N, 16, 16, P) of frames, in [0, 1]."""
    return patches(torch.from_numpy(frames)).float() / 255.0


def make(context: AgentContext) -> Recurrent:
    """The model for a task."""
    prepare_torch(context.device)
    return Recurrent()
