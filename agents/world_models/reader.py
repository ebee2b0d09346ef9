"""The content of an image: macrostates read from images that a model imagined, or that they show nothing of this world.

Trained apart, on frames that no model sees, and on spoiled ones: fog, blends of two frames, noise, blanks. A picture
far from every real frame is none either, whatever the network says.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional

from imagine_bench.arrays import Array, Ints, State
from imagine_bench.interfaces import TaskSpec, appearance_of_tests
from imagine_bench.rules import states_of
from imagine_bench.seeding import SeedTree

from ..encoders.perception import prepare_torch
from ..networks.mlp import initialise

FRAMES = 6_000
HELD_OUT = 2_000
STEPS = 1_200
BATCH = 64
_SIZE = 32
_CHUNK = 512
_REFERENCES = 2_000  # real frames that a picture is compared with
_CONTRAST = 0.2  # standard deviation of usual images
_REFUSED = 0.001  # share of real frames that each check may refuse
NO_PICTURE = -1


class Reader:
    """Reads macrostates; ``sizes`` are the numbers of values of the M coordinates."""

    def __init__(self, sizes: tuple[int, ...]) -> None:
        self.sizes = sizes
        self.limits = torch.tensor([0.0, -1.0])
        """Largest logit of *nothing*, and least likeness to a real frame, of an image that is read."""
        self.references = torch.zeros(0, 1)
        with torch.device("meta"):
            network = nn.Sequential(
                nn.Conv2d(3, 16, 5, stride=2, padding=2), nn.ReLU(), nn.Conv2d(16, 32, 3, stride=2, padding=1),
                nn.ReLU(), nn.Flatten(), nn.Linear(32 * (_SIZE // 4) ** 2, 128), nn.ReLU(),
                nn.Linear(128, sum(sizes) + 1),
            )  # fmt: skip
        self.network = network.to_empty(device="cpu")

    @torch.no_grad()
    def read(self, pictures: Array) -> Ints:
        """Macrostates (N, M) of pictures (N, H, W) or (N, H, W, 3), uint8 or in [0, 1]; -1 where one shows nothing."""
        parts = [self._read(images_of(pictures[at : at + _CHUNK])) for at in range(0, len(pictures), _CHUNK)]
        return np.concatenate(parts) if parts else np.zeros((0, len(self.sizes)), dtype=np.int64)

    def _read(self, images: Tensor) -> Ints:
        *coordinates, nothing = self.network(centred(images)).split([*self.sizes, 1], dim=1)
        read = torch.stack([logits.argmax(dim=1) for logits in coordinates], dim=1)
        read[(nothing[:, 0] > self.limits[0]) | (self.likeness(images) < self.limits[1])] = NO_PICTURE
        return read.numpy()

    def likeness(self, images: Tensor) -> Tensor:
        """Correlation (N,) of the details of each image with the real frame that is most like it."""
        return (details(images) @ self.references.T).amax(dim=1)

    def content(self) -> bytes:
        """All that :func:`load_reader` needs, as safetensors."""
        extra = {"references": self.references, "limits": self.limits}
        return save({**self.network.state_dict(), **extra})


def images_of(pictures: Array) -> Tensor:
    """Pictures as RGB images in [0, 1] of 32 pixels. Shape (N, 3, 32, 32)."""
    scale = 255.0 if pictures.dtype == np.uint8 else 1.0
    images = torch.from_numpy(np.ascontiguousarray(pictures, dtype=np.float32)) / scale
    images = images.unsqueeze(1).expand(-1, 3, -1, -1) if images.ndim == 3 else images.permute(0, 3, 1, 2)
    if images.shape[2:] == (2 * _SIZE, 2 * _SIZE):
        return functional.avg_pool2d(images, 2)
    return functional.interpolate(images, size=(_SIZE, _SIZE), mode="bilinear", antialias=True, align_corners=False)


def centred(images: Tensor) -> Tensor:
    """Images of mean 0, at their own contrast: an object that is hardly there is not to be read."""
    return (images - images.mean(dim=(1, 2, 3), keepdim=True)) / _CONTRAST


def details(images: Tensor) -> Tensor:
    """Unit vectors (N, 1024) of the contrasts in gray images."""
    gray = images.mean(dim=1, keepdim=True)
    sharp = gray - functional.avg_pool2d(gray, 9, stride=1, padding=4, count_include_pad=False)
    return functional.normalize(sharp.flatten(1), dim=1, eps=0.3)


def train_reader(spec: TaskSpec, appearance: str, *, frames: int = FRAMES, steps: int = STEPS) -> Reader:
    """Train a reader for a task's looks, on frames of its own."""
    prepare_torch("cpu")
    seeds = SeedTree(0).child("encoder_probe", "judge", spec.id, appearance)
    rng = seeds.generator()
    generator = torch.Generator().manual_seed(seeds.child("torch").integer())
    reader = Reader(tuple(len(values) for values in spec.macrostate_values))
    initialise(reader.network, generator)
    states = states_of(spec.rules)
    shown = rng.integers(len(states), size=frames)
    macrostates = np.array(states, dtype=np.int64)[shown]
    images = images_of(spec.render_macrostates(macrostates, appearance, rng))
    partners = _Partners(states, shown)
    labels = torch.from_numpy(macrostates)
    optimiser = torch.optim.Adam(reader.network.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=2e-3, total_steps=steps)
    for _ in range(steps):
        rows = torch.from_numpy(rng.integers(frames, size=BATCH))
        good = partners.averaged(images, rows.numpy(), rng)
        bad = spoiled(images[rows], images[partners.of(rows.numpy(), rng)], generator)
        outputs = reader.network(centred(varied(torch.cat([good, bad]), generator)))
        *coordinates, nothing = outputs.split([*reader.sizes, 1], dim=1)
        target = torch.cat([torch.zeros(BATCH), torch.ones(BATCH)])
        loss = functional.binary_cross_entropy_with_logits(nothing[:, 0], target)
        for logits, values in zip(coordinates, labels[rows].T, strict=True):
            loss = loss + functional.cross_entropy(logits[:BATCH], values)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    reader.network.requires_grad_(False)
    reader.references = details(images[:_REFERENCES])
    fresh = np.array(states, dtype=np.int64)[rng.integers(len(states), size=HELD_OUT)]
    real = varied(images_of(spec.render_macrostates(fresh, appearance_of_tests(appearance), rng)), generator)
    logits = reader.network(centred(real))[:, -1].quantile(1.0 - _REFUSED)
    reader.limits = torch.stack([logits.clamp_min(0.0), reader.likeness(real).quantile(_REFUSED)])
    return reader


