"""Factors of a scene and the values each can take, discovered in unlabelled images; no label, no action, no reward.

A *factor* is a set of pixels that depend on one another and hardly on any other: an object that is independent of the
rest of the scene, wherever it may be. Its *values* are the separate clouds that its pixels form over many images: an
object seen from a few sides, under any jitter of pose and light, is one cloud a side. An image becomes one value a
factor, a product code. Nothing else is given: not how many factors there are, nor where, nor how many values each has.

Sources: factored latent causes by independence (Bengio et al. 2013, "Representation learning", 3.5); clouds as
connected components of a mutual nearest-neighbour graph (Brito et al. 1997; the density view of DBSCAN, Ester et al.
1996); categorical latents for world models (DreamerV2, Hafner et al. 2021).
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy  # its parts load, slowly, when first used: an agent that only sees with an encoder needs none
import torch
from torch import Tensor
from torch.nn import functional

from imagine_bench.arrays import Bools, Floats, Ints
from imagine_bench.errors import InvalidValueError

from .network import CERTAIN, EncoderNetwork

POOL = 2
"""Pixels a side that are averaged: factors are larger, and jitter matters less."""
FEATURES = 16
"""Principal components of a factor's pixels in which values are told apart."""
EXEMPLARS = 600
"""Drawn, with replacement, of the images of a factor and kept; a new image takes the value of the nearest one."""
_STILL = 0.02  # standard deviation, of the image's median brightness, below which a pixel shows nothing
_INDEPENDENT = 0.8  # mean distance (1 - dependence) at which two groups of pixels are two factors
_LEAST_VARIANCE = 0.02  # share of the image's variance that makes a factor
_LEAST_SHARE = 0.02  # share of the images that makes a value
_NEIGHBOURS = 16
_LONELY = 0.05  # share of the images in the sparsest surroundings, which link nothing: they may lie between clouds
_LEAST_GAP = 0.13  # of the root mean square of a factor's gaps; clouds with a narrower one between them are merged
_IMAGES = 2000  # a channel, of three or more; more find no other factors
_DEPENDENCE_IMAGES = 3000
_DARK = 0.01  # of full scale; the median brightness is not taken for less


class DiscreteEncoder(EncoderNetwork):
    """One-hot codes of P factors, concatenated in order; ``code_sizes`` are the numbers of their values."""

    background: Tensor
    appearance: Tensor
    basis: Tensor
    centre: Tensor
    exemplars: Tensor
    values: Tensor

    def __init__(self, code_sizes: tuple[int, ...], channels: int, height: int, width: int) -> None:
        super().__init__()
        self.code_sizes = tuple(code_sizes)
        self.latent_size = sum(code_sizes)
        factors = len(code_sizes)
        pixels = channels * -(-height // POOL) * -(-width // POOL)
        shapes = {
            "background": (channels, height, width),
            "appearance": (self.latent_size, channels, height, width),
            "basis": (factors, FEATURES, pixels),
            "centre": (factors, FEATURES),
            "exemplars": (factors, EXEMPLARS, FEATURES),
            "values": (factors, EXEMPLARS),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape))

    def codes(self, images: Tensor) -> Tensor:
        """The value of each factor of ``images`` (N, C, H, W). Shape (N, P), int64."""
        features = torch.einsum("nx,pfx->pnf", smoothed(images), self.basis) - self.centre[:, None]
        nearest = torch.cdist(features, self.exemplars).argmin(dim=2)  # [P, N]
        return self.values.gather(1, nearest).T.long()

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """One-hot codes, as good as certain."""
        codes = self.codes(images)
        hot = [functional.one_hot(codes[:, factor], size) for factor, size in enumerate(self.code_sizes)]
        mu = torch.cat(hot, dim=1).to(self.background.dtype)
        return mu, torch.full_like(mu, CERTAIN)

    def mean(self, latents: Tensor) -> Tensor:
        """The mean appearance of every factor's value, before the background."""
        return self.background + torch.einsum("nz,zchw->nchw", latents, self.appearance)

    def decode(self, latents: Tensor, height: int, width: int) -> Tensor:
        """The same, within [0, 1]."""
        return self.mean(latents).clamp(0.0, 1.0)

    def information(self, mu: Tensor, log_variance: Tensor) -> Tensor:
        """That of certain codes from uniform ones: sum of log of the number of values."""
        return torch.tensor(self.code_sizes).log().sum()


