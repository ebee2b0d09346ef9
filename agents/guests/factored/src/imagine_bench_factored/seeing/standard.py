"""Frames as they would be without a shifted camera, a shadow, an occluder or a noisy sensor, learned from frames alone.

Each correction is made only where the frames show that it is needed; frames without nuisances stay as they are, to the
bit. In this order: a frame is moved to where its contours agree with those of the other frames; it is divided by a
smooth field of light, by which it differs from the median frame; noise is taken away by projecting blocks of pixels on
their principal components; and pixels whose color is unusual at their place are hidden: they are no numbers.

Sources: registration by cross-correlation (Lewis 1995); normalised convolution (Knutsson & Westin 1993); noise from
the median of wavelet details (Donoho & Johnstone 1994); principal components above the edge of noise (Marchenko &
Pastur 1967); usual colors of a pixel (Stauffer & Grimson 1999).
Shapes: ``N`` frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from imagine_bench.arrays import Floats32, Frame, Ints

from ..factors import Mask

Images = Floats32
Spectrum = NDArray[np.complex128]

_FEWEST = 12
"""Frames from which nuisances are looked for."""
_MOST = 300
"""Frames at most from which noise and usual colors are learned; they are taken at equal distances."""
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601
_DARK = 8.0  # of 255, added before logarithms and ratios

_LEAST = 1e-6

_REACH_PX = 10  # largest shift that is looked for
_ROUNDS = 5  # of registration and of light: the reference gets better with each
_MOVED_PX = 2
_MOVED = 0.25  # share of the frames that lie so many pixels off, where the camera does not stand still
_AGREE = (
    1.5  # times the energy of the mean contours, once frames are moved: else it is things that move, not the camera
)

_LIGHT_PX = 6.0  # standard deviation of the window in which light is equal
_BLUR_PX = 1.5  # the same of the window in which noise is averaged before
_ONE_TINT = 0.08  # of a logarithm: light changes all colors alike, an object does not
_ANY_LIGHT = 1.7  # the largest change of light, as a logarithm
_LIKE_LIGHT = 0.25  # the same, of a pixel from the light around it
_LIT = 0.15  # difference of light, as a logarithm, from that of most pixels, that shows uneven light
_LIT_AREA = 0.12  # share of the pixels where it is so large; and of the frames in which it is
_LIT_SHARE = 0.4
_RELIGHTS = 2  # times that the reference is made anew of evenly lit frames

_NOISY = 7.0  # standard deviation of the noise of a sensor, of 255, below which none is taken away
_SOFT_PX = 1.2  # standard deviation of the window that takes noise away before colors are counted
_BLOCK_PX = 16
_STRIDE_PX = 8
_ABOVE = 1.1  # times the edge of noise
_UNEXPLAINED = 1.3  # times the energy of noise; a remainder that no component explains is noise below this

_LEVELS = 16  # of each color, where usual colors are counted
_USUAL = 0.06  # share of the frames, and least number, that show a usual color
_USUAL_TIMES = 3
_BLOB_PX = 9  # pixels of an occluder
_STILL = 0.75  # share of the frames in which a pixel of the background looks as in the median frame
_STILL_LIKE = 20.0  # of 255
_TELLING = 40  # frames from which an unusual patch can be told from a new one
_OCCLUDED = 0.25  # share of the frames with something unusual before the background: there are occluders


class _Components(NamedTuple):
    """The usual content of blocks of pixels; a corner, a mean (D,) and components (K, D) for each of them."""

    noise: float
    blocks: tuple[tuple[int, int, Images, Images], ...]


class Standard(NamedTuple):
    """The properties of a normal frame; a correction that is None is not made."""

    spectrum: Spectrum | None = None  #: of the reference's contours. Shape (64, 64).
    reference: Images | None = None  #: the median frame. Shape (64, 64, 3).
    is_uneven: bool = False  #: whether light is divided away
    components: _Components | None = None
    usual: Mask | None = None  #: whether each level of each color is usual at a pixel. Shape (64, 64, 3, levels).

    def of(self, frames: Frame) -> Frame | Images:
        """Frames (N, 64, 64, 3) as normal ones, NaN where something hides the scene; the same if nothing is to do."""
        if self.reference is None:
            return frames
        images = frames.astype(np.float32)
        if self.spectrum is not None:
            images = _moved(images, _shifts(images, self.spectrum)[0], self.reference)
        light = np.ones(images.shape[:3], dtype=np.float32)
        if self.is_uneven:
            light = np.exp(_light(images, self.reference))
            images = images / light[..., None]
        hidden = None if self.usual is None else _unusual(_soft(images, self.components), self.usual)[..., None]
        if self.components is not None:
            seen = images if hidden is None else np.where(hidden, self.reference, images)
            images = _denoised(seen, self.components, light)
        return images if hidden is None else np.where(hidden, np.float32(np.nan), images)


_PLAIN = Standard()


def standard_of(frames: Frame) -> Standard:
    """The normal frame of frames (N, 64, 64, 3), with the corrections that they need."""
    if len(frames) < _FEWEST:
        return _PLAIN
    images = frames.astype(np.float32)
    found, spectrum = _shifts(images)
    still = np.fft.fft2(_gradients(images).mean(axis=0))
    agree = float((np.abs(spectrum) ** 2).sum() / max((np.abs(still) ** 2).sum(), _LEAST))
    is_moved = agree >= _AGREE and bool((np.abs(found).max(axis=1) >= _MOVED_PX).mean() >= _MOVED)
    reference = np.median(images, axis=0)
    if is_moved:
        reference = np.median(_moved(images, found, reference), axis=0)
        images = _moved(images, found, reference)
    is_uneven = _unevenness(_light(images, reference)) >= _LIT_SHARE
    light = np.ones(images.shape[:3], dtype=np.float32)
    if is_uneven:
        for _ in range(_RELIGHTS):
            more = np.exp(_light(images, reference))
            light *= more
            images = np.asarray(images / more[..., None], dtype=np.float32)
            reference = np.median(images, axis=0)
    few = np.unique(np.linspace(0, len(images) - 1, _MOST).round().astype(np.int64))
    noise = _noise(images[few])
    is_noisy = noise >= _NOISY
    soft = _soft(images, is_noisy)
    usual = _usual(soft[few])
    hidden = _unusual(soft, usual)
    is_occluded = len(images) >= _TELLING and _occluded(soft, hidden, np.median(soft, axis=0)) >= _OCCLUDED
    if is_occluded:
        images = np.where(hidden[..., None], reference, images)
    components = _components(images[few], noise) if is_noisy else None
    if not (is_moved or is_uneven or is_noisy or is_occluded):
        return _PLAIN
    return Standard(spectrum if is_moved else None, reference, is_uneven, components, usual if is_occluded else None)


def _soft(images: Images, is_noisy: object) -> Images:
    """Images in which noise hides no color: blurred, if they are noisy."""
    return scipy.ndimage.gaussian_filter(images, (0, _SOFT_PX, _SOFT_PX, 0)) if is_noisy else images


def _gradients(images: Images) -> Spectrum:
    """Gradients of the logarithm of the brightness of blurred images (N, 64, 64, 3): down, and to the right times i."""
    log = np.log(scipy.ndimage.gaussian_filter(images @ _LUMA, (0, 1.0, 1.0)) + 2.0 * _DARK)
    return np.asarray(np.gradient(log, axis=1) + 1j * np.gradient(log, axis=2))


def _shifts(images: Images, reference: Spectrum | None = None) -> tuple[Ints, Spectrum]:
    """How far each image lies down and to the right of a reference, (N, 2), and the reference's spectrum.

    Without one, it is the mean of the images, once they lie where they agree.
    """
    spectra = np.fft.fft2(_gradients(images))
    if reference is not None:
        return _best_shifts(spectra, reference), reference
    found = np.zeros((len(images), 2), dtype=np.int64)
    frequencies = np.fft.fftfreq(images.shape[1])
    for _ in range(_ROUNDS):
        down, right = (np.exp(2j * np.pi * np.multiply.outer(found[:, axis], frequencies)) for axis in (0, 1))
        reference = (spectra * down[:, :, None] * right[:, None, :]).mean(axis=0)
        found = _best_shifts(spectra, reference)
        found = found - np.round(np.median(found, axis=0)).astype(np.int64)
    assert reference is not None
    return found, reference


def _best_shifts(spectra: Spectrum, reference: Spectrum) -> Ints:
    like = np.fft.ifft2(spectra * reference.conj()).real
    near = np.arange(-_REACH_PX, _REACH_PX + 1)
    window = like[:, near[:, None], near]
    best = window.reshape(len(spectra), -1).argmax(axis=1)
    return np.stack(np.unravel_index(best, window.shape[1:]), axis=1) - _REACH_PX


def _moved(images: Images, by_px: Ints, reference: Images) -> Images:
    """Images moved back by so many pixels (N, 2); the reference stands where nothing was seen."""
    moved = np.empty_like(images)
    height, width = images.shape[1:3]
    for each, image, (down, right) in zip(moved, images, by_px.tolist(), strict=True):
        each[:] = reference
        to_rows, of_rows = _overlap(height, down)
        to_columns, of_columns = _overlap(width, right)
        each[to_rows, to_columns] = image[of_rows, of_columns]
    return moved


def _overlap(pixels: int, by_px: int) -> tuple[slice, slice]:
    """Where pixels come to lie that are moved back, and which ones."""
    return slice(max(0, -by_px), pixels - max(0, by_px)), slice(max(0, by_px), pixels - max(0, -by_px))


def _light(images: Images, reference: Images) -> Images:
    """A smooth field by which the brightness of images differs from the reference's, as a logarithm. (N, 64, 64)."""
    near = (0, _BLUR_PX, _BLUR_PX, 0)
    ratio = np.log(scipy.ndimage.gaussian_filter(images, near) + _DARK)
    ratio -= np.log(scipy.ndimage.gaussian_filter(reference, near[1:]) + _DARK)
    usual = np.median(ratio, axis=(1, 2), keepdims=True)
    ratio -= usual
    bright = ratio.mean(axis=-1)
    is_light = (np.abs(ratio - bright[..., None]).max(axis=-1) < _ONE_TINT) & (np.abs(bright) < _ANY_LIGHT)
    field = _smooth(bright, is_light)
    for _ in range(_ROUNDS):
        field = _smooth(bright, is_light & (np.abs(bright - field) < _LIKE_LIGHT))
    return np.asarray(field + usual.mean(axis=-1))


