"""What an agent has learned to see, for people: a color a factor, and beside it a look of each of its values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imagine_bench.interfaces import Frame

from . import appearance

_SCALE = 5
_CELL_PX = 56
_GAP_PX = 8
_MOST = 8
"""Times that frames are drawn larger; edge of a look; space between them; most factors, and values, that are drawn."""
_COLORS = np.array(
    [[0, 114, 178], [230, 159, 0], [0, 158, 115], [204, 121, 167], [213, 94, 0], [86, 180, 233], [240, 228, 66]]
)
"""Told apart by the color-blind (Okabe and Ito 2008)."""


def image(found: Sequence[appearance.SeenFactor], frames: Frame) -> NDArray[np.uint8]:
    """Factors that were found in ``frames`` (N, 64, 64, 3). Shape (320, 832, 3) or, of many factors, higher."""
    gray = np.repeat(frames.mean(axis=(0, 3))[..., None], 3, axis=2)
    rows = max(_SCALE * 64, (min(len(found), len(_COLORS)) * (_CELL_PX + _GAP_PX)))
    sheet = np.full((rows, _SCALE * 64 + _MOST * (_CELL_PX + _GAP_PX), 3), 255.0)
    codes = appearance.read(list(found), frames)[0] if found else np.zeros((len(frames), 0), dtype=np.int64)
    for index, (factor, color) in enumerate(zip(found, _COLORS, strict=False)):
        mask = np.any([part.mask for part in factor.parts], axis=0)
        gray[mask] = 0.55 * gray[mask] + 0.45 * color
        high = np.flatnonzero(mask.any(axis=1))
        wide = np.flatnonzero(mask.any(axis=0))
        box = slice(high[0], high[-1] + 1), slice(wide[0], wide[-1] + 1)
        for place, value in enumerate(np.unique(codes[:, index])[:_MOST]):
            look = frames[np.flatnonzero(codes[:, index] == value)[0]][box]
            top = index * (_CELL_PX + _GAP_PX)
            left = _SCALE * 64 + _GAP_PX + place * (_CELL_PX + _GAP_PX)
            cell = sheet[top : top + _CELL_PX, left : left + _CELL_PX]
            cell[:] = color
            at = [(np.arange(_CELL_PX - 6) * size) // (_CELL_PX - 6) for size in look.shape[:2]]
            cell[3:-3, 3:-3] = look[np.ix_(*at)]
    sheet[: _SCALE * 64, : _SCALE * 64] = gray.repeat(_SCALE, axis=0).repeat(_SCALE, axis=1)
    return sheet.round().astype(np.uint8)
