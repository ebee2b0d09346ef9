"""Variational autoencoders: images to a Gaussian over latents, and back (thesis 2.1.4 and 5.2.2).

Shapes: ``N`` images, ``C`` channels, ``H x W`` pixels, ``Z`` latents of the whole image. All randomness is
the noise that the caller passes in.
"""

from __future__ import annotations

import abc
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..networks.mlp import relu_layers
from .network import EncoderNetwork, image_shape
from .recipes import Recipe

_LEAST_CONTRAST = 0.005  # of full scale; inputs about as flat as this are amplified less
_SIDE = 64  # pixels; input and output of the Ha & Schmidhuber network


class Elbo(NamedTuple):
    """The terms of a VAE's loss, in nats a image, averaged over a batch. Each of shape ()."""

    loss: Tensor
    reconstruction: Tensor
    kl: Tensor


def kl_from_standard_normal(mu: Tensor, log_variance: Tensor) -> Tensor:
    """KL(N(mu, sigma^2) || N(0, 1)) summed over latents: -1/2 sum(1 + log sigma^2 - mu^2 - sigma^2).

    The thesis prints it with the wrong sign and without 1/2 (equations 2.7, 3.1 and 5.1), an erratum.
    From means and log variances (N, Z) to nats (N,).
    """
    return -0.5 * (1.0 + log_variance - mu.square() - log_variance.exp()).sum(dim=1)  # [N]


class Vae(EncoderNetwork):
    """The base class of both architectures; weights are undefined before they are drawn or loaded."""

    @abc.abstractmethod
    def generate(self, latents: Tensor) -> Tensor:
        """Parameters of the pixels' distribution given ``latents`` (N, Z), as :meth:`log_loss` takes them."""

    def mean(self, latents: Tensor) -> Tensor:
        """The expected image given ``latents`` (N, Z), in the units of :meth:`target`."""
        return self.generate(latents)

    @abc.abstractmethod
    def log_loss(self, generated: Tensor, target: Tensor) -> Tensor:
        """-log p(target | latents) up to a constant, a SUM over pixels. Shape (N,)."""

    def information(self, mu: Tensor, log_variance: Tensor) -> Tensor:
        """KL from the standard normal, mean a frame. Shape ()."""
        return kl_from_standard_normal(mu, log_variance).mean()

    def fit_appearance(self, images: Tensor) -> None:
        """Take the constants that :meth:`decode` cannot know of latents from training images (N, C, H, W): here
        nothing.
        """

    def elbo(self, images: Tensor, noise: Tensor, beta: float) -> Elbo:
        """The beta-VAE loss (Higgins et al. 2017; thesis equation 5.1, corrected) of images (N, C, H, W) in [0, 1].

        ``noise`` (N, Z) is standard normal, for the reparametrisation; ``beta`` weighs the KL term.
        """
        mu, log_variance = self.posterior(images)  # [N, Z]
        latents = mu + (0.5 * log_variance).exp() * noise  # [N, Z]
        reconstruction = self.log_loss(self.generate(latents), self.target(images)).mean()
        kl = self.information(mu, log_variance)
        return Elbo(reconstruction + beta * kl, reconstruction, kl)


def standardise(pixels: Tensor) -> Tensor:
    """Give every row (..., pixels) mean 0 and standard deviation 1, so that light matters less."""
    # One fused operation, since a single frame must be quick.
    return functional.layer_norm(pixels, pixels.shape[-1:], eps=_LEAST_CONTRAST**2)