def _unevenness(light: Images) -> float:
    """Share of fields of light (N, 64, 64) that differ much in a good part of the image."""
    apart = np.abs(light - np.median(light, axis=(1, 2), keepdims=True)) >= _LIT
    return float((apart.mean(axis=(1, 2)) >= _LIT_AREA).mean())


def _smooth(values: Images, counts: Mask) -> Images:
    """The mean around each pixel of the values (N, 64, 64) that count."""
    window = (0, _LIGHT_PX, _LIGHT_PX)
    weight = scipy.ndimage.gaussian_filter(counts.astype(np.float32), window, mode="nearest")
    total = scipy.ndimage.gaussian_filter(np.where(counts, values, np.float32(0.0)), window, mode="nearest")
    return np.asarray(total / np.maximum(weight, 1e-3))


def _noise(images: Images) -> float:
    """Standard deviation of the noise of most images: of the differences within squares of four pixels."""
    ones, others = images[:, ::2], images[:, 1::2]
    detail = (ones[:, :, ::2] - ones[:, :, 1::2] - others[:, :, ::2] + others[:, :, 1::2]) / 2.0
    return float(np.median(np.median(np.abs(detail), axis=(1, 2, 3))) / 0.6745)


def _corners(images: Images) -> Sequence[tuple[int, int]]:
    rows = range(0, images.shape[1] - _BLOCK_PX + 1, _STRIDE_PX)
    columns = range(0, images.shape[2] - _BLOCK_PX + 1, _STRIDE_PX)
    return [(row, column) for row in rows for column in columns]


