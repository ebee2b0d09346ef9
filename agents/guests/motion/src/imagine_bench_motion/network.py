"""The policy's network: from one moment to the next commands, all at once (action chunks; Zhao et al. 2023)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from imagine_bench.errors import require_integer

from .instruction import WIDTH

_MEAN_BRIGHTNESS = 0.4
POINT_PX = 4
"""Pixels from one place of a heat map to the next."""
_SHARPNESS = 5.0
"""Heat maps are multiplied by it, so that points are learned soon."""


@dataclass(frozen=True, kw_only=True)
class PolicyLayout:
    """Sizes of inputs and outputs. Raises InvalidValueError: no command, or a negative number of points."""

    cameras: tuple[str, ...]  #: names of the images
    numbers: int  #: of the vector of other inputs
    commands: int  #: numbers of one command
    chunk: int = 16  #: commands that are predicted at once
    hidden: int = 256  #: units of the two hidden layers
    features: int = 64  #: numbers that each camera's image becomes, without heat maps
    heat_maps: int = 0  #: points that are looked for in each camera's image; 0: it becomes ``features`` instead

    def __post_init__(self) -> None:
        require_integer("chunk", self.chunk, 1)
        require_integer("heat_maps", self.heat_maps, 0)


class ImageEncoder(nn.Sequential):
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


class PointEncoder(nn.Module):
    """Heat maps of one camera's image, and the mean point of each (spatial softmax; Finn et al. 2016).

    A heat map is the sum of a convolutional network's answer, which is the same wherever a thing lies in the image, and
    of an answer to the instruction alone, which says where to look: so few demonstrations suffice to find a thing.

    Args:
        size_px: Edge of the images; a multiple of 8.
        heat_maps: How many.
    """

    def __init__(self, size_px: int, heat_maps: int) -> None:
        super().__init__()
        self._edge = size_px // POINT_PX
        self._shape = (heat_maps, self._edge // 2, self._edge // 2)
        self.what = nn.Sequential(
            nn.Conv2d(3, 16, 8, stride=POINT_PX, padding=2),
            nn.ReLU(),
            nn.Conv2d(16, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(32, heat_maps, 1),
        )
        self.where = nn.Linear(WIDTH, math.prod(self._shape))

    def forward(self, images: Tensor, words: Tensor) -> Tensor:
        """Points in [-1, 1], x and y of each heat map. Shapes (B, 3, S, S) and (B, 64) to (B, 2 heat_maps)."""
        coarse = self.where(words).unflatten(1, self._shape)
        edge = self._edge
        where = nn.functional.interpolate(coarse, size=(edge, edge), mode="bilinear", align_corners=False)
        what = self.what(images - _MEAN_BRIGHTNESS)
        share = (_SHARPNESS * (what + where)).flatten(2).softmax(-1)  # [B, heat_maps, edge * edge]
        places = torch.linspace(-1.0, 1.0, edge)
        x, y = torch.meshgrid(places, places, indexing="xy")
        return (share @ torch.stack([x.ravel(), y.ravel()], dim=1)).flatten(1)


class ChunkPolicy(nn.Module):
    """A convolutional network a camera, and a multilayer perceptron over everything.

    With heat maps the points of all images say where the hand will grip, and the perceptron is told this place alone.

    Args:
        layout: Sizes of inputs and outputs.
        size_px: Edge of the images; a multiple of 8.
    """

    def __init__(self, layout: PolicyLayout, size_px: int = 64) -> None:
        super().__init__()
        self.layout = layout
        points = layout.heat_maps
        self.encoders = nn.ModuleDict(
            {
                camera: PointEncoder(size_px, points) if points else ImageEncoder(size_px, layout.features)
                for camera in layout.cameras
            }
        )
        looked = (2 * points or layout.features) * len(layout.cameras)
        self.place: nn.Sequential | None = None
        if points and layout.cameras:
            self.place = nn.Sequential(nn.Linear(looked + WIDTH, 64), nn.ReLU(), nn.Linear(64, 3))
            looked = 3
        wide = layout.numbers + WIDTH + looked
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
        return self.act(self.look(images, words), numbers, words)

    def look(self, images: Mapping[str, Tensor], words: Tensor, moved: Tensor | None = None) -> Tensor:
        """All that the images say: the features of each camera, (B, P); with heat maps the place of the grip, (B, 3).

        The place is standardised. ``moved`` (2,) says how far the images were moved to the right and down: points are
        moved back.
        """
        seen = []
        for camera in self.layout.cameras:
            if self.place is None:
                seen.append(self.encoders[camera](images[camera]))
            else:
                points = self.encoders[camera](images[camera], words)
                seen.append(points if moved is None else points - moved.repeat(self.layout.heat_maps))
        if self.place is None:
            return torch.cat(seen, dim=1) if seen else words[:, :0]
        return self.place(torch.cat([*seen, words], dim=1))

    def act(self, looked: Tensor, numbers: Tensor, words: Tensor) -> Tensor:
        """The next commands, as :meth:`forward`, from all that :meth:`look` gave."""
        flat = self.body(torch.cat([numbers, words, looked], dim=1))  # [B, chunk * commands]
        return flat.unflatten(1, (self.layout.chunk, self.layout.commands))


def new_network(layout: PolicyLayout, size_px: int, generator: torch.Generator) -> ChunkPolicy:
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