class MlpVae(Vae):
    """One small network that reads a image whole, or each of its channels on its own.

    Channels that are strips hold one cube each: sharing the weights triples the data and lets no cube crowd out
    another. The latents of group g are ``[g * L, (g + 1) * L)``; ``groups`` is C where every channel is read on its
    own, 1 where all are read together.
    """

    brightness: Tensor
    contrast: Tensor

    def __init__(self, recipe: Recipe, channels: int, height: int, width: int, *, groups: int) -> None:
        super().__init__()
        self._groups = groups
        self.latent_size = groups * recipe.latents
        self._image_shape = (channels, height, width)
        self._precision = recipe.pixel_std**-2
        sizes = (channels // groups * height * width, *recipe.widths)
        self.encoder = relu_layers((*sizes, 2 * recipe.latents))
        self.decoder = relu_layers((recipe.latents, *reversed(sizes)))
        # As a person expects it: the mean brightness and contrast of the training images.
        self.register_buffer("brightness", torch.tensor(0.5))
        self.register_buffer("contrast", torch.tensor(0.2))

    def target(self, images: Tensor) -> Tensor:
        """Images whose groups of channels are standardised."""
        return standardise(images.reshape(len(images) * self._groups, -1)).reshape(images.shape)

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Each group encoded on its own, their latents side by side. Two tensors of shape (N, Z)."""
        groups = self.target(images).reshape(len(images) * self._groups, -1)
        mu, log_variance = self.encoder(groups).chunk(2, dim=1)  # [N * groups, L]
        return mu.reshape(len(images), self.latent_size), log_variance.reshape(len(images), self.latent_size)

    def generate(self, latents: Tensor) -> Tensor:
        """Means of the standardised pixels. Shape (N, C, H, W)."""
        apart = latents.reshape(len(latents) * self._groups, self.latent_size // self._groups)
        return self.decoder(apart).reshape(len(latents), *self._image_shape)

    def log_loss(self, generated: Tensor, target: Tensor) -> Tensor:
        """Gaussian pixels of a fixed standard deviation."""
        return 0.5 * self._precision * (generated - target).square().sum(dim=(1, 2, 3))  # [N]

    def fit_appearance(self, images: Tensor) -> None:
        """Take brightness and contrast for :meth:`decode` from training images (N, C, H, W)."""
        rows = images.reshape(len(images) * self._groups, -1)
        self.brightness.copy_(images.mean())
        self.contrast.copy_(rows.std(dim=1, correction=0).mean())

    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """At the mean brightness and contrast of the training images: latents do not hold the light."""
        return (self.brightness + self.contrast * self.generate(latents)).clamp(0.0, 1.0)


class HaSchmidhuberVae(Vae):
    """The convolutional VAE of Ha & Schmidhuber 2018 (World Models, A.1), one joint latent (thesis 5.2.2).

    Strips are resampled to 64 x 64 and enter as channels.
    """

    def __init__(self, recipe: Recipe, channels: int) -> None:
        super().__init__()
        self.latent_size = recipe.latents
        down: list[nn.Module] = []
        up: list[nn.Module] = []
        with torch.device("meta"):  # torch would draw weights from its global generator
            for before, after in pairwise((channels, 32, 64, 128, 256)):
                down += [nn.Conv2d(before, after, kernel_size=4, stride=2), nn.ReLU()]
            down += [nn.Flatten(), nn.Linear(1024, 2 * recipe.latents)]
            up += [nn.Linear(recipe.latents, 1024), nn.Unflatten(1, (1024, 1, 1))]
            for (before, after), size in zip(pairwise((1024, 128, 64, 32, channels)), (5, 5, 6, 6), strict=True):
                up += [nn.ConvTranspose2d(before, after, kernel_size=size, stride=2), nn.ReLU()]
        self.encoder = nn.Sequential(*down).to_empty(device="cpu")
        self.decoder = nn.Sequential(*up[:-1]).to_empty(device="cpu")

    def target(self, images: Tensor) -> Tensor:
        """Images resampled to 64 x 64."""
        return _resize(images, _SIDE, _SIDE)

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """All channels encoded jointly. Two tensors of shape (N, Z)."""
        mu, log_variance = self.encoder(self.target(images)).chunk(2, dim=1)
        return mu, log_variance

    def generate(self, latents: Tensor) -> Tensor:
        """Logits of the pixels; the sigmoid of the output layer is in the loss and in :meth:`mean`."""
        return self.decoder(latents)

    def mean(self, latents: Tensor) -> Tensor:
        """Probabilities of the pixels. Shape (N, C, 64, 64)."""
        return self.generate(latents).sigmoid()

    def log_loss(self, generated: Tensor, target: Tensor) -> Tensor:
        """Bernoulli pixels: cross-entropy (thesis 2.1.4)."""
        return functional.binary_cross_entropy_with_logits(generated, target, reduction="none").sum(dim=(1, 2, 3))

    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """Resampled to the size of the strips."""
        return _resize(self.mean(latents), height, width)


def build_vae(recipe: Recipe, preprocessing: str) -> Vae:
    """The VAE of a recipe for preprocessed frames, its weights undefined."""
    channels, height, width = image_shape(preprocessing)
    if recipe.architecture == "ha_schmidhuber":
        return HaSchmidhuberVae(recipe, channels)
    return MlpVae(recipe, channels, height, width, groups=channels if recipe.architecture == "strips" else 1)


def _resize(images: Tensor, height: int, width: int) -> Tensor:
    if images.shape[2:] == (height, width):
        return images
    return functional.interpolate(images, size=(height, width), mode="bilinear", align_corners=False)