def _components(images: Images, noise: float) -> _Components:
    """The principal components of each block that are more than noise."""
    blocks = []
    for row, column in _corners(images):
        block = images[:, row : row + _BLOCK_PX, column : column + _BLOCK_PX].reshape(len(images), -1)
        mean = block.mean(axis=0)
        apart = block - mean
        size, vectors = np.linalg.eigh(apart @ apart.T / len(apart))
        edge = _ABOVE * noise**2 * (1.0 + np.sqrt(block.shape[1] / len(apart))) ** 2
        shown = vectors[:, size > edge].T @ apart
        blocks.append((row, column, mean, shown / np.linalg.norm(shown, axis=1, keepdims=True)))
    return _Components(noise, tuple(blocks))


def _denoised(images: Images, components: _Components, light: Images) -> Images:
    """Blocks on their components; the part of the remainder that is larger than noise stays.

    ``light``: images were divided by it, and so was their noise. Shape (N, 64, 64).
    """
    total = np.zeros_like(images)
    weight = np.zeros((*images.shape[1:3], 1), dtype=np.float32)
    for row, column, mean, shown in components.blocks:
        place = (slice(row, row + _BLOCK_PX), slice(column, column + _BLOCK_PX))
        block = images[:, *place].reshape(len(images), -1)
        apart = block - mean
        explained = apart @ shown.T @ shown
        rest = apart - explained
        energy = (rest**2).mean(axis=1)
        noise = components.noise**2 * (light[:, *place] ** -2.0).mean(axis=(1, 2))
        kept = np.sqrt(np.maximum(1.0 - _UNEXPLAINED * noise / np.maximum(energy, _LEAST), 0.0))[:, None]
        total[:, *place] += (mean + explained + kept * rest).reshape(len(images), _BLOCK_PX, _BLOCK_PX, -1)
        weight[place] += 1.0
    return np.clip(total / weight, 0.0, 255.0)


