"""Behaviour cloning with action chunks: training on demonstrations, and acting with temporal ensembling."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from imagine_bench.agents.encoders.perception import prepare_torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.errors import ArtefactError, InvalidValueError, require_integer

from .demonstrations import DemonstrationData
from .instruction import GO_BACK, words_vector
from .network import POINT_PX, ChunkPolicy, PolicyLayout, new_network
from .skills import Command, Observed, images_of, numbers_of

_SMALLEST_DEVIATION = 1e-2
"""Of an input or a command that hardly varies: it is divided by this instead."""
_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Training:
    """Settings of training. Raises InvalidValueError: a number of gradient steps or pixels out of range."""

    updates: int = 6_000  #: gradient steps
    batch: int = 48  #: periods a gradient step
    #: gradient steps before them, by which encoders with heat maps learn where the hand will grip
    encoder_updates: int = 4_000
    encoder_batch: int = 32  #: periods in each of these
    learning_rate: float = 2e-3  #: the largest; it rises during the first 30 % of the steps, and falls to 0
    weight_decay: float = 1e-4
    number_noise: float = 0.05  #: standard deviation added to standardised inputs
    shift_px: int = 4  #: images are moved by up to so many pixels along both axes, and points of heat maps moved back
    brightness: float = 0.1  #: images are made brighter or darker by up to this share

    def __post_init__(self) -> None:
        require_integer("updates", self.updates, 1)
        require_integer("encoder_updates", self.encoder_updates, 1)
        require_integer("shift_px", self.shift_px, 0)


@dataclass(frozen=True, kw_only=True)
class Standardisation:
    """Means and standard deviations of a vector."""

    mean: NDArray[np.float32]
    deviation: NDArray[np.float32]

    @classmethod
    def of(cls, rows: NDArray[np.float32]) -> Standardisation:
        """Of the columns of an array (T, P)."""
        return cls(mean=rows.mean(axis=0), deviation=np.maximum(rows.std(axis=0), _SMALLEST_DEVIATION))

    def standardised(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Rows (..., P) with mean 0 and deviation 1."""
        return ((rows - self.mean) / self.deviation).astype(np.float32)

    def restored(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """The inverse of :meth:`standardised`."""
        return (rows * self.deviation + self.mean).astype(np.float32)


class Clone:
    """A policy that is told in words which macro-action to carry out, and gives a command each control period.

    Each period it predicts the next ``chunk`` commands. It carries out the mean of all predictions for this period,
    weighted by exp(-0.01 age) with the oldest first, as in ACT (Zhao et al. 2023).

    Args:
        network: The network.
        inputs: The scale of the inputs that are no images.
        commands: The scale of commands.
        about: How it was made; kept with it.
    """

    def __init__(
        self, network: ChunkPolicy, inputs: Standardisation, commands: Standardisation, about: Mapping[str, Any]
    ) -> None:
        prepare_torch("cpu")
        self.network = network.eval()
        self._inputs = inputs
        self._commands = commands
        self.about = dict(about)
        self._instruction: str | None = None
        self._words = torch.empty(0)
        self._due: list[NDArray[np.float32]] = []

    @property
    def world(self) -> str:
        """The task of its demonstrations by its name; empty of an old file."""
        return str(self.about.get("world", ""))

    @property
    def observation(self) -> str:
        """The parts that it sees, as an environment takes them."""
        return str(self.about["observation"])

    @property
    def parameters(self) -> int:
        """How many numbers the network has."""
        return sum(each.numel() for each in self.network.parameters())

    def begin(self, instruction: str) -> None:
        """Forget all predictions, and follow this instruction from now on."""
        self._instruction = instruction
        self._words = torch.from_numpy(words_vector(instruction))[None]
        self._due = []

    def act(self, observation: Observed) -> Command:
        """The command for this period. Shape (8,).

        Raises:
            InvalidValueError: A scene with other objects than those of the demonstrations.
        """
        seen = numbers_of(observation)
        if seen.shape != self._inputs.mean.shape:
            raise InvalidValueError(
                f"The clone learned from {len(self._inputs.mean)} numbers beside images, and this scene gives "
                f"{len(seen)}; give one with the objects of its demonstrations"
                f"{f', those of {self.world}' if self.world else ''}."
            )
        with torch.inference_mode():
            images = {camera: _as_input(image[None]) for camera, image in images_of(observation).items()}
            numbers = torch.from_numpy(self._inputs.standardised(seen))[None]
            predicted = self.network(images, numbers, self._words)[0].numpy()
        self._due = [rest[1:] for rest in self._due if len(rest) > 1]
        self._due.append(self._commands.restored(predicted))
        weights = np.exp(-0.01 * np.arange(len(self._due)))
        now = np.stack([rest[0] for rest in self._due])
        return (weights @ now / weights.sum()).astype(np.float32)

    def save(self, path: Path) -> None:
        """Write one file of numbers and plain values."""
        scales = {name: vars(scale) for name, scale in (("inputs", self._inputs), ("commands", self._commands))}
        content = {
            "version": _VERSION,
            "about": self.about,
            "layout": asdict(self.network.layout),
            "weights": self.network.state_dict(),
            "scales": {name: {key: torch.from_numpy(each) for key, each in of.items()} for name, of in scales.items()},
        }
        torch.save(content, path)

    @classmethod
    def load(cls, path: Path) -> Clone:
        """Read a file that :meth:`save` has written.

        Raises:
            ArtefactError: There is none, or it is another file.
        """
        try:
            content = torch.load(path, weights_only=True)
            if content["version"] != _VERSION:
                raise KeyError(content["version"])
        except Exception as error:
            raise ArtefactError(f"{path} is no saved clone ({error}); train one first.") from error
        layout = PolicyLayout(**{**content["layout"], "cameras": tuple(content["layout"]["cameras"])})
        with torch.device("meta"):
            network = ChunkPolicy(layout, content["about"]["size_px"])
        weights = {  # files before 2026-11-30 say eyes
            name.replace("eyes.", "encoders.", 1): weight for name, weight in content["weights"].items()
        }
        network.load_state_dict(weights, assign=True)
        scales = {
            name: Standardisation(**{k: v.numpy() for k, v in of.items()}) for name, of in content["scales"].items()
        }
        return cls(network, scales["inputs"], scales["commands"], content["about"])


def train(
    data: DemonstrationData,
    *,
    seed: int,
    observation: str,
    settings: Training | None = None,
    layout: Mapping[str, int] | None = None,
    told: Callable[[int, float], None] | None = None,
) -> Clone:
    """Clone the expert.

    Args:
        data: Demonstrations.
        seed: Of the weights, the batches and the noise of the inputs.
        observation: The parts that the demonstrations show.
        settings: Of training.
        layout: Fields of :class:`.network.Layout` that differ from their defaults.
        told: Called every 100 gradient steps with their number and the mean loss since.

    Raises:
        InvalidValueError: The demonstrations show other parts.
    """
    if data.observation and {*data.observation.split(",")} != {*observation.split(",")}:
        raise InvalidValueError(f"The demonstrations show {data.observation}, not {observation}; give their own parts.")
    prepare_torch("cpu")
    settings = settings or Training()
    generator = torch.Generator().manual_seed(seed)
    inputs, commands = Standardisation.of(data.numbers), Standardisation.of(data.commands)
    shape = PolicyLayout(
        cameras=tuple(sorted(data.images)),
        numbers=data.numbers.shape[1],
        commands=data.commands.shape[1],
        **dict(layout or {}),
    )
    size_px = next((image.shape[1] for image in data.images.values()), 64)
    network = new_network(shape, size_px, generator)
    began_s = time.process_time()
    _fit(network, data, inputs, commands, settings, generator, told)
    about = {
        "world": data.world,
        "observation": observation,
        "size_px": size_px,
        "demonstrations": data.count,
        "periods": len(data.episode),
        "seed": seed,
        "training": asdict(settings),
        "cpu_s": round(time.process_time() - began_s, 1),
    }
    return Clone(network, inputs, commands, about)


def _fit(
    network: ChunkPolicy,
    data: DemonstrationData,
    inputs: Standardisation,
    commands: Standardisation,
    settings: Training,
    generator: torch.Generator,
    told: Callable[[int, float], None] | None,
) -> None:
    known, which = np.unique(data.instructions, return_inverse=True)
    words = torch.from_numpy(np.stack([words_vector(str(each)) for each in known]))[torch.from_numpy(which)]
    seen = None
    if network.place is not None:
        _fit_encoders(network, data, words, settings, generator, told)
        seen = _looked(network, data, words)
    numbers = torch.from_numpy(inputs.standardised(data.numbers))
    targets = torch.from_numpy(commands.standardised(data.commands))
    chunks = torch.from_numpy(data.chunks(network.layout.chunk))
    learning = network if seen is None else network.body

    def loss() -> Tensor:
        rows = torch.randint(len(numbers), (settings.batch,), generator=generator)
        noise = settings.number_noise * torch.randn(settings.batch, numbers.shape[1], generator=generator)
        if seen is None:
            images, _ = _varied(data.images, rows, settings, generator)
            looked = network.look(images, words[rows])
        else:
            looked = seen[rows]
        return (network.act(looked, numbers[rows] + noise, words[rows]) - targets[chunks[rows]]).abs().mean()

    _optimise(learning, loss, settings.updates, settings, told)


def _fit_encoders(
    network: ChunkPolicy,
    data: DemonstrationData,
    words: Tensor,
    settings: Training,
    generator: torch.Generator,
    told: Callable[[int, float], None] | None,
) -> None:
    """Learn to see where the hand grips: the place that the expert brings it to, in each period before the event."""
    grips = data.grips()
    rows = torch.from_numpy(np.flatnonzero(data.instructions != GO_BACK))
    places = torch.from_numpy(Standardisation.of(data.hand_m[grips[rows]]).standardised(data.hand_m[grips]))

    def loss() -> Tensor:
        some = rows[torch.randint(len(rows), (settings.encoder_batch,), generator=generator)]
        images, moved = _varied(data.images, some, settings, generator)
        return (network.look(images, words[some], moved) - places[some]).abs().mean()

    _optimise(network, loss, settings.encoder_updates, settings, told)


def _optimise(
    learning: torch.nn.Module,
    loss_of: Callable[[], Tensor],
    updates: int,
    settings: Training,
    told: Callable[[int, float], None] | None,
) -> None:
    """Gradient steps on the losses of new batches."""
    optimiser = torch.optim.AdamW(learning.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, settings.learning_rate, updates)
    learning.train()
    losses = []
    for update in range(1, updates + 1):
        loss = loss_of()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if told is not None and update % 100 == 0:
            told(update, float(np.mean(losses)))
            losses = []


def _looked(network: ChunkPolicy, data: DemonstrationData, words: Tensor) -> Tensor:
    """All that a network sees in each period. Shape (T, P)."""
    with torch.no_grad():
        parts = [
            network.look({camera: _as_input(image[rows]) for camera, image in data.images.items()}, words[rows])
            for rows in np.array_split(np.arange(len(words)), max(1, len(words) // 256))
        ]
    return torch.cat(parts)


def _as_input(images: NDArray[np.uint8]) -> Tensor:
    """Images (B, S, S, 3) as (B, 3, S, S) in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2).float() / 255.0


def _varied(
    images: Mapping[str, NDArray[np.uint8]], rows: Tensor, settings: Training, generator: torch.Generator
) -> tuple[dict[str, Tensor], Tensor]:
    """Images of a batch as inputs, moved as a whole and each made brighter or darker, so that fewer suffice.

    Also how far they were moved, to the right and down (2,), where the span of an image's heat map is 2.
    """
    most = settings.shift_px
    across, along = torch.randint(2 * most + 1, (2,), generator=generator).tolist()
    varied = {}
    span_px = 1.0
    for camera, kept in images.items():
        seen = _as_input(kept[rows.numpy()])
        edge = seen.shape[-1]
        span_px = edge - POINT_PX
        padded = torch.nn.functional.pad(seen, [most] * 4, mode="replicate")
        moved = padded[:, :, along : along + edge, across : across + edge]
        light = 1.0 + settings.brightness * (2.0 * torch.rand(len(seen), 1, 1, 1, generator=generator) - 1.0)
        varied[camera] = moved * light
    return varied, torch.tensor([most - across, most - along]) * (2.0 / span_px)
