"""The encoder as an artefact: one file with network, evaluation-only probe and card; frames to latents and back."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from imagine_bench.arrays import Floats32, Frame, Ints, content_hash
from imagine_bench.errors import ArtefactError, InvalidValueError, brief, why, writing
from imagine_bench.preprocessing import join_cells, preprocess

from .discrete_encoder import DiscreteEncoder
from .network import EncoderNetwork, OfferedNetwork, image_shape, read_whole
from .probe import Probe
from .recipes import Recipe
from .vae import build_vae

FORMAT = "imagine_bench.encoder/1"
_CHUNK = 512  # frames encoded at once, to bound memory


@dataclass(frozen=True, kw_only=True)
class EncoderCard:
    """The origin and the abilities of an encoder."""

    task: str
    appearance: str
    recipe: Recipe
    preprocessing: str  #: name in :mod:`imagine_bench.preprocessing`
    latent_size: int  #: latents Z
    macrostate_names: tuple[str, ...]  #: the coordinates its probe reads. Length M.
    cardinalities: tuple[int, ...]  #: values of each. Length M.
    seed: int
    command: str  #: makes it again
    data: str  #: the frames, in words
    versions: dict[str, str]
    cpu_s: dict[str, float]  #: CPU seconds spent in ``total``
    kl_nats: float  #: KL from the prior on held-out frames, mean a frame
    reconstruction: float  #: squared error of the decoded held-out frames, mean a pixel, in the network's own units
    #: Fraction of held-out frames whose whole macrostate is read right from the mean latents by a ``linear`` reader and
    #: by the stored ``mlp``, and from sampled latents by it (``mlp_sampled``).
    probe: dict[str, float]
    #: Where latents are one-hot codes of factors: the number of values of each factor; else empty.
    code_sizes: tuple[int, ...] = ()
    offer: str = ""  #: ``"module:attr"`` of another package's offer, in place of a network of this suite

    def to_json(self) -> str:
        """The card as indented JSON."""
        return json.dumps({"format": FORMAT, **asdict(self)}, indent=2)

    @classmethod
    def from_json(cls, text: str) -> EncoderCard:
        """Undo :meth:`to_json`; an error of any kind where it is not an encoder's card of this format."""
        values = json.loads(text)
        if values.pop("format") != FORMAT:
            raise InvalidValueError(f"its format is not {FORMAT}")
        values.pop("content", None)
        recipe = values.pop("recipe")
        recipe = Recipe(**{**recipe, "widths": tuple(recipe["widths"])})
        lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
        return cls(recipe=recipe, **{**values, **lists})


class Encoder:
    """Frames to latents and back, with no gradient and no randomness, and an evaluation-only reader (``probe``)."""

    def __init__(self, network: EncoderNetwork, probe: Probe, card: EncoderCard, device: str = "cpu") -> None:
        self.card = card
        self.latent_size = card.latent_size
        self.device = torch.device(device)
        self.network = network.to(self.device).requires_grad_(False).eval()
        self.probe = probe.to(self.device).requires_grad_(False).eval()
        self._preprocess = read_whole if card.offer else preprocess(card.preprocessing)

    @torch.no_grad()
    def encode(self, frames: Frame) -> tuple[Tensor, Tensor]:
        """Posterior means and standard deviations (N, Z), float32 on the encoder's device, of frames.

        Args:
            frames: Shape (N, 64, 64, 3), uint8.

        Raises:
            InvalidValueError: Frames of another shape or type.
        """
        if frames.dtype != np.uint8 or frames.shape[1:] != (64, 64, 3):
            got = f"frames of type {frames.dtype} and shape {frames.shape}"
            raise InvalidValueError(f"The encoder got {got}; give uint8 of shape (N, 64, 64, 3).")
        empty = torch.empty((0, self.latent_size), device=self.device)
        chunks = [(empty, empty)]
        for start in range(0, len(frames), _CHUNK):
            images = torch.from_numpy(self._preprocess(frames[start : start + _CHUNK])).to(self.device)
            mu, log_variance = self.network.posterior(images)
            chunks.append((mu, (0.5 * log_variance).exp()))
        means, deviations = zip(*chunks, strict=True)
        return torch.cat(means), torch.cat(deviations)

    def latents(self, frame: Frame) -> Floats32:
        """Posterior means (Z,) of one frame (64, 64, 3)."""
        return self.encode(frame[None])[0][0].cpu().numpy()

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Floats32:
        """One image of the whole view for every row of ``latents`` (N, Z), as :func:`view` shapes it, in [0, 1].

        Those of another package's encoder are as it draws them, as far as values are in range, or gray (N, 64, 64).
        """
        latents = latents.to(self.device)
        if self.card.offer:
            return self.network.decode(latents, 64, 64).clamp(0.0, 1.0).numpy()
        _, height, width = image_shape(self.card.preprocessing)
        return view(self.network.decode(latents, height, width).cpu().numpy(), self.card.preprocessing)

    @torch.no_grad()
    def round_trip(self, latents: Tensor) -> Tensor:
        """Latents (N, Z), decoded to images and encoded again. Shape (N, Z)."""
        _, height, width = image_shape(self.card.preprocessing)
        return self.network.posterior(self.network.decode(latents.to(self.device), height, width))[0]

    def read_macrostate(self, latents: Tensor) -> Ints:
        """The evaluation-only probe's reading of ``latents`` (N, Z); agents must not use it. Shape (N, M)."""
        return self.probe.read(latents.to(self.device))

    def save(self, path: Path, picture: bytes = b"") -> None:
        """Write the artefact (``.safetensors``, float16) and its card beside it (``.json``), the artefact last.

        A part that a killed process left is written anew; a whole artefact never.

        Raises:
            ArtefactError: Either file exists already; it is left untouched.
            SetupError: It cannot be written.
        """
        refuse_existing(path)
        tensors = {
            f"{name}.{key}": value.half().contiguous().cpu()
            for name, module in (("vae", self.network), ("probe", self.probe))
            for key, value in module.state_dict().items()
        }
        told = {**json.loads(self.card.to_json()), "content": _content(self.card, tensors)}
        card = json.dumps(told, indent=2)
        contents = {".json": f"{card}\n".encode(), ".png": picture, path.suffix: save(tensors, metadata={"card": card})}
        begun = _begun(path)
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            begun.touch()
            for suffix, content in contents.items():
                if content:
                    write_whole(path.with_suffix(suffix), content)
            begun.unlink()

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> Encoder:
        """Read an artefact; the file is only ever read.

        Raises:
            ArtefactError: It is missing, damaged or not an encoder; the message names the file.
        """
        if not path.is_file():
            raise ArtefactError(f"No encoder at {path}; make one with `imagine-bench encoder`.")
        try:
            with safe_open(path, framework="pt") as file:
                text = (file.metadata() or {}).get("card", "")
                card = EncoderCard.from_json(text)
                stored = {key: file.get_tensor(key) for key in file.keys()}
            content = json.loads(text).get("content")
            if content not in (None, _content(card, stored)):  # None: written before 2026-11-28
                raise InvalidValueError("it is not as it was written")
            tensors = {key: tensor.float() for key, tensor in stored.items()}
            network = _empty_network(card)
            probe = Probe(card.latent_size, card.cardinalities)
            _fill(network, tensors, "vae.")
            _fill(probe, tensors, "probe.")
            return cls(network, probe, card, device)
        except Exception as error:  # a file that is no encoder can be wrong in any way
            remedy = "choose another or retrain it"
            raise ArtefactError(f"{path} is not a usable encoder ({why(error)}); {remedy}.") from error


