"""Encoders that other packages offer, used like those of this suite.

Latents are brought to mean 0 and standard deviation 1, as world models expect them; codes stay as they are. The
evaluation-only probe is trained on first use, and both are kept in an ordinary encoder's file, which names the offer.
"""

from __future__ import annotations

import importlib
import math
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import FrameEncoder, TaskSpec, appearance_of_tests
from imagine_bench.seeding import SeedTree

from .encoder import PROBE_HIDDEN, Encoder, EncoderCard, empty_probe
from .network import EncoderNetwork
from .perception import prepare_torch
from .probe import Latents, Probe, accuracy, train_probe
from .recipes import Recipe
from .training import classes_of, draw_frames

_CERTAIN = -20.0  # log variance of a latent that is known
_FRAMES = 4000
_PROBE_STEPS = 2000
_GRAY = 0.5  # of a picture that nobody can draw


class OfferedNetwork(EncoderNetwork):
    """A :class:`.interfaces.FrameEncoder` as a network; its images are frames, (N, 64, 64, 3) uint8.

    Args:
        offer: ``"module:attr"`` of a function without arguments that makes it.
        latent_size: Latents Z.
    """

    centre: Tensor
    scale: Tensor

    def __init__(self, offer: str, latent_size: int) -> None:
        super().__init__()
        module, _, attribute = offer.partition(":")
        self.offered: FrameEncoder = getattr(importlib.import_module(module), attribute)()
        self.offer = offer
        self.latent_size = latent_size
        self.register_buffer("centre", torch.zeros(latent_size))
        self.register_buffer("scale", torch.ones(latent_size))

    def target(self, images: Tensor) -> Tensor:
        """Frames in [0, 1]."""
        return images.float() / 255.0

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised latents, as good as certain. Raises InvalidValueError: what is offered gives none."""
        found = np.asarray(self.offered.encode(images.cpu().numpy()), dtype=np.float32)
        if found.shape != (len(images), self.latent_size) or not np.isfinite(found).all():
            raise InvalidValueError(
                f"The encoder {self.offer} gave latents of shape {found.shape} for {len(images)} frames; it must give "
                f"finite numbers of shape ({len(images)}, {self.latent_size})."
            )
        mu = (torch.from_numpy(found).to(self.centre.device) - self.centre) / self.scale
        return mu, torch.full_like(mu, _CERTAIN)

    def mean(self, latents: Tensor) -> Tensor:
        """The picture of latents (N, Z). Shape (N, 64, 64, 3)."""
        return self.decode(latents, *_gray(1).shape[1:3])

    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """The offered decoder's pictures of latents (N, Z), in [0, 1], or gray ones where there is none."""
        draw = getattr(self.offered, "decode", None)
        raw = (latents * self.scale + self.centre).cpu().numpy()
        return torch.from_numpy(_gray(len(raw)) if draw is None else np.asarray(draw(raw), dtype=np.float32))

    def information(self, mu: Tensor, log_variance: Tensor) -> Tensor:
        """Not known: NaN. Shape (N,)."""
        return torch.full((len(mu),), torch.nan)


class OfferedEncoder(Encoder):
    """An encoder whose network sees frames as they are."""

    def __init__(self, network: EncoderNetwork, probe: Probe, card: EncoderCard, device: str = "cpu") -> None:
        super().__init__(network, probe, card, device)
        self._preprocess = np.asarray

    @torch.no_grad()
    def decode(self, latents: Tensor) -> NDArray[np.float32]:
        """As of every encoder; gray where the offer has no decoder. Shape (N, 64, 64, 3) or (N, 64, 64)."""
        return self.network.decode(latents.to(self.device), 0, 0).numpy()


def fit_offered(spec: TaskSpec, *, name: str, offer: str, appearance: str, path: Path) -> None:
    """Measure the scale of what is offered, train the probe and write the artefact.

    Raises:
        InvalidValueError: What is offered gives no latents.
        ArtefactError: The file exists.
    """
    begun_s = time.process_time()
    prepare_torch("cpu")
    recipe = Recipe(
        name=name,
        architecture="offered",
        frames=_FRAMES,
        held_out_frames=_FRAMES // 4,
        probe_steps=_PROBE_STEPS,
    )
    seeds = SeedTree(0).child("encoder_training", spec.id, appearance)
    rng = seeds.generator()
    generator = torch.Generator().manual_seed(seeds.child("torch").integer())
    frames, macrostates = draw_frames(spec, appearance, recipe.frames, rng)
    unseen, theirs = draw_frames(spec, appearance_of_tests(appearance), recipe.held_out_frames, rng)
    offered = OfferedNetwork(offer, 0).offered
    sizes = tuple(map(int, getattr(offered, "code_sizes", ())))
    network = OfferedNetwork(offer, np.asarray(offered.encode(frames[:1])).shape[-1])
    cardinalities = classes_of(spec)
    probe = empty_probe(network.latent_size, cardinalities, PROBE_HIDDEN).to_empty(device="cpu")
    card = EncoderCard(
        task=spec.id,
        appearance=appearance,
        recipe=recipe,
        preprocessing=spec.preprocessing,
        latent_size=network.latent_size,
        macrostate_names=spec.macrostate_names,
        cardinalities=cardinalities,
        seed=0,
        command=f"imagine-bench bench --task {spec.id} --appearance {appearance} --encoder {name}",
        data=f"{recipe.frames} frames for scale and probe; what {offer} was trained on is its own",
        versions={},
        cpu_s={},
        kl_nats=math.nan,
        reconstruction=math.nan,
        probe={},
        code_sizes=sizes,
        offer=offer,
    )
    encoder = OfferedEncoder(network, probe, card)
    if not sizes:
        mu = encoder.encode(frames)[0]
        network.centre.copy_(mu.mean(dim=0).half())
        network.scale.copy_(mu.std(dim=0).half().clamp_min(1e-3))
    probe.requires_grad_(True)
    train_probe(probe, Latents(*encoder.encode(frames)), macrostates, steps=recipe.probe_steps, generator=generator)
    right = accuracy(probe, encoder.encode(unseen)[0], theirs)
    card.probe.update({"mlp": right, "mlp_sampled": right, "linear": math.nan})
    card.cpu_s["total"] = round(time.process_time() - begun_s, 1)
    encoder.save(path)


def _gray(count: int) -> NDArray[np.float32]:
    return np.full((count, 64, 64), _GRAY, dtype=np.float32)
