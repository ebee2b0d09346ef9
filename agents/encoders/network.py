"""The interface of every encoder's network, whether its latents are continuous or one-hot codes of factors."""

from __future__ import annotations

import abc

from torch import Tensor, nn


class EncoderNetwork(nn.Module, abc.ABC):
    """Images to latents and back. Shapes: ``N`` images, ``C`` channels, ``H x W`` pixels, ``Z`` latents of one."""

    latent_size: int

    @abc.abstractmethod
    def target(self, images: Tensor) -> Tensor:
        """What :meth:`mean` should give back for ``images`` (N, C, H, W), in the network's own units."""

    @abc.abstractmethod
    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of the latents of ``images`` (N, C, H, W). Two tensors of shape (N, Z)."""

    @abc.abstractmethod
    def mean(self, latents: Tensor) -> Tensor:
        """The expected image given ``latents`` (N, Z), in the units of :meth:`target`."""

    @abc.abstractmethod
    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """The image of ``latents`` (N, Z) as a person would see it. Shape (N, C, height, width), in [0, 1]."""

    @abc.abstractmethod
    def information(self, mu: Tensor, log_variance: Tensor) -> Tensor:
        """KL of posteriors from the prior, in nats. Shape (N,)."""