class _Partners:
    """Frames of other macrostates: often of one that differs in a single coordinate, since such blends are hardest."""

    def __init__(self, states: tuple[State, ...], shown: Ints) -> None:
        self._states = np.array(states)
        self._shown = shown
        order = np.argsort(shown, kind="stable")
        self._rows = np.split(order, np.searchsorted(shown[order], np.arange(1, len(states))))

    def averaged(self, images: Tensor, rows: Ints, rng: np.random.Generator) -> Tensor:
        """Images of rows, every second one the mean of four of its macrostate: decoders know no jitter."""
        alike = np.array([rng.choice(self._rows[self._shown[row]], 3) for row in rows[::2]])  # [B / 2, 3]
        found = images[torch.from_numpy(rows)]
        found[::2] = (found[::2] + images[torch.from_numpy(alike)].sum(dim=1)) / 4.0
        return found

    def of(self, rows: Ints, rng: np.random.Generator) -> Tensor:
        """A partner of each row."""
        return torch.tensor([self._one(int(row), rng) for row in rows])

    def _one(self, row: int, rng: np.random.Generator) -> int:
        near = np.flatnonzero((self._states != self._states[self._shown[row]]).sum(axis=1) == 1)
        if len(near) and rng.random() < 0.7:
            frames = self._rows[int(rng.choice(near))]
            if len(frames):
                return int(rng.choice(frames))
        others = np.flatnonzero(self._shown != self._shown[row])
        return int(rng.choice(others))


def _uniform(images: Tensor, generator: torch.Generator, low: float, high: float, bands: int = 1) -> Tensor:
    """Numbers of an image each, or of each of its vertical bands. Shape (N, 1, 1, bands)."""
    return low + (high - low) * torch.rand((len(images), 1, 1, bands), generator=generator)


def _noise(images: Tensor, generator: torch.Generator) -> Tensor:
    return torch.empty_like(images).normal_(generator=generator)


def varied(images: Tensor, generator: torch.Generator) -> Tensor:
    """Images as an honest decoder may draw them: gray, lighter, flatter, softer, a little noisy, shaded in bands."""
    uniform = partial(_uniform, images, generator)
    gray = images.mean(dim=1, keepdim=True).expand_as(images)
    images = torch.where(uniform(0, 1) < 0.5, gray, images)
    softness = uniform(0, 0.7) * (uniform(0, 1) < 0.5)
    images = torch.lerp(
        images, functional.avg_pool2d(images, 3, stride=1, padding=1, count_include_pad=False), softness
    )
    shade = uniform(-0.12, 0.12, bands=3).repeat_interleave(11, dim=3)[..., :_SIZE]
    images = images + shade * (uniform(0, 1) < 0.5)
    images = 0.5 + uniform(0.6, 1.3) * (images - 0.5) + uniform(-0.15, 0.15)
    noise = _noise(images, generator)
    return (images + uniform(0, 0.03) * noise).clamp(0.0, 1.0)


def spoiled(images: Tensor, others: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures of nothing: blends with others, fog, noise, blanks and mush, of each image one."""
    half = len(images) // 2
    fogged, noisy, blank, mush = images[half:].chunk(4)
    small = functional.avg_pool2d(mush, 4)
    parts = (
        torch.lerp(images[:half], others[:half], _uniform(images[:half], generator, 0.2, 0.8)),
        torch.lerp(fogged, _uniform(fogged, generator, 0, 1).expand_as(fogged), _uniform(fogged, generator, 0.85, 1.0)),
        noisy + _uniform(noisy, generator, 0.3, 0.8) * _noise(noisy, generator),
        _uniform(blank, generator, 0, 1) + _uniform(blank, generator, 0, 0.3) * _noise(blank, generator),
        functional.interpolate(small, size=(_SIZE, _SIZE), mode="bilinear", align_corners=False),
    )
    return torch.cat(parts).clamp(0.0, 1.0)


def load_reader(spec: TaskSpec, path: Path) -> Reader:
    """The reader of a file of :meth:`Reader.content`."""
    reader = Reader(tuple(len(values) for values in spec.macrostate_values))
    tensors = load_file(path)
    reader.references = tensors.pop("references")
    reader.limits = tensors.pop("limits")
    reader.network.load_state_dict(tensors, assign=True)
    reader.network.requires_grad_(False)
    return reader
