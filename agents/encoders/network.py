"""What an encoder's network offers, whether its latents are continuous or the values of discrete parts."""

from __future__ import annotations

import abc

from torch import Tensor, nn


class Coder(nn.Module, abc.ABC):
    """Pictures to latents and back. Shapes: ``N`` pictures, ``C`` channels, ``H x W`` pixels, ``Z`` latents.

    Attributes:
        latent_size: Latents Z of a whole picture.
    """

    latent_size: int

    @abc.abstractmethod
    def target(self, pictures: Tensor) -> Tensor:
        """What :meth:`mean` should give back for ``pictures`` (N, C, H, W), in the network's own units."""

    @abc.abstractmethod
    def posterior(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of the latents of ``pictures`` (N, C, H, W). Two tensors of shape (N, Z)."""

    @abc.abstractmethod
    def mean(self, latents: Tensor) -> Tensor:
        """The expected picture given ``latents`` (N, Z), in the units of :meth:`target`."""

    @abc.abstractmethod
    def picture(self, latents: Tensor, height: int, width: int) -> Tensor:
        """The picture of ``latents`` (N, Z) as a person would see it. Shape (N, C, height, width), in [0, 1]."""

    @abc.abstractmethod
    def information(self, mu: Tensor, log_variance: Tensor) -> Tensor:
        """KL of posteriors from the prior, in nats. Shape (N,)."""