def _levels(images: Images) -> Ints:
    return np.clip(images * (_LEVELS / 256.0), 0.0, _LEVELS - 1.0).astype(np.int64)


def _usual(images: Images) -> Mask:
    """Which levels of each color enough images show at a pixel or beside it. Shape (64, 64, 3, levels)."""
    counts = np.zeros((*images.shape[1:], _LEVELS))
    for levels in _levels(images):
        shown = levels[..., None] == np.arange(_LEVELS)
        counts += scipy.ndimage.maximum_filter(shown, (3, 3, 1, 3))
    return counts >= max(_USUAL_TIMES, _USUAL * len(images))


def _unusual(images: Images, usual: Mask) -> Mask:
    """Pixels (N, 64, 64) that hang together and have a color that is not usual there."""
    found = ~np.take_along_axis(usual[None], _levels(images)[..., None], axis=-1)[..., 0].all(axis=-1)
    square = np.ones((1, 3, 3))
    found = scipy.ndimage.binary_opening(found, square)
    return np.asarray(scipy.ndimage.binary_dilation(found, square))


def _occluded(images: Images, unusual: Mask, reference: Images) -> float:
    """Share of the images in which something unusual stands before the background."""
    like = (np.abs(images - reference).max(axis=-1) < _STILL_LIKE).mean(axis=0)
    return float(((unusual & (like >= _STILL)).sum(axis=(1, 2)) >= _BLOB_PX).mean())
