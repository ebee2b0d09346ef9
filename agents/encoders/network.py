"""The interface of every encoder's network, whether its latents are continuous or codes, or another package's."""

from __future__ import annotations

import abc
import importlib

import numpy as np
import torch
from torch import Tensor, nn

from imagine_bench.arrays import Floats32
from imagine_bench.interfaces import Frame, FrameEncoder
from imagine_bench.preprocessing import preprocess

CERTAIN = -20.0
"""Log variance of a latent that is known."""
_GRAY = 0.5  # of an image that nobody can draw


class EncoderNetwork(nn.Module, abc.ABC):
    """Images to latents and back. Shapes: ``N`` images, ``C`` channels, ``H x W`` pixels, ``Z`` latents of one."""

    latent_size: int
    code_sizes: tuple[int, ...] = ()  #: numbers of values of each factor, where latents are codes

    def target(self, images: Tensor) -> Tensor:
        """The target that :meth:`mean` should give back for ``images`` (N, C, H, W), in the network's own units."""
        return images

    def mean(self, latents: Tensor) -> Tensor:
        """The expected image given ``latents`` (N, Z), in the units of :meth:`target`; NaN where it is not known."""
        return torch.tensor(torch.nan)

    def information(self, mu: Tensor, log_variance: Tensor) -> Tensor:
        """KL of posteriors from the prior, in nats, mean a frame; NaN where it is not known. Shape ()."""
        return torch.tensor(torch.nan)

    @abc.abstractmethod
    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of the latents of ``images`` (N, C, H, W). Two tensors of shape (N, Z)."""

    @abc.abstractmethod
    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """The image of ``latents`` (N, Z) as a person would see it. Shape (N, C, height, width), in [0, 1]."""


class OfferedNetwork(EncoderNetwork):
    """A :class:`.interfaces.FrameEncoder` of another package as a network; its images are whole frames in [0, 1].

    Latents are brought to mean 0 and standard deviation 1, as world models expect them; codes stay as they are.

    Args:
        offer: ``"module:attr"`` of a function without arguments that makes it.
    """

    centre: Tensor
    scale: Tensor

    def __init__(self, offer: str) -> None:
        super().__init__()
        module, _, attribute = offer.partition(":")
        self.offered: FrameEncoder = getattr(importlib.import_module(module), attribute)()
        self.code_sizes = tuple(map(int, getattr(self.offered, "code_sizes", ())))
        blank = np.zeros((1, 64, 64, 3), dtype=np.uint8)
        self.latent_size = np.asarray(self.offered.encode(blank)).shape[-1]
        self.register_buffer("centre", torch.zeros(self.latent_size))
        self.register_buffer("scale", torch.ones(self.latent_size))

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised latents of frames (N, 64, 64, 3), as good as certain."""
        frames = (images * 255.0).round().byte().cpu().numpy()
        found = torch.from_numpy(np.asarray(self.offered.encode(frames), dtype=np.float32))
        mu = (found.to(self.centre.device) - self.centre) / self.scale
        return mu, torch.full_like(mu, CERTAIN)

    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """The offered decoder's images of latents (N, Z), in [0, 1], or gray ones (N, H, W) where there is none."""
        draw = getattr(self.offered, "decode", None)
        if draw is None:
            return torch.full((len(latents), height, width), _GRAY)
        raw = latents * self.scale + self.centre
        return torch.from_numpy(np.asarray(draw(raw.cpu().numpy()), dtype=np.float32))


def read_whole(frames: Frame) -> Floats32:
    """Frames in [0, 1], which the encoders of other packages read."""
    return frames.astype(np.float32) / 255.0


def image_shape(preprocessing: str) -> tuple[int, int, int]:
    """(C, H, W) of the output of a preprocessing."""
    _, channels, height, width = preprocess(preprocessing)(np.zeros((1, 64, 64, 3), dtype=np.uint8)).shape
    return channels, height, width