def smoothed(images: Tensor) -> Tensor:
    """Images relative to their median brightness, pooled and slightly blurred. (N, C, H, W) to (N, pixels)."""
    level = images.flatten(1).median(dim=1).values.clamp_min(_DARK)[:, None, None, None]
    pooled = functional.avg_pool2d(images / level, POOL, ceil_mode=True)
    kernel = torch.tensor([1.0, 2.0, 1.0], device=images.device) / 4.0
    channels = pooled.shape[1]
    blur = torch.outer(kernel, kernel).expand(channels, 1, 3, 3)
    padded = functional.pad(pooled, (1, 1, 1, 1), mode="replicate")
    return functional.conv2d(padded, blur, groups=channels).flatten(1)


def discover(images: Tensor, generator: torch.Generator) -> DiscreteEncoder:
    """Find the factors of unlabelled images (N, C, H, W) in [0, 1] and their values.

    ``generator`` draws the images that are looked at, 6000 or 2000 a channel, where there are more, and the exemplars.

    Raises:
        InvalidValueError: Nothing in the images ever changes, or no factor has more than one value.
    """
    chosen = images[torch.randperm(len(images), generator=generator)[: _IMAGES * max(images.shape[1], 3)]]
    pixels = torch.cat([smoothed(chunk) for chunk in chosen.split(500)]).double().numpy()  # [N, X]
    found = []
    for group in pixel_groups(pixels):
        basis = _directions(pixels, group)
        centre = basis @ pixels.mean(axis=0)
        features = pixels @ basis.T - centre
        value = clouds(features)
        if value.max() > 0:
            found.append((group, basis, centre, features, value))
    if not found:
        raise InvalidValueError("No factor with two values or more was found; the images hardly differ.")
    network = DiscreteEncoder(tuple(int(value.max()) + 1 for *_, value in found), *images.shape[1:])
    for index, (_, basis, centre, features, value) in enumerate(found):
        rows = _balanced(value, generator)
        network.basis[index] = torch.from_numpy(basis)
        network.centre[index] = torch.from_numpy(centre)
        network.exemplars[index] = torch.from_numpy(features[rows])
        network.values[index] = torch.from_numpy(value[rows].astype(np.float64))
    _fit_appearance(network, chosen, [group for group, *_ in found])
    return network


def pixel_groups(pixels: Floats) -> list[Bools]:
    """Groups of pixels (N, X) that depend on one another, by average linkage, but for those that hardly vary.

    Masks of shape (X,), the most varied first.
    """
    pixels = pixels[:_DEPENDENCE_IMAGES]
    spread = pixels.std(axis=0)
    moving = np.flatnonzero(spread > _STILL)
    if len(moving) < 2:
        return []
    condensed = scipy.spatial.distance.squareform(1.0 - dependence(pixels[:, moving]), checks=False)
    tree = scipy.cluster.hierarchy.linkage(condensed, "average")
    label = scipy.cluster.hierarchy.fcluster(tree, _INDEPENDENT, "distance")
    variance = np.bincount(label, spread[moving] ** 2)
    order = np.argsort(-variance, kind="stable")
    kept = order[variance[order] > _LEAST_VARIANCE * variance.sum()]
    return [np.isin(np.arange(pixels.shape[1]), moving[label == index]) for index in kept]


def dependence(pixels: Floats) -> Floats:
    """How much columns (N, X) depend on one another: the largest absolute correlation among each and its square.

    The squares catch pixels that are uncorrelated but not independent. Shape (X, X), in [0, 1], ones on the diagonal.
    """
    linear = (pixels - pixels.mean(axis=0)) / pixels.std(axis=0)
    square = linear**2 - 1.0
    square /= np.maximum(square.std(axis=0), 1e-6)
    both = np.concatenate([linear, square], axis=1)
    size = pixels.shape[1]
    correlation = np.abs(both.T @ both).reshape(2, size, 2, size).max(axis=(0, 2)) / len(both)
    largest = np.clip(correlation, 0.0, 1.0)
    np.fill_diagonal(largest, 1.0)
    return np.maximum(largest, largest.T)