def bundled_encoder(name: str) -> Path:
    """Where the encoder that comes with the package under ``name`` (``"arrow_puzzle-mild"``) is, if it is there."""
    return Path(str(resources.files("imagine_bench.assets"))) / "encoders" / f"{name}.safetensors"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is whole or as before, whenever the process is killed.

    Raises:
        SetupError: It cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    with writing(path):
        with partial.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)


def refuse_existing(path: Path) -> None:
    """Raise ArtefactError where an artefact, its card or its picture exists, unless a killed :meth:`save` left them."""
    beside = () if _begun(path).exists() else (path.with_suffix(".json"), path.with_suffix(".png"))
    for each in (path, *beside):
        if each.exists():
            raise ArtefactError(f"{each} exists already and is never overwritten; choose another folder or remove it.")


def _content(card: EncoderCard, tensors: Mapping[str, Tensor]) -> str:
    """The hash of a card and of the tensors it is written with."""
    text = np.frombuffer(card.to_json().encode(), np.uint8)
    return content_hash({"card": text, **{name: tensor.numpy() for name, tensor in tensors.items()}})


def _begun(path: Path) -> Path:
    """Lies beside an artefact from the beginning of its saving to the end."""
    return path.with_name(f".{path.name}.begun")


def view(images: Floats32, preprocessing: str) -> Floats32:
    """One image of the whole view from preprocessed images: (N, C, H, W) to gray (N, H', W') or RGB (N, H, W, 3)."""
    if preprocessing.startswith("gray"):
        return join_cells(images)
    return np.ascontiguousarray(np.moveaxis(images, 1, -1), dtype=np.float32)


def _empty_network(card: EncoderCard) -> EncoderNetwork:
    if card.offer:
        return OfferedNetwork(card.offer)
    if card.recipe.kind == "latents":
        return build_vae(card.recipe, card.preprocessing)
    return DiscreteEncoder(card.code_sizes, *image_shape(card.preprocessing))


def _fill(network: nn.Module, tensors: dict[str, Tensor], prefix: str) -> None:
    """Give an empty network its weights; InvalidValueError where names, shapes or numbers do not fit."""
    weights = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    wanted = network.state_dict()
    lacking = sorted(wanted.keys() - weights.keys())
    unknown = sorted(weights.keys() - wanted.keys())
    if lacking or unknown:
        raise InvalidValueError(f"of the tensors {prefix}* it lacks {brief(lacking)} and has {brief(unknown)} instead")
    for name, value in weights.items():
        if value.shape != wanted[name].shape:
            shapes = f"{tuple(value.shape)}, not {tuple(wanted[name].shape)}"
            raise InvalidValueError(f"tensor {prefix}{name} has shape {shapes}")
        if not value.isfinite().all():
            raise InvalidValueError(f"tensor {prefix}{name} is not finite")
    network.load_state_dict(weights, strict=True, assign=True)
