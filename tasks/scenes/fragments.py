"""Frames as the thesis made them (5.2.1): a finite pool of fragments for each microstate, patched together.

The microstates are the direction of one cube's arrow (in general: where one object is) and the place that the hand
points at. A fragment fixes how its subject lies and the light of its photograph. A frame is a row of the hand's
fragment above one column for each object, so that light changes at their seams; then the sensor's noise and gamma
change the whole. Not the thesis': the seed, the widths in :data:`.appearance.LEVELS`, and fragments kept for tests.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from imagine_bench.arrays import Floats, Frame, State
from imagine_bench.seeding import SeedTree

from .appearance import Appearance

HAND_FRAGMENTS = 50
OBJECT_FRAGMENTS = 16
"""Of each microstate, in training; as many others are held out."""
HAND_SHARE = 34 / 64
"""Of the rows of a frame, from its top: an object's fragment never covers the fingertip."""
_WHITE = 255.0


@dataclass(frozen=True, kw_only=True)
class Fragment:
    """One photograph of one microstate."""

    offset: tuple[float, float, float, float]  #: shares in [-1, 1] of the level's offsets x, y, z and of its yaw
    light: Floats  #: brightness at the patch's corners, by row, column and channel. Shape (2, 2, 3).


@functools.cache
def fragments(level: Appearance, subject: str, value: int) -> tuple[Fragment, ...]:
    """The pool of a microstate: subject ``"hand"`` or ``"object 0"`` and on, at one of its values."""
    rng = SeedTree(0 if level.pool is None else level.pool).child(level.name, subject, value).generator()
    pool = []
    for _ in range(HAND_FRAGMENTS if subject == "hand" else OBJECT_FRAGMENTS):
        x, y, z, yaw = rng.uniform(-1.0, 1.0, 4).tolist()
        light = 1.0 + level.light_fraction * rng.uniform(-1.0, 1.0, (2, 2, 1))
        light = light * (1.0 + level.color_fraction * rng.uniform(-1.0, 1.0, 3))
        pool.append(Fragment(offset=(x, y, z, yaw), light=light))
    return tuple(pool)


@dataclass(frozen=True, kw_only=True)
class Composite:
    """All that makes a photograph of a rendered frame."""

    hand: Fragment
    objects: tuple[Fragment, ...]
    gamma: float
    noise_std: float
    noise_seed: int

    def of(self, frame: Frame) -> Frame:
        """The photograph of a rendered frame (H, W, 3)."""
        height, width, _ = frame.shape
        light = np.empty(frame.shape)
        top = round(height * HAND_SHARE)
        seams = np.linspace(0, width, len(self.objects) + 1).round().astype(int)
        light[:top] = _spread(self.hand.light, top, width)
        for left, right, fragment in zip(seams[:-1], seams[1:], self.objects, strict=True):
            light[top:, left:right] = _spread(fragment.light, height - top, right - left)
        generator = np.random.default_rng(self.noise_seed)
        noise = generator.standard_normal(frame.shape)
        lit = np.clip(frame / _WHITE * light + self.noise_std * noise, 0.0, 1.0)
        return np.rint(_WHITE * lit**self.gamma).astype(np.uint8)


def draw_composite(level: Appearance, objects: State, gesture: int, rng: np.random.Generator) -> Composite:
    """Fragments of the hand and of each object, uniformly from their pools, gamma and noise."""
    hand = fragments(level, "hand", gesture)[int(rng.integers(HAND_FRAGMENTS))]
    chosen = rng.integers(OBJECT_FRAGMENTS, size=len(objects)).tolist()
    return Composite(
        hand=hand,
        objects=tuple(
            fragments(level, f"object {index}", value)[which]
            for index, (value, which) in enumerate(zip(objects, chosen, strict=True))
        ),
        gamma=1.0 + level.gamma_half_width * rng.uniform(-1.0, 1.0),
        noise_std=level.noise_std,
        noise_seed=int(rng.integers(1 << 63)),
    )


def _spread(corners: Floats, height: int, width: int) -> Floats:
    """Corners (2, 2, C) interpolated bilinearly over a patch. Shape (height, width, C)."""
    shares = (np.linspace(0.0, 1.0, pixels) for pixels in (height, width))
    down, across = (np.stack([1.0 - share, share], axis=1) for share in shares)
    sides = (down @ corners.reshape(2, -1)).reshape(height, 2, -1)  # [H, 2, C]
    return across @ sides  # [H, W, C]