def clouds(points: Floats) -> Ints:
    """Which separate cloud each point (N, F) belongs to, numbered by size from 0; -1 for none. Shape (N,).

    Two points are linked if each is among the other's nearest, and equal points always are; clouds are the connected
    components. Clouds too small to be a value are left out; clouds with a narrow gap between them are merged.
    """
    count = len(points)
    # A tree splits just above a coordinate. With denormals flushed nothing is just above 0, so start at 1.
    shifted = points - points.min(axis=0) + 1.0
    distance, near = scipy.spatial.cKDTree(shifted).query(shifted, min(_NEIGHBOURS + 1, count))
    rows = np.repeat(np.arange(count), near.shape[1])
    links = scipy.sparse.csr_matrix((np.ones(near.size), (rows, near.ravel())), shape=(count, count))
    crowded = distance[:, -1] <= np.quantile(distance[:, -1], 1.0 - _LONELY)
    core = scipy.sparse.diags(crowded.astype(np.float64))
    mutual = core @ links.minimum(links.T) @ core
    _, first, twin = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    same = scipy.sparse.csr_matrix((np.ones(count), (np.arange(count), first[twin.ravel()])), shape=(count, count))
    label = scipy.sparse.csgraph.connected_components(mutual + same, directed=False)[1]
    return _merge_close(shifted, _by_size(label, _LEAST_SHARE * count))


def _by_size(label: Ints, least: float = 0.0) -> Ints:
    """Labels (N,), -1 for none, numbered by size from 0; those of at most ``least`` points become -1."""
    sizes = np.bincount(label[label >= 0])
    number = np.append(np.argsort(-sizes, kind="stable").argsort(), -1)
    number[:-1][sizes <= least] = -1
    return number[label]


def _merge_close(points: Floats, label: Ints) -> Ints:
    """Clouds (N,) of points (N, F), -1 for none, with narrow gaps closed; numbered by size anew.

    Pixels turn smooth motion into steps, and another factor behind this one changes its pixels: either splits a value.
    Such gaps are narrow compared with those between values; comparing takes more than two clouds.
    """
    count = int(label.max()) + 1
    if count < 3:
        return label
    apart = np.zeros((count, count))
    for a, b in itertools.combinations(range(count), 2):
        apart[a, b] = scipy.spatial.cKDTree(points[label == a]).query(points[label == b])[0].min()
    pairs = np.triu_indices(count, 1)
    near = np.zeros_like(apart)
    near[pairs] = apart[pairs] < _LEAST_GAP * np.sqrt((apart[pairs] ** 2).mean())
    whole = scipy.sparse.csgraph.connected_components(near, directed=False)[1]
    return _by_size(np.append(whole, -1)[label])


def _directions(pixels: Floats, group: Bools) -> Floats:
    """The principal directions of a group of pixels (X,), among all pixels (N, X). Shape (F, X)."""
    own = pixels[:, group]
    centred = own - own.mean(axis=0)
    directions = np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :FEATURES]  # [X', F]
    basis = np.zeros((FEATURES, pixels.shape[1]))
    basis[: directions.shape[1], group] = directions.T
    return basis


def _balanced(value: Ints, generator: torch.Generator) -> Ints:
    """Rows of exemplars, drawn with replacement, as many of each value but for one."""
    rows = [np.flatnonzero(value == index) for index in range(int(value.max()) + 1)]
    picks = [rows[index % len(rows)] for index in range(EXEMPLARS)]
    return np.concatenate([own[torch.randint(len(own), (1,), generator=generator).numpy()] for own in picks])


def _fit_appearance(network: DiscreteEncoder, images: Tensor, groups: list[Bools]) -> None:
    """Take the mean image as background, and of each value how the factor's own pixels differ from it."""
    channels, height, width = images.shape[1:]
    grid = (channels, -(-height // POOL), -(-width // POOL))
    codes = torch.cat([network.codes(chunk) for chunk in images.split(500)])
    network.background.copy_(images.mean(dim=0))
    first = 0
    for factor, size in enumerate(network.code_sizes):
        mask = torch.from_numpy(groups[factor]).reshape(grid).repeat_interleave(POOL, 1).repeat_interleave(POOL, 2)
        for value in range(size):
            change = images[codes[:, factor] == value].mean(dim=0) - network.background
            network.appearance[first + value] = change * mask[:, :height, :width]
        first += size
