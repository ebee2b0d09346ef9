"""Changes of a rendered frame that are no part of the scene: a shift, a soft shadow, an occluder, the sensor's noise.

A nuisance is drawn at the start of an episode and goes on with each frame; it is applied to the agent's frames alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from imagine_bench.arrays import Floats, Frame

from .appearance import Appearance
from .constants import FRAME_PX

_WHITE = 255.0
_SHADOW_RADIUS = 0.2
"""Standard deviation of the shadow's Gaussian, as a share of the frame's edge."""
_SHADOW_STEP = 0.25
"""Most that the shadow moves from one frame to the next along each axis, as a share of the frame's edge."""


@dataclass(frozen=True, kw_only=True)
class Nuisance:
    """The nuisances of one frame."""

    level: Appearance
    shift: tuple[float, float]  #: of the episode, down and to the right, as shares in [-1, 1] of the level's shift
    shadow: tuple[float, float]  #: place of the shadow at the start, a share of the frame's edge
    step: tuple[float, float]  #: motion of the shadow from frame to frame
    moment: int = 0  #: frames of the episode so far
    occluder: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: its place in its range, and its gray, from 0 to 1
    noise_seed: int = 0

    def following(self, rng: np.random.Generator) -> Nuisance:
        """The nuisances of the next frame."""
        row, column, gray = rng.random(3).tolist()
        seed = int(rng.integers(1 << 63))
        return replace(self, moment=self.moment + 1, occluder=(row, column, gray), noise_seed=seed)

    def of(self, frame: Frame) -> Frame:
        """The frame (H, W, 3) that the sensor gives for a rendered one."""
        level = self.level
        height, width, _ = frame.shape
        seen = frame.astype(np.float64)
        if level.shadow_depth:
            seen *= 1.0 - level.shadow_depth * self._shadow(height, width)[..., None]
        if level.shift_px:
            seen = _shifted(seen, [round(level.shift_px * height / FRAME_PX * share) for share in self.shift])
        if level.occluder_px:
            edge = round(level.occluder_px * height / FRAME_PX)
            row, column, gray = self.occluder
            top = round(row * (height - edge))
            left = round(column * (width - edge))
            seen[top : top + edge, left : left + edge] = _WHITE * gray
        if level.noise_levels:
            rng = np.random.default_rng(self.noise_seed)
            seen += level.noise_levels * rng.standard_normal(frame.shape)
        return np.rint(np.clip(seen, 0.0, _WHITE)).astype(np.uint8)

    def _shadow(self, height: int, width: int) -> Floats:
        """Darkness of each pixel, from 0 to 1: a Gaussian that moves on and turns back at the borders. Shape (H, W)."""
        falls = []
        for start, step, pixels in zip(self.shadow, self.step, (height, width), strict=True):
            place = 1.0 - abs((start + self.moment * step) % 2.0 - 1.0)
            away = ((np.arange(pixels) + 0.5) / pixels - place) / _SHADOW_RADIUS
            falls.append(np.exp(-0.5 * away**2))
        return np.multiply.outer(*falls)


def draw_nuisance(level: Appearance, rng: np.random.Generator) -> Nuisance | None:
    """The nuisances of an episode; None, without a draw, where the level has none."""
    if not level.has_nuisances:
        return None
    down, right, *step = rng.uniform(-1.0, 1.0, 4).tolist()
    row, column = rng.random(2).tolist()
    move = (_SHADOW_STEP * step[0], _SHADOW_STEP * step[1])
    return Nuisance(level=level, shift=(down, right), shadow=(row, column), step=move)


def _shifted(image: Floats, by_px: list[int]) -> Floats:
    """An image (H, W, 3) moved down and to the right; its border is repeated."""
    height, width, _ = image.shape
    most = max(map(abs, by_px))
    down, right = by_px
    padded = np.pad(image, ((most, most), (most, most), (0, 0)), mode="edge")
    return padded[most - down : most - down + height, most - right : most - right + width].copy()
