"""What a task may declare about how its frames are read. Numpy only, so that both sides share it.

The thesis makes the arrow puzzle's frames gray and cuts them into three vertical strips, one cube each, fed as
three channels (section 5.2.2); those of the task with a human stay whole and in color (section 3.2.1).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from imagine_bench.errors import require_known

STRIP_WIDTH = 22
"""Pixels; 64 columns hold three strips that share one column with each neighbour."""
_STRIP_STARTS = (0, 21, 42)
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601

Preprocess = Callable[[NDArray[np.uint8]], NDArray[np.float32]]


def gray_strips(frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Cut frames into three gray strips: (N, 64, 64, 3) uint8 to (N, 3, 64, 22) float32 in [0, 1]."""
    gray = (frames.astype(np.float32) @ _LUMA) / 255.0  # [N, 64, 64]
    return np.stack([gray[:, :, start : start + STRIP_WIDTH] for start in _STRIP_STARTS], axis=1)


def whole_rgb(frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Channels first: (N, 64, 64, 3) uint8 to (N, 3, 64, 64) float32 in [0, 1]."""
    return np.moveaxis(frames, -1, 1).astype(np.float32) / 255.0


def small_rgb(frames: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Half the resolution, 2 x 2 pixels averaged: (N, 64, 64, 3) uint8 to (N, 3, 32, 32) float32 in [0, 1]."""
    n, height, width, _ = frames.shape
    blocks = frames.reshape(n, height // 2, 2, width // 2, 2, 3).sum(axis=(2, 4), dtype=np.uint16)
    return np.moveaxis(blocks, -1, 1).astype(np.float32) / (4 * 255.0)


def join_strips(strips: NDArray[np.float32]) -> NDArray[np.float32]:
    """Undo :func:`gray_strips` for pictures: (..., 3, 64, 22) to (..., 64, 64); a shared column is the left strip's."""
    left, middle, right = strips[..., 0, :, :], strips[..., 1, :, 1:], strips[..., 2, :, 1:]
    return np.concatenate([left, middle, right], axis=-1)


PREPROCESSING: dict[str, Preprocess] = {"gray_strips": gray_strips, "whole_rgb": whole_rgb, "small_rgb": small_rgb}


def preprocess(name: str) -> Preprocess:
    """The preprocessing of that name.

    Raises:
        UnknownNameError: No such preprocessing.
    """
    return PREPROCESSING[require_known("preprocessing", name, PREPROCESSING)]
