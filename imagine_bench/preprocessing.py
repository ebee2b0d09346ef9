"""The ways of reading frames that a task may declare. Numpy only, so that both sides share it.

The thesis makes the arrow puzzle's frames gray and cuts them into three vertical strips, one cube each, fed as
three channels (section 5.2.2); those of the task with a human stay whole and in color (section 3.2.1). Here other
numbers of cubes have a channel each, too: strips where they stand in one row, and where they stand in two the cube's
own rows below those where the hand is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from imagine_bench.arrays import Floats32, Ints, Pixels
from imagine_bench.errors import require_known

STRIP_WIDTH = 22
CELL_WIDTH = 18
"""Pixels; of three strips each shares one column with each neighbour."""
_STRIP_STARTS = {1: (21,), 2: (9, 32), 3: (0, 21, 42)}
_HAND_ROWS = np.arange(10, 28)
_FAR_ROWS = np.arange(28, 46)
_NEAR_ROWS = np.arange(46, 64)
_GRAY = "gray_strips"
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601

Preprocess = Callable[[Pixels], Floats32]


def gray_name(cubes: int) -> str:
    """The preprocessing with a channel for each of so many cubes."""
    return _GRAY if cubes == 3 else f"gray_cells_{cubes}"


@cache
def _windows(cubes: int) -> list[tuple[Ints, Ints]]:
    """Rows (H, 1) and columns (W,) of each cube's channel in a frame, left to right."""
    if cubes in _STRIP_STARTS:
        return [(np.arange(64)[:, None], start + np.arange(STRIP_WIDTH)) for start in _STRIP_STARTS[cubes]]
    starts = np.linspace(0, 64 - CELL_WIDTH, cubes).round().astype(np.int64)
    rows = [np.concatenate([_HAND_ROWS, _NEAR_ROWS if cube % 2 else _FAR_ROWS])[:, None] for cube in range(cubes)]
    return [(own, start + np.arange(CELL_WIDTH)) for own, start in zip(rows, starts, strict=True)]


@cache
def _stretch(pixels: int) -> Floats32:
    """Linear interpolation that makes cubes as large as in strips. Shape (pixels, 4/3 pixels)."""
    at = (np.arange(pixels * 4 // 3) + 0.5) * 0.75 - 0.5
    return np.stack([np.interp(at, np.arange(pixels), row) for row in np.eye(pixels)]).astype(np.float32)


def gray_cells(frames: Pixels, cubes: int = 3) -> Floats32:
    """Cut frames into a gray channel a cube: (N, 64, 64, 3) uint8 to (N, cubes, H, W) float32 in [0, 1]."""
    gray = (frames.astype(np.float32) @ _LUMA) / 255.0  # [N, 64, 64]
    cells = np.stack([gray[:, rows, columns] for rows, columns in _windows(cubes)], axis=1)
    if cubes in _STRIP_STARTS:
        return cells
    height, width = cells.shape[2:]
    return _stretch(height).T @ cells @ _stretch(width)


def join_cells(cells: Floats32) -> Floats32:
    """Undo :func:`gray_cells` for pictures: (..., cubes, H, W) to (..., 64, 64).

    A place that several channels show is the left one's, and a place that none shows is gray.
    """
    windows = _windows(cells.shape[-3])
    if len(windows) not in _STRIP_STARTS:
        down, across = (np.linalg.pinv(_stretch(each.size)) for each in windows[0])
        cells = down.T @ cells @ across
    whole = np.full((*cells.shape[:-3], 64, 64), 0.5, dtype=cells.dtype)
    for cube, (rows, columns) in reversed(list(enumerate(windows))):
        whole[..., rows, columns] = cells[..., cube, :, :]
    return whole


def whole_rgb(frames: Pixels) -> Floats32:
    """Channels first: (N, 64, 64, 3) uint8 to (N, 3, 64, 64) float32 in [0, 1]."""
    return np.moveaxis(frames, -1, 1).astype(np.float32) / 255.0


def small_rgb(frames: Pixels) -> Floats32:
    """Half the resolution, 2 x 2 pixels averaged: (N, 64, 64, 3) uint8 to (N, 3, 32, 32) float32 in [0, 1]."""
    n, height, width, _ = frames.shape
    blocks = frames.reshape(n, height // 2, 2, width // 2, 2, 3).sum(axis=(2, 4), dtype=np.uint16)
    return np.moveaxis(blocks, -1, 1).astype(np.float32) / (4 * 255.0)


PREPROCESSING: dict[str, Preprocess] = {"whole_rgb": whole_rgb, "small_rgb": small_rgb}
PREPROCESSING |= {gray_name(cubes): partial(gray_cells, cubes=cubes) for cubes in range(1, 7)}


def preprocess(name: str) -> Preprocess:
    """The preprocessing of that name.

    Raises:
        UnknownNameError: No such preprocessing.
    """
    return PREPROCESSING[require_known("preprocessing", name, PREPROCESSING)]
