"""The policy's network: from one moment to the next commands, all at once (action chunks; Zhao et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .instruction import WIDTH


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Sizes of inputs and outputs."""

    cameras: tuple[str, ...]  #: names of the images
    numbers: int  #: of the vector of other inputs
    commands: int  #: numbers of one command
    chunk: int = 16  #: commands that are predicted at once
    hidden: int = 256  #: units of the two hidden layers
    features: int = 64  #: numbers that each camera's image becomes


class Eye(nn.Sequential):
    """Two convolutions and a linear layer for one camera: (B, 3, S, S) in [0, 1] to (B, features)."""

    def __init__(self, size_px: int, features: int) -> None:
        edge = size_px // 8
        super().__init__(
            nn.Conv2d(3, 16, 8, stride=4, padding=2),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(32 * edge * edge, features),
            nn.ReLU(),
        )


class ChunkPolicy(nn.Module):
    """A convolutional network a camera, and a multilayer perceptron over everything.

    Args:
        layout: Sizes of inputs and outputs.
        size_px: Edge of the images; a multiple of 8.
    """

    def __init__(self, layout: Layout, size_px: int = 64) -> None:
        super().__init__()
        self.layout = layout
        self.eyes = nn.ModuleDict({camera: Eye(size_px, layout.features) for camera in layout.cameras})
        wide = layout.numbers + WIDTH + layout.features * len(layout.cameras)
        self.body = nn.Sequential(
            nn.Linear(wide, layout.hidden),
            nn.ReLU(),
            nn.Linear(layout.hidden, layout.hidden),
            nn.ReLU(),
            nn.Linear(layout.hidden, layout.chunk * layout.commands),
        )

    def forward(self, images: Mapping[str, Tensor], numbers: Tensor, words: Tensor) -> Tensor:
        """The next commands, standardised. Shape (B, chunk, commands).

        Args:
            images: For each camera, shape (B, 3, S, S), in [0, 1].
            numbers: Standardised. Shape (B, numbers).
            words: As :func:`.instruction.words_vector` says. Shape (B, 64).
        """
        seen = [self.eyes[camera](images[camera]) for camera in self.layout.cameras]
        flat = self.body(torch.cat([numbers, words, *seen], dim=1))  # [B, chunk * commands]
        return flat.unflatten(1, (self.layout.chunk, self.layout.commands))


def new_network(layout: Layout, size_px: int, generator: torch.Generator) -> ChunkPolicy:
    """A network with the first weights that torch's layers have by default, drawn from ``generator``."""
    with torch.device("meta"):
        network = ChunkPolicy(layout, size_px)
    network.to_empty(device="cpu")
    for layer in network.modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d)):
            most = 1.0 / math.sqrt(layer.weight[0].numel())
            for parameter in layer.parameters():
                nn.init.uniform_(parameter, -most, most, generator=generator)
    return network
