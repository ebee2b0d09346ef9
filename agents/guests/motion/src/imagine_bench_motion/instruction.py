"""Instructions in words as vectors: a bag of words, each hashed to one of a fixed number of places."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

WIDTH = 64
"""Places of a vector."""
GO_BACK = "go back"
"""The instruction after a macro-action: lift the hand and return to where the next one begins."""


def words_vector(instruction: str) -> NDArray[np.float32]:
    """How often each hashed word occurs. Shape (64,). The order of words does not matter, nor do capitals and dots."""
    vector = np.zeros(WIDTH, dtype=np.float32)
    for word in instruction.lower().replace(",", " ").replace(".", " ").split():
        vector[zlib.crc32(word.encode()) % WIDTH] += 1.0
    return vector
