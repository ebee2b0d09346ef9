"""A reader that reads nothing: frames that the judge rendered itself are known to the pixel anyway."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class BlindReader:
    def __init__(self, coordinates: int) -> None:
        self.coordinates, self.asked = coordinates, 0

    def read(self, pictures: NDArray[Any]) -> NDArray[np.int64]:
        self.asked += len(pictures)
        return np.full((len(pictures), self.coordinates), -1)
